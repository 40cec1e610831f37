from __future__ import annotations

import cv2
import numpy as np
import pytest

from controller.core.arrays import Float64
from controller.optics.calibrate.geometry.pose_initialisation import epipolar_distance_px, fundamental

CAMERA = """
372,76 263,108 372,112 862,119 271,133 328,173 718,206 317,224 310,245 642,253 408,281 328,317 779,317 458,346
224,419 206,422 743,444 444,462 805,501 332,548 971,548 736,581 895,581 404,617 931,642 823,657 299,671 408,671
819,696 722,714
"""
PROJECTOR = """
322,85 244,121 336,126 780,133 257,148 293,189 613,226 266,238 252,259 607,287 335,299 249,330 645,347 384,370
166,428 162,433 685,500 365,489 733,566 262,568 917,637 644,642 805,659 364,654 839,732 711,731 274,698 381,713
702,773 611,781
"""
"""Thirty correspondences of a real run, in tenths of a pixel, at which OpenCV 4.14 stops with an internal error."""


def points(text: str) -> Float64:
    return np.array([pair.split(",") for pair in text.split()], np.float64) / 10


def test_sound_points_at_which_opencv_stops_have_their_epipolar_geometry_all_the_same() -> None:
    camera_px, projector_px = points(CAMERA), points(PROJECTOR)
    found = fundamental(camera_px, projector_px)
    assert found is not None
    matrix, inliers = found
    assert inliers.all()
    assert np.abs(np.linalg.det(matrix / np.linalg.norm(matrix))) < 1e-9
    assert epipolar_distance_px(matrix, camera_px, projector_px).max() < 1.0


def test_where_no_sample_helps_another_method_says_what_there_is(monkeypatch: pytest.MonkeyPatch) -> None:
    find = cv2.findFundamentalMat

    def stops(first: Float64, second: Float64, *how: object) -> object:
        if how[0] != cv2.RANSAC:
            raise cv2.error("setModelParameters")
        return find(first, second, *how)  # type: ignore[call-overload]

    monkeypatch.setattr(cv2, "findFundamentalMat", stops)
    found = fundamental(points(CAMERA), points(PROJECTOR))
    assert found is not None
    assert found[1].sum() >= 28


def test_points_that_fit_nothing_have_none() -> None:
    dice = np.random.default_rng(4)
    for count in (0, 7, 60):
        assert fundamental(dice.uniform(0, 300, (count, 2)), dice.uniform(0, 100, (count, 2))) is None
