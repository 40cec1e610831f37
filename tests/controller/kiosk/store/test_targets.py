"""A picture of any size becomes one of the camera's view."""

from __future__ import annotations

import io
import json
from typing import Literal

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image, ImageCms

from controller.core.errors import UsageError
from controller.kiosk.store.targets import fitted, regions_of, restricted
from tests.controller.optics.solve.targets import icc_files

VIEW = (60, 40)


def png_of(width: int, height: int) -> bytes:
    """Its left half red, its right half green."""
    picture = np.zeros((height, width, 3), np.uint8)
    picture[:, : width // 2, 2] = 255
    picture[:, width // 2 :, 1] = 255
    return cv2.imencode(".png", picture)[1].tobytes()


def seen(png: bytes) -> np.ndarray:
    picture = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED)
    assert picture is not None
    return np.asarray(picture)


def test_a_picture_of_the_right_size_stays_as_it_is() -> None:
    png = png_of(*VIEW)
    assert fitted(png, VIEW) == png


@pytest.mark.parametrize(
    ("how", "size", "said"),
    [
        ("fit", (120, 40), (60, 20)), ("fit", (30, 40), (30, 40)), ("fit", (6, 4), (60, 40)),
        ("fill", (120, 40), (60, 40)), ("fill", (30, 40), (60, 40)), ("fill", (6, 4), (60, 40)),
        ("crop", (120, 40), (60, 40)), ("crop", (30, 20), (30, 20)), ("crop", (6, 400), (6, 40)),
        ("fit", (4000, 1), (60, 1)), ("fill", (1, 1), (60, 40)),
    ],
)  # fmt: skip
def test_where_the_target_says_something_is_as_was_chosen(
    how: Literal["fit", "fill", "crop"], size: tuple[int, int], said: tuple[int, int]
) -> None:
    found = seen(fitted(png_of(*size), VIEW, how))
    assert found.shape == (VIEW[1], VIEW[0], 4)
    rows, columns = np.nonzero(found[..., 3] > 127)
    assert (int(np.ptp(columns)) + 1, int(np.ptp(rows)) + 1) == said
    assert abs(int(columns.min()) - (VIEW[0] - said[0]) // 2) <= 1
    assert abs(int(rows.min()) - (VIEW[1] - said[1]) // 2) <= 1


def test_the_middle_stays_in_the_middle_and_nothing_is_stretched() -> None:
    for how in ("fit", "fill", "crop"):
        found = seen(fitted(png_of(240, 80), VIEW, how))
        row = found[20]
        red, green = row[: 30 - 1], row[30 + 1 :]
        assert (red[red[:, 3] > 200][:, 2] > 200).all()
        assert (green[green[:, 3] > 200][:, 1] > 200).all()


def test_grey_and_deep_pictures_keep_their_values() -> None:
    deep = cv2.imencode(".png", np.full((10, 10), 40_000, np.uint16))[1].tobytes()
    found = seen(fitted(deep, VIEW, "crop"))
    assert found.dtype == np.uint16
    assert found[20, 30].tolist() == [40_000, 40_000, 40_000, 65_535]


@pytest.mark.parametrize("data", [b"", b"Dear reader,", b"\x89PNG\r\n\x1a\n"])
def test_what_is_no_picture_is_refused(data: bytes) -> None:
    with pytest.raises(UsageError) as caught:
        fitted(data, VIEW)
    assert caught.value.code == "target-unreadable"


def test_a_picture_of_another_size_is_converted_by_its_colour_profile() -> None:
    profile = icc_files.icc_profile(icc_files.ADOBE_D50, icc_files.ADOBE_CURVE)
    picture = Image.new("RGB", (120, 40), (180, 90, 60))
    file = io.BytesIO()
    picture.save(file, "PNG", icc_profile=profile)
    theirs = ImageCms.profileToProfile(
        picture, ImageCms.ImageCmsProfile(io.BytesIO(profile)), ImageCms.createProfile("sRGB"),
        ImageCms.Intent.RELATIVE_COLORIMETRIC,
    )  # fmt: skip
    assert theirs is not None
    found = seen(fitted(file.getvalue(), VIEW))[20, 30, 2::-1] / 257
    assert np.abs(found - np.asarray(theirs)[0, 0]).max() < 1


def test_hidden_colours_do_not_show_at_the_edges_of_a_picture_that_is_made_smaller() -> None:
    picture = np.zeros((400, 600, 4), np.uint8)
    picture[..., 1] = 255  # green, hidden
    picture[85:315, 123:477] = (0, 0, 200, 255)
    found = seen(fitted(cv2.imencode(".png", picture)[1].tobytes(), VIEW))
    shown = found[..., 3] > 0
    assert found[shown][:, 1].max() <= 2
    assert found[shown & (found[..., 3] > 20)][:, 2].min() >= 198


def test_a_picture_that_moves_is_refused() -> None:
    frames = [Image.new("RGB", (30, 20), colour) for colour in ("red", "blue")]
    file = io.BytesIO()
    frames[0].save(file, "PNG", save_all=True, append_images=frames[1:])
    with pytest.raises(UsageError, match="animation") as refused:
        fitted(file.getvalue(), VIEW)
    assert refused.value.code == "target-unreadable"


CORNER = st.tuples(st.floats(0, 1), st.floats(0, 1))


@given(st.lists(st.lists(CORNER, min_size=3, max_size=6), max_size=4))
def test_an_outline_is_read_as_it_was_written(regions: list[list[tuple[float, float]]]) -> None:
    assert regions_of(json.dumps(regions)) == tuple(tuple(map(tuple, one)) for one in regions)


@pytest.mark.parametrize(
    "text", ["[[[0,0],[1,1]]]", "[[[0,0],[1,1],[2,0]]]", "{}x", "[1]", "[[[0,0],[1],[1,1]]]", "[[[NaN,0],[1,1],[0,1]]]",
             json.dumps([[[0, 0], [1, 0], [1, 1]]] * 33)],
)  # fmt: skip
def test_what_is_no_outline_is_refused(text: str) -> None:
    with pytest.raises(UsageError) as caught:
        regions_of(text)
    assert caught.value.code == "outline-wrong"


def test_only_what_is_inside_an_outline_stays_in_the_target() -> None:
    picture = cv2.imencode(".png", np.full((40, 80, 3), 200, np.uint8))[1].tobytes()
    left, lower = ((0, 0), (0.4, 0), (0.4, 1), (0, 1)), ((0, 0.5), (1, 0.5), (1, 1), (0, 1))
    kept = seen(restricted(picture, [left, lower]))
    assert [int(kept[place][3]) for place in ((5, 5), (35, 5), (35, 75), (5, 75))] == [255, 255, 255, 0]
    assert (kept[..., :3] == 200).all()
    assert restricted(picture, []) == picture
