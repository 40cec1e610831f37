"""Maps between camera and projector: the one that the light transport wants, and its inverse.

``PhaseMap`` reaches beyond the decoded pixels and holds the projector's own blur. What a camera pixel's colours are
interpolated from lies around it, so the measured blur holds that, too. The transport interpolates by itself; the blur
that it wants is that of one sample.

``InverseMap`` is the map turned round: where the camera sees each projector pixel, and how large and skewed.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Final

import cv2
import numba
import numpy as np
import numpy.typing as npt

from controller.core import channels
from controller.core.arrays import Float64, FloatImage, Mask
from controller.core.jit import compiled
from controller.optics.calibrate.correspondence.smoothing import correct_for_paint, fit_curved
from controller.optics.calibrate.values import Correspondence, PhaseMap

FEWEST_PIXELS = 6
ENOUGH_PIXELS = 12
"""With fewer in the 3x3 projector pixels around, 5x5 are used."""
WORST_RESIDUAL_PX = 0.3
"""Projector px rms from the fitted plane; more means two surfaces, or none."""
MOST_OFF_CENTRE = (0.9, 1.4)
"""Projector px between the pixel and the mean of the points of its fit, for both windows; more is extrapolation."""
SURFACE_REACH_PX = 2.5
"""Reach of one surface around a camera pixel, in projector px at the map's typical slope."""


@dataclass(frozen=True, slots=True)
class InverseMap:
    """Per projector pixel, (rows, columns, ...) of the projector's image.

    ``centre_px`` (..., 2) float32 camera x, y; ``jacobian`` (..., 4) float32: dx/dp, dx/dq, dy/dp, dy/dq in camera
    px per projector px; both NaN where not ``valid``
    """

    centre_px: FloatImage
    jacobian: FloatImage
    valid: Mask


def invert_map(correspondence: Correspondence, size_px: tuple[int, int]) -> InverseMap:
    """Fit, for each projector pixel, the plane of projector positions over the camera pixels that look there.

    The plane goes over the camera, whose positions are exact, and is then solved for the projector pixel. Where the
    camera pixels lie on two surfaces, the one that more of them share is taken.
    """
    width, height = size_px
    first, order = _sort_by_cell(correspondence, size_px)
    slope = _slope_of(correspondence)
    centre = np.full((height, width, 2), np.nan, np.float32)
    jacobian = np.full((height, width, 4), np.nan, np.float32)
    valid = np.zeros((height, width), np.bool_)
    reach = SURFACE_REACH_PX / max(slope, 1e-3)
    _invert(correspondence.projector_px, first, order, reach, centre, jacobian, valid)
    return InverseMap(centre, jacobian, valid)


def cells_of(correspondence: Correspondence, size_px: tuple[int, int]) -> npt.NDArray[np.int32]:
    """(camera rows, columns) int32: row-major index of the projector pixel each camera pixel looks at, -1 for none."""
    width, height = size_px
    cells = np.full(correspondence.valid.shape, -1, np.int32)
    _cells(correspondence.projector_px, correspondence.valid, width, height, cells)
    return cells


def _sort_by_cell(
    correspondence: Correspondence, size_px: tuple[int, int]
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int32]]:
    """Camera pixels in the order of their projector pixels; those of cell i are order[first[i]:first[i + 1]]."""
    cells = cells_of(correspondence, size_px).ravel()
    first = np.zeros(size_px[0] * size_px[1] + 1, np.int64)
    first[1:] = np.cumsum(np.bincount(cells[cells >= 0], minlength=first.size - 1))
    order = np.empty(first[-1], np.int32)
    _fill(cells, first[:-1].copy(), order)
    return first, order


def _slope_of(correspondence: Correspondence) -> float:
    """Median of |d projector / d camera| along rows."""
    change = np.hypot(*np.moveaxis(np.diff(correspondence.projector_px[::4], axis=1), 2, 0))
    change = change[np.isfinite(change)]
    return float(np.median(change)) if change.size else 1.0


@compiled()
def _cells(position: FloatImage, valid: Mask, width: int, height: int, cells: npt.NDArray[np.int32]) -> None:
    for row in range(valid.shape[0]):
        for column in range(valid.shape[1]):
            if valid[row, column]:
                x = int(np.floor(position[row, column, 0] + 0.5))
                y = int(np.floor(position[row, column, 1] + 0.5))
                if 0 <= x < width and 0 <= y < height:
                    cells[row, column] = y * width + x


@compiled()
def _fill(cells: npt.NDArray[np.int32], next_free: npt.NDArray[np.int64], order: npt.NDArray[np.int32]) -> None:
    for index in range(cells.size):
        cell = cells[index]
        if cell >= 0:
            order[next_free[cell]] = index
            next_free[cell] += 1


@compiled(parallel=True)
def _invert(
    position: FloatImage,
    first: npt.NDArray[np.int64],
    order: npt.NDArray[np.int32],
    reach: float,
    centre: FloatImage,
    jacobian: FloatImage,
    valid: Mask,
) -> None:
    rows, columns = valid.shape
    for row in numba.prange(rows):
        for column in range(columns):
            fit = np.empty(8)
            if _fit_pixel(position, first, order, row, column, columns, rows, reach, fit):
                centre[row, column, 0], centre[row, column, 1] = fit[0], fit[1]
                for k in range(4):
                    jacobian[row, column, k] = fit[2 + k]
                valid[row, column] = True


