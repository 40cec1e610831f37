"""Dense object points from calibrated poses: one inverse depth a camera pixel, and a plane through each neighbourhood.

The inverse depth of a plane is affine in the undistorted image coordinates, so the plane fit is a 3x3 linear system.
"""

from __future__ import annotations

from typing import Final, TypeAlias

import numba
import numpy as np

from controller.core.arrays import Float64, FloatImage, Mask
from controller.core.jit import compiled
from controller.optics.calibrate.geometry.normal_equations import straightening

LANES: Final = 256
"""Pixels of a row whose planes are fitted together."""
XX, XY, YY, X, Y, ONE, X_VALUE, Y_VALUE, VALUE = range(9)
"""Sums over a neighbourhood, times the neighbours' weights: of products of their places and values."""
_SHARPEST = 0.02  # relative depth step between neighbours beyond which they lie on different surfaces


@compiled(parallel=True)
def projector_rays(projector_px: FloatImage, lenses: Float64) -> FloatImage:
    """(N, rows, columns, 2) float32 undistorted x, y at depth 1 of what each camera pixel sees; NaN where it is NaN.

    ``projector_px`` (N, rows, columns, 2) float32; ``lenses`` (N, 4) float64: log f, cx, cy, k1
    """
    projectors, rows, columns, _ = projector_px.shape
    out = np.empty(projector_px.shape, dtype=np.float32)
    for n in range(projectors):
        focal, k1 = np.exp(lenses[n, 0]), lenses[n, 3]
        for row in numba.prange(rows):
            for column in range(columns):
                x = (projector_px[n, row, column, 0] - lenses[n, 1]) / focal
                y = (projector_px[n, row, column, 1] - lenses[n, 2]) / focal
                s = straightening(k1, x * x + y * y)
                out[n, row, column, 0], out[n, row, column, 1] = s * x, s * y
    return out


@compiled(parallel=True)
def inverse_depth_map(
    rays: FloatImage,
    slopes: FloatImage,
    seen: Mask,
    focal_px: Float64,
    rotations: Float64,
    centres: Float64,
    noise_px: float,
) -> tuple[FloatImage, FloatImage, FloatImage]:
    """Robust multi-view least squares for every camera pixel.

    Parameters
    ----------
    rays : (rows, columns, 2) float32, undistorted x, y at depth 1
    slopes : (N, rows, columns, 2) float32, undistorted x, y at depth 1 in each projector; ``seen`` (N, rows, columns)
    focal_px : (N,), which make pixels of them; ``rotations`` (N, 3, 3); ``centres`` (N, 3)
    noise_px : projector coordinates farther than 2.4 times this from the model count less (Cauchy)

    Returns
    -------
    inverse depth; rms residual in projector pixels over the projectors that agree within four times the noise; and the
    inverse depth's change per projector pixel, all projectors together (times the noise it is the standard deviation).
    NaN where none sees the pixel, or where several do and fewer than two agree
    """
    projectors, rows, columns = seen.shape
    inverse = np.empty((rows, columns), np.float32)
    residual, leverage = np.empty_like(inverse), np.empty_like(inverse)
    turned = np.empty((projectors, 3))
    for n in range(projectors):
        turned[n] = rotations[n] @ centres[n]
    for row in numba.prange(rows):
        for column in range(columns):
            ray, here = rays[row, column], (slopes[:, row, column], seen[:, row, column])
            fit = _inverse_depth(ray, here, focal_px, rotations, turned, noise_px)
            inverse[row, column], residual[row, column], leverage[row, column] = fit
    return inverse, residual, leverage


@compiled()
def _inverse_depth(
    ray: FloatImage,
    observed: tuple[FloatImage, Mask],
    focal_px: Float64,
    rotations: Float64,
    turned: Float64,
    noise_px: float,
) -> tuple[float, float, float]:
    """As ``inverse_depth_map``, of one camera pixel.

    ``ray`` (2,); ``observed``: slopes (N, 2) in each projector, and by which (N,) the pixel is seen; ``turned`` (N, 3):
    the projectors' centres in their own frames
    """
    slopes, seen = observed
    scale, limit = (2.4 * noise_px) ** 2, 2.0 * (4.0 * noise_px) ** 2
    inverse = 0.0
    for iteration in range(6):
        top, bottom, squares, count, agreeing = 0.0, 0.0, 0.0, 0, 0
        for n in range(seen.size):
            if not seen[n]:
                continue
            turn, u, v = rotations[n], slopes[n, 0], slopes[n, 1]
            # the camera's ray in the projector's frame
            x = turn[0, 0] * ray[0] + turn[0, 1] * ray[1] + turn[0, 2]
            y = turn[1, 0] * ray[0] + turn[1, 1] * ray[1] + turn[1, 2]
            z = turn[2, 0] * ray[0] + turn[2, 1] * ray[1] + turn[2, 2]
            # (x, y, z) - inverse turned is parallel to (u, v, 1): two equations, linear in the inverse depth
            wanted_x, wanted_y = x - u * z, y - v * z
            factor_x, factor_y = turned[n, 0] - u * turned[n, 2], turned[n, 1] - v * turned[n, 2]
            depth = z - inverse * turned[n, 2]
            # of squares in projector pixels
            gain = (focal_px[n] / depth) ** 2 if depth > 1e-6 else 1e-12
            error = gain * ((wanted_x - inverse * factor_x) ** 2 + (wanted_y - inverse * factor_y) ** 2)
            weight = gain if iteration < 2 else gain / (1.0 + error / scale)
            top += weight * (wanted_x * factor_x + wanted_y * factor_y)
            bottom += weight * (factor_x * factor_x + factor_y * factor_y)
            count += 1
            if error < limit:
                squares += error
                agreeing += 1
        if count == 0 or bottom <= 0.0:
            break
        if iteration < 5:
            inverse = top / bottom
        elif agreeing >= min(count, 2):
            return inverse, np.sqrt(squares / (2 * agreeing)), 1.0 / np.sqrt(bottom)
    return np.nan, np.nan, np.nan


