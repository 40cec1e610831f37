"""Random stages: metapixels anywhere in the camera image, so that folds, occlusions and misses all occur."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from controller.core.arrays import FloatImage
from controller.optics.calibrate.values import Calibration, Metapixels, ProjectorCalibration, Radiometry
from controller.optics.transport import LightTransport


def random_calibration(
    seed: int,
    *,
    camera: tuple[int, int] = (70, 300),
    sizes: tuple[tuple[int, int], ...] = ((9, 12), (7, 5)),
    largest_sigma: float = 3.0,
    masked: bool = True,
) -> Calibration:
    """Centres drawn without order over and beyond the image; some metapixels invalid, NaN or degenerate."""
    rng = np.random.default_rng(seed)
    projectors = []
    for n, size in enumerate(sizes):
        centre = rng.uniform((-6, -6), (camera[1] + 6, camera[0] + 6), (*size, 2)).astype(np.float32)
        sigma = rng.uniform(0.3, largest_sigma, (2, *size))
        angle = rng.uniform(0, np.pi, size)
        c, s = np.cos(angle), np.sin(angle)
        xx, yy = (c * sigma[0]) ** 2 + (s * sigma[1]) ** 2, (s * sigma[0]) ** 2 + (c * sigma[1]) ** 2
        covariance = np.stack([xx, c * s * (sigma[0] ** 2 - sigma[1] ** 2), yy], -1).astype(np.float32)
        valid = rng.random(size) > 0.1
        centre[~valid] = np.nan
        covariance[0, 0] = 0
        mixing = np.eye(3) + rng.uniform(-0.02, 0.15, (3, 3))
        mixing /= mixing.sum(1, keepdims=True)
        white = rng.uniform(0.1, 2, (*camera, 3)).astype(np.float32)
        white[rng.random(camera) < 0.1] = 0
        projectors.append(
            ProjectorCalibration(
                f"projector {n}",
                Metapixels(centre, covariance, valid),
                Radiometry(np.tile(np.linspace(0, 1, 256) ** 2.2, (3, 1)), mixing),
                white,
            )
        )
    mask = rng.random(camera) > 0.05 if masked else np.ones(camera, np.bool_)
    black = rng.uniform(0, 0.01, (*camera, 3)).astype(np.float32)
    return Calibration(tuple(projectors), black, mask, np.eye(3))


def random_frames(transport: LightTransport, seed: int = 0) -> list[FloatImage]:
    rng = np.random.default_rng(seed)
    return [rng.random((*size, 3), np.float32) for size in transport.sizes]


def products(transport: LightTransport, frames: list[FloatImage], r: FloatImage) -> tuple[float, float]:
    """<T p, r> and <p, T' r>: the same where the adjoint is the transpose."""
    forward = np.vdot(transport.forward(frames).astype(np.float64), r)
    backward = sum(np.vdot(a.astype(np.float64), b) for a, b in zip(transport.adjoint(r), frames, strict=True))
    return float(forward), float(backward)


@pytest.fixture
def stage() -> Callable[..., Calibration]:
    return random_calibration
