"""Small stages with a known light transport: projectors on a coloured plane, turned a little against each other."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from controller.optics.calibrate.values import Calibration, Metapixels, ProjectorCalibration, Radiometry


def plane_calibration(
    seed: int = 0,
    *,
    projector: tuple[int, int] = (20, 26),
    camera: tuple[int, int] = (60, 80),
    projectors: int = 2,
    spill: float = 0.06,
    albedo_from: float = 0.3,
) -> Calibration:
    """White images hold the albedo; mixing, black level and shading differ from projector to projector."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[0 : camera[0], 0 : camera[1]] / np.array(camera)[:, None, None]
    albedo = np.stack([albedo_from + 0.6 * (np.floor(5 * x) + np.floor(4 * y)) % 2, 0.5 + 0.3 * x, 0.7 - 0.3 * y], -1)
    made = []
    for n in range(projectors):
        row, column = np.mgrid[0 : projector[0], 0 : projector[1]]
        pitch = camera[1] / projector[1], camera[0] / projector[0]
        turn = 0.05 * (n - 0.5)
        centre = np.stack([(column + 0.5) * pitch[0] + turn * row, (row + 0.5) * pitch[1] - turn * column], -1)
        centre += rng.uniform(-0.5, 0.5, 2) + rng.normal(0, 0.05, centre.shape)
        variance = (0.45 * np.array(pitch)) ** 2
        covariance = np.broadcast_to(np.array([variance[0], 0.1, variance[1]]), (*projector, 3))
        mixing = np.eye(3) * (1 - spill * n) + spill * n / 3
        mixing[0, 1:] -= 0.01 * np.array([1, -1])
        white = albedo * (0.5 + 0.2 * n + 0.2 * (x if n else 1 - x))[..., None]
        response = np.tile(np.linspace(0, 1, 256) ** 2.2, (3, 1))
        metapixels = Metapixels(centre.astype(np.float32), covariance.astype(np.float32), np.ones(projector, np.bool_))
        made.append(
            ProjectorCalibration(f"projector {n}", metapixels, Radiometry(response, mixing), white.astype(np.float32))
        )
    black = np.full((*camera, 3), 0.002, np.float32)
    to_xyz = np.array([[0.41, 0.36, 0.18], [0.21, 0.72, 0.07], [0.02, 0.12, 0.95]])
    return Calibration(tuple(made), black, np.ones(camera, np.bool_), to_xyz)


@pytest.fixture
def stage() -> Callable[..., Calibration]:
    return plane_calibration
