"""Why a projector pixel's metapixel is missing, or not to be trusted: a named reason for each."""

from __future__ import annotations

import enum
from typing import Final

import cv2
import numpy as np
import numpy.typing as npt

from controller.core import channels
from controller.core.arrays import Float64, FloatImage, Mask
from controller.optics.calibrate.metapixels.regularize import fill_holes
from controller.optics.calibrate.values import Metapixels

STEEPEST: Final = 4.0
"""Ratio of a metapixel's axes, 1 / cos 75.5 degrees; a steeper surface gives little light, and few camera pixels."""
SMOOTHED_PX: Final = 5


class PixelStatus(enum.IntEnum):
    """``GOOD``: fitted, on one surface, head-on enough. The order is that of the saved numbers.

    ``OUTSIDE``: no camera pixel sees it, nor pixels on both sides of it: past the object or the camera's picture
    ``SHADOW``: no camera pixel sees it, but pixels on both sides: its light falls behind an edge
    ``GRAZING``: seen or lit so slantingly that its area is not known well; its metapixel counts
    ``SATURATED``: the white image is not known where it lies, not even in the shortest exposure
    """

    GOOD = 0
    OUTSIDE = 1
    SHADOW = 2
    GRAZING = 3
    SATURATED = 4


def pixel_status(metapixels: Metapixels, white: FloatImage) -> npt.NDArray[np.uint8]:
    """(projector rows, columns) uint8 of ``PixelStatus``.

    ``white`` (camera rows, columns, 3): the projector's white image, NaN where every exposure was saturated
    """
    valid = metapixels.valid
    status = np.full(valid.shape, PixelStatus.OUTSIDE, np.uint8)
    status[~valid & _between(valid)] = PixelStatus.SHADOW
    status[valid] = PixelStatus.GOOD
    status[valid & (_slant(metapixels) > STEEPEST)] = PixelStatus.GRAZING
    unknown: Mask = np.asarray(~channels.finite(white))
    status[_on(fill_holes(metapixels), unknown)] = PixelStatus.SATURATED
    return status


def status_counts(found: npt.NDArray[np.uint8]) -> dict[str, int]:
    """How many projector pixels there are of each reason, by its name in lower case."""
    return {reason.name.lower(): int(np.count_nonzero(found == reason)) for reason in PixelStatus}


def _between(valid: Mask) -> Mask:
    """Pixels with valid ones on both sides of them, in their row or in their column."""
    inside = np.zeros_like(valid)
    for axis in (0, 1):
        before = np.logical_or.accumulate(valid, axis=axis)
        after = np.flip(np.logical_or.accumulate(np.flip(valid, axis), axis=axis), axis)
        inside |= before & after
    return inside


def _slant(metapixels: Metapixels) -> Float64:
    """(rows, columns): long over short axis of the pixel's area as the camera sees it; 1 where it is not known."""
    centre = np.where(metapixels.valid[..., None], metapixels.centre_px, np.nan).astype(np.float64)
    across, down = np.gradient(centre, axis=1), np.gradient(centre, axis=0)
    jacobian = np.stack([across, down], axis=-1)
    known = np.isfinite(jacobian).all(axis=(2, 3))
    side = (SMOOTHED_PX, SMOOTHED_PX)
    flat = np.where(known[..., None], jacobian.reshape(*known.shape, 4), 0.0)
    total = np.stack(
        [cv2.boxFilter(np.ascontiguousarray(flat[..., k]), -1, side, normalize=False) for k in range(4)], -1
    )
    count = cv2.boxFilter(known.astype(np.float64), -1, side, normalize=False)
    usable = count > 0.5
    mean = np.where(usable[..., None], total / np.maximum(count, 1)[..., None], np.array([1.0, 0, 0, 1]))
    sizes = np.linalg.svd(mean.reshape(*known.shape, 2, 2), compute_uv=False)
    return np.asarray(sizes[..., 0] / np.maximum(sizes[..., 1], 1e-6))


def _on(metapixels: Metapixels, marked: Mask) -> Mask:
    """Pixels whose metapixel has marked camera pixels within a standard deviation of its centre."""
    rows, columns = marked.shape
    hit = np.zeros(metapixels.valid.shape, np.bool_)
    at = np.argwhere(metapixels.valid & channels.finite(metapixels.centre_px))
    if not at.size or not marked.any():
        return hit
    centre = metapixels.centre_px[at[:, 0], at[:, 1]]
    spread = metapixels.covariance_px2[at[:, 0], at[:, 1]]
    sigma = float(np.sqrt(np.nanmedian(spread[:, [0, 2]])))
    side = 2 * max(1, round(sigma)) + 1
    wide = cv2.dilate(marked.astype(np.uint8), np.ones((side, side), np.uint8)).astype(np.bool_)
    x, y = np.round(centre).astype(np.int64).T
    inside = (x >= 0) & (x < columns) & (y >= 0) & (y < rows)
    hit[at[inside, 0], at[inside, 1]] = wide[y[inside], x[inside]]
    return hit