@compiled(parallel=True)
def fit_planes(inverse: FloatImage, rays: FloatImage, radius: int) -> tuple[FloatImage, FloatImage]:
    """Fit a plane to the neighbourhood of every pixel, robustly and without crossing depth steps.

    Parameters
    ----------
    inverse : (rows, columns) float32, NaN where unknown
    rays : (rows, columns, 2) float32
    radius : the neighbourhood is (2 radius + 1) pixels square

    Returns
    -------
    the planes' inverse depth at each pixel, NaN where fewer than a third of the neighbours share its surface or it lies
    far off the plane they span; and their unit normals towards the camera (rows, columns, 3)
    """
    rows, columns = inverse.shape
    smooth = np.full((rows, columns), np.nan, dtype=np.float32)
    normals = np.full((rows, columns, 3), np.nan, dtype=np.float32)
    across, down = rays[:, :, 0].copy(), rays[:, :, 1].copy()
    for row in numba.prange(rows):
        for first in range(0, columns, LANES):
            last = min(first + LANES, columns)
            if np.any(inverse[row, first:last] > 0.0):
                _planes_at(
                    (inverse, across, down), radius, row, first, smooth[row, first:last], normals[row, first:last]
                )
    return smooth, normals


Surface: TypeAlias = tuple[FloatImage, FloatImage, FloatImage]
"""Inverse depth, and x and y at depth 1; all (rows, columns)."""


