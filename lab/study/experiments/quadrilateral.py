"""Projector pixels as quadrilaterals, the model that the paper compares its metapixels with.

A pixel reaches half way to its neighbours, so that the quadrilaterals tile the camera image; a camera pixel belongs to
each by the area that it covers. The model knows no blur, and no gap between the pixels.
"""

from __future__ import annotations

from typing import Final

import numba
import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from controller.core import channels
from controller.core.arrays import Float64, FloatImage
from controller.core.jit import compiled
from controller.optics.calibrate.values import Metapixels

LARGEST_PX: Final = 200
"""A quadrilateral wider or higher than this spans an edge in depth; it is left out."""
_MOST_CORNERS: Final = 12
_AROUND: Final = ((0, 0), (0, 1), (1, 1), (1, 0))


def quadrilateral_corners(metapixels: Metapixels) -> FloatImage:
    """Corners half way to the neighbours' centres, in camera pixels.

    Where all four pixels round a corner are valid, it is the mean of their centres; elsewhere each continues its own
    slope. Returns (rows, columns, 4, 2) float32 x and y, in the order upper left, upper right, lower right, lower left
    of the projector's image; NaN where a pixel is not valid or has no valid neighbour along an axis.
    """
    valid = metapixels.valid
    centre = np.where(valid[..., None], metapixels.centre_px, np.nan).astype(np.float64)
    slopes = _slope(centre, 1), _slope(centre, 0)
    rows, columns = valid.shape
    total, count = np.zeros((rows + 1, columns + 1, 2)), np.zeros((rows + 1, columns + 1, 1))
    plain = np.zeros_like(total)
    for down, across in _AROUND:
        place = (slice(down, down + rows), slice(across, across + columns))
        reached = centre + (across - 0.5) * slopes[0] + (down - 0.5) * slopes[1]
        known = np.isfinite(reached).all(axis=2, keepdims=True)
        total[place] += np.where(known, reached, 0)
        plain[place] += np.where(known, centre, 0)
        count[place] += known
    with np.errstate(invalid="ignore", divide="ignore"):
        corner = np.where(count == 4, plain, total) / count
    quads = np.stack([corner[i : i + rows, j : j + columns] for i, j in _AROUND], axis=2)
    quads[~valid | ~channels.finite(slopes[0] + slopes[1])] = np.nan
    return quads.astype(np.float32)


def _slope(centre: Float64, axis: int) -> Float64:
    """Change of the centre per projector pixel: from both neighbours where they are valid, else from one."""
    step = np.diff(centre, axis=axis)
    gap = np.full_like(np.take(centre, [0], axis=axis), np.nan)
    both = np.stack([np.concatenate([gap, step], axis=axis), np.concatenate([step, gap], axis=axis)])
    known = np.isfinite(both)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.where(known, both, 0).sum(axis=0) / known.sum(axis=0))


def quadrilateral_weights(metapixels: Metapixels, camera_shape: tuple[int, int]) -> sp.csr_matrix[np.float64]:
    """(camera pixels, projector pixels), row-major both: the share of each camera pixel's area that each pixel covers.

    Weights are in [0, 1]; a row divided by its sum is the shares of the light, as for Gaussians.
    """
    quads = quadrilateral_corners(metapixels).reshape(-1, 4, 2)
    first = np.zeros(len(quads) + 1, np.int64)
    first[1:] = np.cumsum(_boxes(quads, camera_shape))
    row, value = np.zeros(first[-1], np.int64), np.zeros(first[-1])
    _cover(quads, camera_shape, first, row, value)
    shape = (camera_shape[0] * camera_shape[1], len(quads))
    weights = sp.csr_matrix(sp.csc_matrix((value, row, first), shape=shape))
    weights.eliminate_zeros()
    return weights


@compiled()
def _extent(quad: FloatImage, shape: tuple[int, int]) -> tuple[int, int, int, int]:
    """Camera pixels that a quadrilateral can touch: top, left, bottom, right, the last two not included."""
    low_x, high_x = quad[:, 0].min(), quad[:, 0].max()
    low_y, high_y = quad[:, 1].min(), quad[:, 1].max()
    # NaN fails the comparison
    if not (high_x - low_x < LARGEST_PX and high_y - low_y < LARGEST_PX and abs(low_x) < 1e6 and abs(low_y) < 1e6):
        return 0, 0, 0, 0
    top, left = max(int(np.floor(low_y + 0.5)), 0), max(int(np.floor(low_x + 0.5)), 0)
    bottom, right = min(int(np.ceil(high_y + 0.5)), shape[0]), min(int(np.ceil(high_x + 0.5)), shape[1])
    return top, left, max(bottom, top), max(right, left)


@compiled()
def _boxes(quads: FloatImage, shape: tuple[int, int]) -> npt.NDArray[np.int64]:
    sizes = np.zeros(quads.shape[0], np.int64)
    for v in range(quads.shape[0]):
        top, left, bottom, right = _extent(quads[v], shape)
        sizes[v] = (bottom - top) * (right - left)
    return sizes


@compiled(parallel=True)
def _cover(
    quads: FloatImage, shape: tuple[int, int], first: npt.NDArray[np.int64], row: npt.NDArray[np.int64], value: Float64
) -> None:
    for v in numba.prange(quads.shape[0]):
        top, left, bottom, right = _extent(quads[v], shape)
        k = first[v]
        work = np.empty((2, _MOST_CORNERS, 2))
        for y in range(top, bottom):
            for x in range(left, right):
                row[k] = y * shape[1] + x
                value[k] = min(_area_in_pixel(quads[v], x, y, work), 1.0)
                k += 1


@compiled()
def _area_in_pixel(quad: FloatImage, x: int, y: int, work: Float64) -> float:
    """Area of a quadrilateral inside a camera pixel, clipped at its four sides (Sutherland and Hodgman 1974)."""
    old, new = work[0], work[1]
    n = 4
    for k in range(4):
        old[k, 0], old[k, 1] = quad[k, 0] - x, quad[k, 1] - y
    for side in range(4):
        axis, sign = side // 2, 1.0 if side % 2 == 0 else -1.0
        count = 0
        for k in range(n):
            a, b = old[k], old[(k + 1) % n]
            inside, after = 0.5 - sign * a[axis], 0.5 - sign * b[axis]
            if inside >= 0:
                new[count] = a
                count += 1
            if (inside >= 0) != (after >= 0):
                t = inside / (inside - after)
                new[count, 0], new[count, 1] = a[0] + t * (b[0] - a[0]), a[1] + t * (b[1] - a[1])
                count += 1
        old, new = new, old
        n = count
    doubled = 0.0
    for k in range(n):
        a, b = old[k], old[(k + 1) % n]
        doubled += a[0] * b[1] - a[1] * b[0]
    return abs(doubled) / 2