@compiled()
def _fit_pixel(
    position: FloatImage,
    first: npt.NDArray[np.int64],
    order: npt.NDArray[np.int32],
    row: int,
    column: int,
    columns: int,
    rows: int,
    reach: float,
    fit: npt.NDArray[np.float64],
) -> bool:
    """Widen the window while there are too few camera pixels; go to the larger surface if there are two."""
    pixels = np.empty(1024, np.int32)
    most_off = MOST_OFF_CENTRE[0]
    n = _gather(first, order, row, column, columns, rows, 1, pixels)
    if n < ENOUGH_PIXELS:
        n = _gather(first, order, row, column, columns, rows, 2, pixels)
        most_off = MOST_OFF_CENTRE[1]
    if n < FEWEST_PIXELS:
        return False
    ok = _fit_plane(position, pixels[:n], row, column, fit)
    if ok and fit[6] <= WORST_RESIDUAL_PX:
        return bool(fit[7] <= most_off)
    n = _keep_largest(pixels[:n], position.shape[1], reach)
    if n < FEWEST_PIXELS or not _fit_plane(position, pixels[:n], row, column, fit):
        return False
    return bool(fit[6] <= WORST_RESIDUAL_PX and fit[7] <= most_off)


@compiled()
def _gather(
    first: npt.NDArray[np.int64],
    order: npt.NDArray[np.int32],
    row: int,
    column: int,
    columns: int,
    rows: int,
    radius: int,
    pixels: npt.NDArray[np.int32],
) -> int:
    n = 0
    for r in range(max(row - radius, 0), min(row + radius + 1, rows)):
        start = r * columns + max(column - radius, 0)
        stop = r * columns + min(column + radius + 1, columns)
        # cells that lie side by side are side by side in the order, too
        for k in range(first[start], first[stop]):
            if n < pixels.size:
                pixels[n] = order[k]
                n += 1
    return n


@compiled()
def _fit_plane(
    position: FloatImage, pixels: npt.NDArray[np.int32], row: int, column: int, fit: npt.NDArray[np.float64]
) -> bool:
    """Least squares of (p, q) - pixel = a + B (u - mean u).

    ``fit`` receives the centre's x, y; J = B^-1; the residual's rms; the mean's distance from the pixel.
    """
    width = position.shape[1]
    n = float(pixels.size)
    mx = my = mp = mq = 0.0
    for index in pixels:
        r, c = index // width, index % width
        mx += c
        my += r
        mp += position[r, c, 0] - column
        mq += position[r, c, 1] - row
    mx, my, mp, mq = mx / n, my / n, mp / n, mq / n
    sxx = sxy = syy = xp = yp = xq = yq = pp = 0.0
    for index in pixels:
        r, c = index // width, index % width
        dx, dy = c - mx, r - my
        p, q = position[r, c, 0] - column - mp, position[r, c, 1] - row - mq
        sxx += dx * dx
        sxy += dx * dy
        syy += dy * dy
        xp += dx * p
        yp += dy * p
        xq += dx * q
        yq += dy * q
        pp += p * p + q * q
    spread = sxx * syy - sxy * sxy
    if spread < 1e-3 * n * n:
        return False
    px, py = (syy * xp - sxy * yp) / spread, (sxx * yp - sxy * xp) / spread
    qx, qy = (syy * xq - sxy * yq) / spread, (sxx * yq - sxy * xq) / spread
    determinant = px * qy - py * qx
    if abs(determinant) < 1e-4:
        return False
    fit[2], fit[3], fit[4], fit[5] = qy / determinant, -py / determinant, -qx / determinant, px / determinant
    fit[0] = mx - fit[2] * mp - fit[3] * mq
    fit[1] = my - fit[4] * mp - fit[5] * mq
    fit[6] = np.sqrt(max(pp - px * xp - py * yp - qx * xq - qy * yq, 0.0) / n)
    fit[7] = max(abs(mp), abs(mq))
    return True


@compiled()
def _keep_largest(pixels: npt.NDArray[np.int32], width: int, reach: float) -> int:
    """Move the pixels around the one that has the most others within reach to the front; return how many."""
    best, most = 0, 0
    for k in range(pixels.size):
        near = 0
        for other in pixels:
            if _apart(pixels[k], other, width) <= reach:
                near += 1
        if near > most:
            best, most = pixels[k], near
    kept = 0
    for k in range(pixels.size):
        if _apart(best, pixels[k], width) <= reach:
            pixels[kept] = pixels[k]
            kept += 1
    return kept


@compiled()
def _apart(one: int, other: int, width: int) -> float:
    dx, dy = one % width - other % width, one // width - other // width
    return float(np.sqrt(dx * dx + dy * dy))


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
    blur = _without_interpolation(blur_px2.astype(np.float64), slope, taken)
    spread = _nearest(blur.astype(np.float32), blur_valid & known)
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
    nearest: FloatImage = values.reshape(-1, 3)[np.maximum(at, 0)]
    nearest[at < 0] = np.nan
    return nearest


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
    continued = np.where(correspondence.valid[..., None], position, np.float32(np.nan))
    continued[missing] = from_px + np.stack([a * dx + b * dy, c * dx + d * dy], axis=-1)
    return np.asarray(continued, np.float32)
