"""Lenses with distortion, against OpenCV."""

from __future__ import annotations

import cv2
import numpy as np

from plugins.emulated.core.truth import Lens, Pose
from plugins.emulated.optics.rays import directions, project

LENS = Lens((1400, 1050), 2600.0, (702.3, 1080.5), (-0.08, 0.03))
POSE = Pose((0.2, -0.1, -1.1), (0.1, -0.2, 0.05))


def test_points_lie_where_opencv_says_and_rays_go_back_there() -> None:
    points = np.random.default_rng(1).uniform((-0.2, -0.3, -0.1), (0.2, 0.1, 0.1), (200, 3))
    at, _ = project(POSE, LENS, points)
    matrix = np.array([[2600.0, 0, 702.3], [0, 2600.0, 1080.5], [0, 0, 1]])
    move = -POSE.rotation @ np.asarray(POSE.position_m)
    coefficients = np.array([*LENS.distortion, 0.0, 0.0])
    wanted = cv2.projectPoints(points, np.asarray(POSE.rotation_vector), move, matrix, coefficients)[0][:, 0]
    np.testing.assert_allclose(at, wanted, atol=1e-6)
    rays = directions(POSE, LENS, at[:, 0], at[:, 1])
    straight = points - POSE.position_m
    np.testing.assert_allclose(rays, straight / np.linalg.norm(straight, axis=1, keepdims=True), atol=1e-8)
