from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller.stage.artefacts.grade import PICTURE, in_rows, parts_of
from controller.stage.report.galleries import causes_gallery


@given(count=st.integers(1, 9), rows=st.integers(1, 5), columns=st.integers(1, 5))
def test_each_projectors_part_is_found_again_in_the_picture_of_all(count: int, rows: int, columns: int) -> None:
    pictures = [np.full((rows, columns, 3), n + 1, np.uint8) for n in range(count)]
    # before 0.2.0 all were below each other
    for whole in (in_rows(pictures), np.concatenate(pictures)):
        parts = parts_of(whole, count, (rows, columns))
        assert len(parts) == count
        for part, picture in zip(parts, pictures, strict=True):
            np.testing.assert_array_equal(part, picture)


@pytest.mark.parametrize("count", [1, 3, 4, 6])
def test_the_report_shows_each_projectors_own_map_whole_with_its_reasons(tmp_path: Path, count: int) -> None:
    colours = [np.full((20, 30, 3), (40 * n, 10, 200 - 30 * n), np.uint8) for n in range(count)]
    cv2.imwrite(str(tmp_path / PICTURE), in_rows(colours)[..., ::-1])
    found = {
        f"p{n}": {"relative_rms": 0.01 * n, "reasons": [{"sentence": f"Reason {n}."}, {"sentence": "Another."}]}
        for n in range(count)
    }
    ((_, _, pictures),) = causes_gallery(tmp_path, found, (15, 30))
    for n, (picture, colour) in enumerate(zip(pictures, colours, strict=True)):
        np.testing.assert_array_equal(picture.image, colour)
        assert picture.points == (f"Reason {n}.", "Another.")
        assert picture.caption == f"p{n}: {n:.2f} % error"


def test_a_run_from_before_there_were_such_maps_has_no_gallery(tmp_path: Path) -> None:
    assert causes_gallery(tmp_path, {}, (15, 30)) == ()
