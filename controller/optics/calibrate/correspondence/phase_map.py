"""The phase map as the light transport wants it: beyond the decoded pixels, and with the projector's own blur.

What a camera pixel's colours are interpolated from lies around it, so the measured blur holds that, too. The transport
interpolates by itself; the blur that it wants is that of one sample.
"""

from __future__ import annotations

import dataclasses
from typing import Final

import cv2
import numpy as np
import numpy.typing as npt

from controller.core import channels
from controller.core.arrays import Float64, FloatImage, Mask
from controller.optics.calibrate.correspondence.inverse_map import InverseMap
from controller.optics.calibrate.correspondence.smoothing import correct_for_paint, fit_curved
from controller.optics.calibrate.values import Correspondence, PhaseMap

INTERPOLATION_PX2: Final = np.array([1 / 2, 1 / 4, 1 / 2])
"""Variance along an axis of bilinear interpolation, averaged over the sites: red, green, blue."""
LEAST_VARIANCE_PX2: Final = 0.06
"""Of an evenly lit projector pixel: 1/12, of a somewhat smaller square."""
STEADY_PX: Final = 5
"""The blur changes slowly: its median over this many projector pixels a side is used."""
MOST_CORRELATED: Final = 0.9
FARTHEST_PX: Final = 12
"""Camera pixels by which the map is extrapolated: to the frame's border, and over small gaps."""


def make_phase_map(
    correspondence: Correspondence,
    inverse: InverseMap,
    blur_px2: FloatImage,
    blur_valid: Mask,
    *,
    light: tuple[float, float, float] = (1.0, 1.0, 1.0),
    interpolated: bool = True,
    white: FloatImage | None = None,
) -> PhaseMap:
    """The map that ``LightTransport`` is built from.

    Parameters
    ----------
    inverse, blur_px2 (rows, columns, 3), blur_valid : of the projector's pixels, measured in developed pictures
    light : strength of the camera's channels; stronger ones weigh more in the measured blur
    interpolated : whether the camera has one colour a sample
    white : (camera rows, columns) light of the projector's white; with it and ``as_seen_px``, each sample looks at the
        mean position of its own light: freed of the interpolation's pull towards paler paint, not of the lens's
    """
    slope, known = _slopes(inverse)
    taken = float(np.average(INTERPOLATION_PX2, weights=light)) if interpolated else 0.0
    own = _without_interpolation(blur_px2.astype(np.float64), slope, taken)
    spread = _nearest(own.astype(np.float32), blur_valid & known)
    for k in range(3) if (blur_valid & known).any() else ():
        spread[..., k] = cv2.medianBlur(np.ascontiguousarray(spread[..., k]), STEADY_PX)
    if white is not None and correspondence.as_seen_px is not None:
        at = correct_for_paint(correspondence.as_seen_px, correspondence.valid, white, taken)
        at = fit_curved(at, correspondence.valid, correspondence.projector_px)
        correspondence = dataclasses.replace(correspondence, projector_px=at)
    return PhaseMap(_continued(correspondence, slope, known), spread)


def _slopes(inverse: InverseMap) -> tuple[Float64, Mask]:
    """d projector / d camera (rows, columns, 4) of the projector's pixels, and where it is known."""
    a, b, c, d = np.moveaxis(inverse.jacobian.astype(np.float64), -1, 0)
    with np.errstate(invalid="ignore", divide="ignore"):
        slope = np.stack([d, -b, -c, a], axis=-1) / (a * d - b * c)[..., None]
    known: Mask = inverse.valid & channels.finite(slope)
    return np.where(known[..., None], slope, 0), known


def _without_interpolation(blur_px2: Float64, slope: Float64, variance: float) -> Float64:
    a, b, c, d = np.moveaxis(slope, -1, 0)
    xx = np.maximum(blur_px2[..., 0] - variance * (a * a + b * b), LEAST_VARIANCE_PX2)
    yy = np.maximum(blur_px2[..., 2] - variance * (c * c + d * d), LEAST_VARIANCE_PX2)
    most = MOST_CORRELATED * np.sqrt(xx * yy)
    xy = np.clip(blur_px2[..., 1] - variance * (a * c + b * d), -most, most)
    return np.stack([xx, xy, yy], axis=-1)


def _labels(known: Mask) -> tuple[npt.NDArray[np.int64], FloatImage]:
    """For each pixel the flat index of the nearest known one, and how far that is; -1 where none is known."""
    if not known.any():
        return np.full(known.shape, -1, np.int64), np.full(known.shape, np.inf, np.float32)
    distance, labels = cv2.distanceTransformWithLabels(
        (~known).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    at = np.zeros(int(labels.max()) + 1, np.int64)
    at[labels[known]] = np.flatnonzero(known)
    return at[labels], np.asarray(distance, np.float32)


def _nearest(values: FloatImage, known: Mask) -> FloatImage:
    at, _ = _labels(known)
    found: FloatImage = values.reshape(-1, 3)[np.maximum(at, 0)]
    found[at < 0] = np.nan
    return found


def _nearest_pixel(
    position_px: FloatImage, shape: tuple[int, ...]
) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.int32]]:
    """Row and column of the projector's pixel nearest to each position (..., 2)."""
    x, y = (
        np.clip(np.nan_to_num(np.rint(position_px[..., axis])), 0, shape[1 - axis] - 1).astype(np.int32)
        for axis in range(2)
    )
    return y, x


def _continued(correspondence: Correspondence, slope: Float64, known: Mask) -> FloatImage:
    """The camera's map, continued along the plane at the nearest decoded pixel whose slope is known."""
    position = correspondence.projector_px
    sure = correspondence.valid & known[_nearest_pixel(position, known.shape)]
    at, distance = _labels(sure)
    missing = ~correspondence.valid & (distance <= FARTHEST_PX)
    source = at[missing]
    row, column = np.nonzero(missing)
    width = position.shape[1]
    dx, dy = column - source % width, row - source // width
    from_px = position.reshape(-1, 2)[source]
    a, b, c, d = np.moveaxis(slope[_nearest_pixel(from_px, known.shape)], -1, 0)
    whole = np.where(correspondence.valid[..., None], position, np.float32(np.nan))
    whole[missing] = from_px + np.stack([a * dx + b * dy, c * dx + d * dy], axis=-1)
    return np.asarray(whole, np.float32)
