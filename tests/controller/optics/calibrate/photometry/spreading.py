"""Light that lenses spread widely, for stages that a test makes up."""

from __future__ import annotations

from functools import cache

import numpy as np
from scipy import fft

from controller.core.arrays import Float64

HALF_PX = 30.0
"""Of stray light: from there on it falls with the third power of the angle, as it does in lenses."""


def by_angle(picture: Float64) -> Float64:
    """Scattered by a law of angles; ``picture``: (rows, columns) or with channels, dark around."""
    rows, columns = picture.shape[:2]
    size, spread = _stray(rows, columns)
    light = picture.reshape(rows, columns, -1)
    scattered = fft.irfft2(fft.rfft2(light, size, axes=(0, 1)) * spread[..., None], size, axes=(0, 1))
    return np.asarray(scattered[rows : 2 * rows, columns : 2 * columns].reshape(picture.shape), np.float64)


@cache
def _stray(rows: int, columns: int) -> tuple[tuple[int, int], Float64]:
    y, x = np.mgrid[-rows : rows + 1, -columns : columns + 1]
    spread = (1 + (x**2 + y**2) / HALF_PX**2) ** -1.5
    size = (fft.next_fast_len(2 * rows + 1, real=True), fft.next_fast_len(2 * columns + 1, real=True))
    return size, fft.rfft2(spread / spread.sum(), size)


def blurred(picture: Float64, sigma_px: float) -> Float64:
    """A Gaussian, mirrored at the edges: for a wide one far less work than ``cv2.GaussianBlur``."""
    factors = [np.exp(-0.5 * (np.pi * np.arange(count) * sigma_px / count) ** 2) for count in picture.shape[:2]]
    both = np.multiply.outer(*factors).reshape(picture.shape[:2] + (1,) * (picture.ndim - 2))
    return np.asarray(fft.idctn(fft.dctn(picture, axes=(0, 1)) * both, axes=(0, 1)), np.float64)
