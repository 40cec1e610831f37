"""The camera's own blur: what its optics and the interpolation of its colours do to every image.

It comes after the object's colour. So at a painted edge a camera pixel's light is an average over places of different
colour, and the shares of the projector's pixels in it are weighted by that colour (docs/decisions/0006).
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from numba import prange

from controller.core.arrays import FloatImage
from controller.core.jit import compiled
from controller.optics.calibrate.values import Metapixels

SHARPENING_ROUNDS = 4
LEAST_VARIANCE_PX2 = 0.1
"""A metapixel is never thought sharper than this: a projector pixel has a size of its own."""


def gaussian_taps(sigma_px: tuple[float, float, float]) -> FloatImage:
    """(3, 2 r + 1) float32: a sampled Gaussian a channel, each summing to 1; a single 1 where there is no blur."""
    radius = max(0, math.ceil(3 * max(sigma_px)))
    at = np.arange(-radius, radius + 1)
    taps = np.stack([np.exp(-0.5 * (at / max(sigma, 1e-3)) ** 2) for sigma in sigma_px])
    return np.asarray(taps / taps.sum(axis=1, keepdims=True), np.float32)


@compiled(parallel=True, fastmath=True)
def blur_planes(planes: FloatImage, taps: FloatImage, scratch: FloatImage, out: FloatImage) -> None:
    """Convolve (3, rows, columns) with ``taps`` along both axes, nothing beyond the border; its own transpose.

    ``scratch`` and ``out`` have the shape of ``planes``; ``out`` may be ``planes``.
    """
    channels, rows, columns = planes.shape
    radius = taps.shape[1] // 2
    for line in prange(channels * rows):
        c, y = line // rows, line % rows
        row = scratch[c, y]
        row[:] = 0
        for k in range(taps.shape[1]):
            shift, tap = k - radius, taps[c, k]
            first, last = max(0, -shift), min(columns, columns - shift)
            for x in range(first, last):
                row[x] += tap * planes[c, y, x + shift]
    for line in prange(channels * rows):
        c, y = line // rows, line % rows
        row = out[c, y]
        row[:] = 0
        for k in range(max(0, radius - y), min(taps.shape[1], rows - y + radius)):
            tap, from_row = taps[c, k], scratch[c, y + k - radius]
            for x in range(columns):
                row[x] += tap * from_row[x]


def sharpened(image: FloatImage, taps: FloatImage) -> FloatImage:
    """What (3, rows, columns) >= 0 was before the blur, as far as noise allows: a few rounds of Richardson and Lucy."""
    found = image.copy()
    scratch, blurred = np.empty_like(image), np.empty_like(image)
    faint = 1e-6 * float(image.max(initial=0)) + 1e-30
    for _ in range(SHARPENING_ROUNDS):
        blur_planes(found, taps, scratch, blurred)
        np.divide(image, np.maximum(blurred, faint), out=blurred)
        blur_planes(blurred, taps, scratch, blurred)
        found *= blurred
    return found


def without_blur(metapixels: Metapixels, sigma_px: tuple[float, float, float]) -> Metapixels:
    """The metapixels on the object: their covariances minus the camera's, averaged over its channels."""
    variance = float(np.mean(np.square(sigma_px)))
    if variance == 0:
        return metapixels
    xx, xy, yy = np.moveaxis(metapixels.covariance_px2.astype(np.float64), -1, 0)
    middle, apart = (xx + yy) / 2, np.hypot((xx - yy) / 2, xy)
    least = np.minimum(LEAST_VARIANCE_PX2, middle - apart)
    wide, narrow = (np.maximum(value - variance, least) for value in (middle + apart, middle - apart))
    with np.errstate(invalid="ignore", divide="ignore"):
        cosine, sine = np.where(apart > 0, (xx - yy) / 2 / apart, 1.0), np.where(apart > 0, xy / apart, 0.0)
    middle, apart = (wide + narrow) / 2, (wide - narrow) / 2
    covariance = np.stack([middle + apart * cosine, apart * sine, middle - apart * cosine], axis=-1)
    return dataclasses.replace(metapixels, covariance_px2=covariance.astype(np.float32))