@compiled()
def _planes_at(surface: Surface, radius: int, row: int, first: int, smooth: FloatImage, normals: FloatImage) -> None:
    """The planes of neighbouring pixels of a row, from column ``first``: (pixels,) and (pixels, 3)."""
    here, fewest = surface[0][row, first : first + smooth.size], max(6, (2 * radius + 1) ** 2 // 3)
    plane, spread, count = np.zeros((3, here.size)), np.full(here.size, np.inf), np.zeros(here.size)
    plane[2] = here
    _refit(surface, radius, row, first, plane, spread, count)
    good = count >= fewest
    _spread(surface, radius, row, first, plane, spread)
    for _ in range(2):
        _refit(surface, radius, row, first, plane, spread, count)
    for k in range(here.size):
        a, b, c = plane[0, k], plane[1, k], plane[2, k]
        if not (good[k] and count[k] >= fewest and c > 0.0) or (here[k] - c) ** 2 > 25.0 * spread[k] + 1e-16:
            continue
        # a X + b Y + cz Z = 1 is the plane; its gradient points away from the camera
        cz = c - a * surface[1][row, first + k] - b * surface[2][row, first + k]
        length = np.sqrt(a * a + b * b + cz * cz)
        smooth[k] = c
        normals[k, 0], normals[k, 1], normals[k, 2] = -a / length, -b / length, -cz / length


@compiled()
def _refit(
    surface: Surface, radius: int, row: int, first: int, plane: Float64, spread: Float64, count: Float64
) -> None:
    """Refit inverse depth = a x + b y + c about pixels, weighted by the distance to ``plane`` (3, pixels), in place.

    ``count`` (pixels,): how many neighbours; 0 where they fix no plane. The innermost loops run along a row, so that
    they use vectors.
    """
    place, value, weight = np.empty((2, spread.size)), np.empty(spread.size), np.empty(spread.size)
    sums = np.zeros((9, spread.size))
    count[:] = 0.0
    for i in range(max(0, row - radius), min(surface[0].shape[0], row + radius + 1)):
        for shift in range(-radius, radius + 1):
            _compare(surface, row, i, first, shift, place, value, weight)
            _accumulate(place, value, weight, plane, spread, sums, count)
    for k in range(spread.size):
        total, sum_x, sum_y, sum_value = sums[ONE, k], sums[X, k], sums[Y, k], sums[VALUE, k]
        xx = sums[XX, k] - sum_x * sum_x / total
        xy = sums[XY, k] - sum_x * sum_y / total
        yy = sums[YY, k] - sum_y * sum_y / total
        x_value = sums[X_VALUE, k] - sum_x * sum_value / total
        y_value = sums[Y_VALUE, k] - sum_y * sum_value / total
        determinant = xx * yy - xy * xy
        if count[k] < 3 or not determinant > 1e-6 * xx * yy:
            count[k] = plane[0, k] = plane[1, k] = plane[2, k] = 0.0
            continue
        across = (x_value * yy - y_value * xy) / determinant
        down = (y_value * xx - x_value * xy) / determinant
        plane[0, k], plane[1, k], plane[2, k] = across, down, (sum_value - across * sum_x - down * sum_y) / total


@compiled()
def _accumulate(
    place: Float64, value: Float64, weight: Float64, plane: Float64, spread: Float64, sums: Float64, count: Float64
) -> None:
    """Add one neighbour of each pixel to ``sums`` (9, pixels), in the order of ``XX`` to ``VALUE``.

    ``place`` (2, pixels): x and y; ``value``, ``weight`` (pixels,); the others as in ``_refit``
    """
    x, y = place[0], place[1]
    across, down, middle = plane[0], plane[1], plane[2]
    xx, xy, yy = sums[XX], sums[XY], sums[YY]
    sum_x, sum_y, total = sums[X], sums[Y], sums[ONE]
    x_value, y_value, sum_value = sums[X_VALUE], sums[Y_VALUE], sums[VALUE]
    for k in range(value.size):
        off = value[k] - (across[k] * x[k] + down[k] * y[k] + middle[k])
        w = weight[k] / (1.0 + off * off / (4.0 * spread[k] + 1e-20))
        wx, wy = w * x[k], w * y[k]
        xx[k] += wx * x[k]
        xy[k] += wx * y[k]
        yy[k] += wy * y[k]
        sum_x[k] += wx
        sum_y[k] += wy
        total[k] += w
        x_value[k] += wx * value[k]
        y_value[k] += wy * value[k]
        sum_value[k] += w * value[k]
        count[k] += weight[k]


@compiled()
def _compare(
    surface: Surface, row: int, other: int, first: int, shift: int, place: Float64, value: Float64, weight: Float64
) -> None:
    """Where neighbours of pixels of a row lie, and their inverse depth; 0 with no weight for those that do not count.

    ``place`` (2, pixels): x and y from the pixel; ``value``, ``weight`` (pixels,). A neighbour is ``shift`` columns
    beside in the row ``other``; it counts inside the picture, on the same surface.
    """
    place[:], value[:], weight[:] = 0.0, 0.0, 0.0
    inverse, across, down = surface
    a, e = max(0, -first - shift), min(value.size, inverse.shape[1] - first - shift)
    if a < e:
        at, there = slice(first + a, first + e), slice(first + a + shift, first + e + shift)
        _differ(across[row, at], across[other, there], place[0, a:e])
        _differ(down[row, at], down[other, there], place[1, a:e])
        _on_surface(inverse[row, at], inverse[other, there], value[a:e], weight[a:e])


@compiled()
def _differ(here: FloatImage, other: FloatImage, difference: Float64) -> None:
    for k in range(difference.size):
        difference[k] = other[k] - here[k]


@compiled()
def _on_surface(here: FloatImage, other: FloatImage, value: Float64, weight: Float64) -> None:
    for k in range(value.size):
        use = abs(other[k] - here[k]) < _SHARPEST * here[k]
        value[k], weight[k] = other[k] if use else 0.0, 1.0 if use else 0.0


@compiled()
def _spread(surface: Surface, radius: int, row: int, first: int, plane: Float64, spread: Float64) -> None:
    """Mean squared distance of neighbourhoods from planes; arrays as in ``_refit``."""
    place, value, weight = np.empty((2, spread.size)), np.empty(spread.size), np.empty(spread.size)
    count = np.zeros(spread.size)
    spread[:] = 0.0
    for i in range(max(0, row - radius), min(surface[0].shape[0], row + radius + 1)):
        for shift in range(-radius, radius + 1):
            _compare(surface, row, i, first, shift, place, value, weight)
            _add_squares(place, value, weight, plane, spread, count)
    for k in range(spread.size):
        spread[k] /= max(count[k], 1.0)


@compiled()
def _add_squares(
    place: Float64, value: Float64, weight: Float64, plane: Float64, squares: Float64, count: Float64
) -> None:
    """Add the squared distance of one neighbour of each pixel from its plane; arrays as in ``_accumulate``."""
    x, y = place[0], place[1]
    across, down, middle = plane[0], plane[1], plane[2]
    for k in range(value.size):
        off = value[k] - across[k] * x[k] - down[k] * y[k] - middle[k]
        squares[k] += weight[k] * off * off
        count[k] += weight[k]
