"""The truth that calibrations are compared with, against the bench's own pictures and rays."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from lab.timings.tools.truth import Truth
from plugins.emulated.core.truth import Lens, ObjectTruth, write_truth
from plugins.emulated.optics.objects import default_object
from plugins.emulated.optics.staging import random_truth

CAMERA_PX, PROJECTOR_PX = (96, 64), (70, 52)


def _resized(lens: Lens, size_px: tuple[int, int]) -> Lens:
    share = size_px[0] / lens.size_px[0]
    x, y = ((at + 0.5) * share - 0.5 for at in lens.centre_px)
    return dataclasses.replace(lens, size_px=size_px, focal_px=lens.focal_px * share, centre_px=(x, y))


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory) -> Truth:
    stage: Path = tmp_path_factory.mktemp("stage")
    bench = random_truth("small", 7, default_object(), ObjectTruth("vase-and-bust", "", 7), (0, 0))
    camera = dataclasses.replace(bench.camera, lens=_resized(bench.camera.lens, CAMERA_PX))
    projectors = tuple(dataclasses.replace(p, lens=_resized(p.lens, PROJECTOR_PX)) for p in bench.projectors)
    write_truth(stage, dataclasses.replace(bench, subsamples=2, camera=camera, projectors=projectors))
    return Truth(stage)


def test_white_is_the_sum_of_its_colours(truth: Truth) -> None:
    width, height = PROJECTOR_PX
    colours = np.zeros((3, height, width, 3), np.uint8)
    for channel in range(3):
        colours[channel, ..., channel] = 255
    parts = sum(truth.light(0, frame) for frame in colours)
    np.testing.assert_allclose(parts, truth.white(0), atol=2e-5)


def test_a_lit_pixel_appears_where_the_map_says(truth: Truth) -> None:
    at = truth.projector_px(0)
    inner = truth.one_surface(0, 2)
    row, column = np.argwhere(inner)[np.count_nonzero(inner) // 2]
    x, y = np.rint(at[row, column]).astype(int)
    frame = np.zeros((PROJECTOR_PX[1], PROJECTOR_PX[0], 3), np.uint8)
    frame[y, x] = 255
    spot = truth.light(0, frame).sum(axis=2)
    down, along = np.unravel_index(int(spot.argmax()), spot.shape)
    assert np.hypot(down - row, along - column) <= 2.5


def test_points_lie_where_the_projector_sees_them(truth: Truth) -> None:
    """The points come from rays of their own; projected, they must meet the samples' map."""
    camera, projector = truth.bench.camera, truth.bench.projectors[1]
    world = truth.points_m() @ camera.pose.rotation + np.asarray(camera.pose.position_m)
    local = (world - projector.pose.position_m) @ projector.pose.rotation.T
    px = local[..., :2] / local[..., 2:] * projector.lens.focal_px + projector.lens.centre_px
    inner = truth.one_surface(1, 2)
    error = np.hypot(*np.moveaxis(px - truth.projector_px(1), 2, 0))[inner]
    assert np.median(error) < 0.1


def test_edges_are_no_place_to_judge(truth: Truth) -> None:
    whole = truth.wholly_lit(0)
    assert not np.any(truth.one_surface(0, 1) & ~whole)
    assert 0 < np.count_nonzero(truth.one_surface(0, 3)) < np.count_nonzero(truth.one_surface(0, 1))


def test_response_and_mixing_have_the_calibrations_form(truth: Truth) -> None:
    response, mixing = truth.response(0), truth.mixing(0)
    assert response.shape == (3, 256)
    np.testing.assert_allclose(response[:, [0, -1]], [[0, 1]] * 3, atol=1e-9)
    np.testing.assert_allclose(mixing.sum(axis=1), 1)


def test_direct_light_is_what_a_fine_pattern_modulates(tmp_path: Path, truth: Truth) -> None:
    """What a lens spreads over the picture has no detail, and the light that goes straight lacks it."""
    camera = dataclasses.replace(truth.bench.camera, glare=0.05)
    first, *others = truth.bench.projectors
    first = dataclasses.replace(first, light=dataclasses.replace(first.light, glare=0.03))
    write_truth(tmp_path, dataclasses.replace(truth.bench, camera=camera, projectors=(first, *others)))
    veiled = Truth(tmp_path)
    frames = np.zeros((2, PROJECTOR_PX[1], PROJECTOR_PX[0], 3), np.uint8)
    frames[0, :, ::2], frames[1, :, 1::2] = 255, 255
    # one column of pixels more or less: half the picture each, so the veil is the same
    whole, direct = (
        np.subtract(*(veiled.light(0, frame, direct=alone) for frame in frames)) for alone in (False, True)
    )
    detail = veiled.one_surface(0, 2)
    change = np.sum(whole[detail] * direct[detail]) / np.sum(direct[detail] ** 2)
    assert change == pytest.approx(1, abs=2e-3)
    assert np.all(veiled.white(0, direct=True)[detail] < veiled.white(0)[detail])
