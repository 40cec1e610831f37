from __future__ import annotations

import cv2
import numpy as np
import pytest

from controller.optics.calibrate.geometry.lenses import NAMED_PX, bend_px, bent
from controller.optics.calibrate.values import Pinhole

SIZE = (1400, 1050)
POINTS = np.array([(x, y) for x in (0.0, SIZE[0]) for y in (0.0, SIZE[1])])


def lens(k1: float, k2: float = 0.0, *, centre_y: float = 525.0) -> Pinhole:
    matrix = np.array([[2400.0, 0.0, 700.0], [0.0, 2400.0, centre_y], [0.0, 0.0, 1.0]])
    return Pinhole(matrix, np.array([k1, k2]), np.eye(3), np.zeros(3), SIZE)


@pytest.mark.parametrize(("k1", "k2"), [(0.02, 0.0), (-0.06, 0.0), (0.03, -0.05)])
@pytest.mark.parametrize("centre_y", [525.0, 1100.0])
def test_the_farthest_corner_moves_as_opencv_says(k1: float, k2: float, centre_y: float) -> None:
    bending = lens(k1, k2, centre_y=centre_y)
    rays = np.concatenate([(POINTS - bending.matrix[:2, 2]) / 2400.0, np.ones((4, 1))], axis=1)
    there, _ = cv2.projectPoints(
        rays, np.zeros(3), np.zeros(3), bending.matrix, np.array([k1, k2, 0.0, 0.0])
    )  # fmt: skip
    moved = np.linalg.norm(there.reshape(-1, 2) - POINTS, axis=1).max()
    assert bend_px(bending) == pytest.approx(moved, rel=1e-6)


def test_only_a_lens_that_bends_is_named() -> None:
    assert bent("left", lens(0.0)) is None
    small, large = (NAMED_PX * factor / bend_px(lens(1.0)) for factor in (0.9, 1.1))
    assert bent("left", lens(small)) is None
    said = bent("left", lens(-large))
    assert said is not None
    assert "projector left" in said
    assert "0.6 pixels" in said
