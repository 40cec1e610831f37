"""Aiming before anything is calibrated: coverage, focus and what is too dark, from boards that are drawn here."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from controller.core.arrays import FloatImage
from controller.optics.calibrate.verify.aim import Aim, aim_overview, assess_aim, checkerboard

SIZE = (240, 160)
TIMES = 3
"""Camera pixels to a projector pixel."""


def photograph(inverse: bool, *, columns: slice, blur_px: float = 1.0, light: float = 0.4) -> FloatImage:
    """A projector that lights some columns of a grey wall, (rows, columns, 3)."""
    shown = cv2.resize(checkerboard(SIZE, inverse=inverse), None, fx=TIMES, fy=TIMES, interpolation=cv2.INTER_NEAREST)
    seen = cv2.GaussianBlur(shown.astype(np.float32) / 255 * light, (0, 0), blur_px)
    seen[:, : columns.start] = 0
    seen[:, columns.stop :] = 0
    return seen + np.float32(0.01)


def aim(*, blur_px: float = 1.0, second: slice = slice(360, 720), light: float = 0.4) -> Aim:
    """Two projectors: one on the columns 0 to 480, another on ``second``."""
    black = np.full((SIZE[1] * TIMES, SIZE[0] * TIMES, 3), 0.01, np.float32)
    first = tuple(photograph(inverse, columns=slice(0, 480)) for inverse in (False, True))
    other = tuple(photograph(inverse, columns=second, blur_px=blur_px, light=light) for inverse in (False, True))
    return assess_aim(black, [(first[0], first[1]), (other[0], other[1])])


def test_coverage_and_overlap_are_shares_of_what_any_projector_lights() -> None:
    found = aim()
    assert found.projectors[0].coverage == pytest.approx(480 / 720, abs=0.01)
    assert found.projectors[1].coverage == pytest.approx(360 / 720, abs=0.01)
    assert found.overlap == pytest.approx(120 / 720, abs=0.01)
    assert (found.too_dark, found.too_soft) == (0.0, 0.0)
    assert found.seen.max() == 2


def test_the_blurred_projector_is_told_from_the_sharp_one() -> None:
    found = aim(blur_px=8.0)
    assert found.projectors[0].focus > 0.9
    assert found.projectors[1].focus < 0.2
    assert found.too_soft == pytest.approx(240 / 720, abs=0.03), "where nothing but the blurred one shines"
    assert found.camera_focus > 0.9, "something is sharp, so the camera is"


def test_what_gets_little_light_is_too_dark_and_marked() -> None:
    found = aim(light=0.02)
    assert found.too_dark == pytest.approx(240 / 720, abs=0.02)
    picture = aim_overview(np.full((*found.dark.shape, 3), 0.4, np.float32), found)
    red, elsewhere = picture[found.dark].mean(axis=0), picture[found.seen == 2].mean(axis=0)
    assert red[0] > red[2] + 40
    assert abs(elsewhere[0] - elsewhere[2]) < 5


def test_a_board_and_its_inverse_are_white_together() -> None:
    assert np.all(checkerboard(SIZE, inverse=False) ^ checkerboard(SIZE, inverse=True) == 255)
