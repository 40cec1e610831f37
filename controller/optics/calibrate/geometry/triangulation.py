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
    inverse = np.full((rows, columns), np.nan, dtype=np.float32)
    residual = np.full((rows, columns), np.nan, dtype=np.float32)
    leverage = np.full((rows, columns), np.nan, dtype=np.float32)
    turned = np.empty((projectors, 3))
    for n in range(projectors):
        turned[n] = rotations[n] @ centres[n]
    scale, limit = (2.4 * noise_px) ** 2, 2.0 * (4.0 * noise_px) ** 2
    for row in numba.prange(rows):
        for column in range(columns):
            rx, ry = rays[row, column, 0], rays[row, column, 1]
            rho = 0.0
            for iteration in range(6):
                top, bottom, squares, count, agreeing = 0.0, 0.0, 0.0, 0, 0
                for n in range(projectors):
                    if not seen[n, row, column]:
                        continue
                    R = rotations[n]
                    focal = focal_px[n]
                    u, v = slopes[n, row, column, 0], slopes[n, row, column, 1]
                    qx = R[0, 0] * rx + R[0, 1] * ry + R[0, 2]
                    qy = R[1, 0] * rx + R[1, 1] * ry + R[1, 2]
                    qz = R[2, 0] * rx + R[2, 1] * ry + R[2, 2]
                    # q - rho turned is parallel to (u, v, 1): two equations, linear in rho; focal / depth makes pixels
                    ax, ay = qx - u * qz, qy - v * qz
                    bx, by = turned[n, 0] - u * turned[n, 2], turned[n, 1] - v * turned[n, 2]
                    depth = qz - rho * turned[n, 2]
                    gain = (focal / depth) ** 2 if depth > 1e-6 else 1e-12
                    error = gain * ((ax - rho * bx) ** 2 + (ay - rho * by) ** 2)
                    weight = gain if iteration < 2 else gain / (1.0 + error / scale)
                    top += weight * (ax * bx + ay * by)
                    bottom += weight * (bx * bx + by * by)
                    count += 1
                    if error < limit:
                        squares += error
                        agreeing += 1
                if count == 0 or bottom <= 0.0:
                    break
                if iteration < 5:
                    rho = top / bottom
                elif agreeing >= min(count, 2):
                    inverse[row, column] = rho
                    residual[row, column] = np.sqrt(squares / (2 * agreeing))
                    leverage[row, column] = 1.0 / np.sqrt(bottom)
    return inverse, residual, leverage


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
    n = spread.size
    x, y, value, weight = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    sums = np.zeros((9, n))
    count[:] = 0.0
    for i in range(max(0, row - radius), min(surface[0].shape[0], row + radius + 1)):
        for shift in range(-radius, radius + 1):
            _compare(surface, row, i, first, shift, x, y, value, weight)
            _accumulate(
                x, y, value, weight, plane[0], plane[1], plane[2], spread, sums[0], sums[1], sums[2], sums[3], sums[4],
                sums[5], sums[6], sums[7], sums[8], count,
            )  # fmt: skip
    for k in range(n):
        sxx, sxy, syy, sx, sy = sums[0, k], sums[1, k], sums[2, k], sums[3, k], sums[4, k]
        s, tx, ty, t = sums[5, k], sums[6, k], sums[7, k], sums[8, k]
        pxx, pxy, pyy = sxx - sx * sx / s, sxy - sx * sy / s, syy - sy * sy / s
        qx, qy = tx - sx * t / s, ty - sy * t / s
        determinant = pxx * pyy - pxy * pxy
        if count[k] < 3 or not determinant > 1e-6 * pxx * pyy:
            count[k] = plane[0, k] = plane[1, k] = plane[2, k] = 0.0
            continue
        a, b = (qx * pyy - qy * pxy) / determinant, (qy * pxx - qx * pxy) / determinant
        plane[0, k], plane[1, k], plane[2, k] = a, b, (t - a * sx - b * sy) / s


@compiled()
def _accumulate(
    x: Float64,
    y: Float64,
    value: Float64,
    weight: Float64,
    a: Float64,
    b: Float64,
    c: Float64,
    spread: Float64,
    sxx: Float64,
    sxy: Float64,
    syy: Float64,
    sx: Float64,
    sy: Float64,
    s: Float64,
    tx: Float64,
    ty: Float64,
    t: Float64,
    count: Float64,
) -> None:
    """Add one neighbour of each pixel to the sums; all (pixels,)."""
    for k in range(x.size):
        off = value[k] - (a[k] * x[k] + b[k] * y[k] + c[k])
        w = weight[k] / (1.0 + off * off / (4.0 * spread[k] + 1e-20))
        wx, wy = w * x[k], w * y[k]
        sxx[k] += wx * x[k]
        sxy[k] += wx * y[k]
        syy[k] += wy * y[k]
        sx[k] += wx
        sy[k] += wy
        s[k] += w
        tx[k] += wx * value[k]
        ty[k] += wy * value[k]
        t[k] += w * value[k]
        count[k] += weight[k]


@compiled()
def _compare(
    surface: Surface,
    row: int,
    other: int,
    first: int,
    shift: int,
    x: Float64,
    y: Float64,
    value: Float64,
    weight: Float64,
) -> None:
    """Where neighbours of pixels of a row lie, and their inverse depth; 0 with no weight for those that do not count.

    A neighbour is ``shift`` columns beside in the row ``other``; it counts inside the picture, on the same surface.
    """
    x[:], y[:], value[:], weight[:] = 0.0, 0.0, 0.0, 0.0
    inverse, across, down = surface
    a, e = max(0, -first - shift), min(x.size, inverse.shape[1] - first - shift)
    if a < e:
        at, there = slice(first + a, first + e), slice(first + a + shift, first + e + shift)
        _differ(across[row, at], across[other, there], x[a:e])
        _differ(down[row, at], down[other, there], y[a:e])
        _on_surface(inverse[row, at], inverse[other, there], value[a:e], weight[a:e])


@compiled()
def _differ(here: FloatImage, other: FloatImage, found: Float64) -> None:
    for k in range(found.size):
        found[k] = other[k] - here[k]


@compiled()
def _on_surface(here: FloatImage, other: FloatImage, value: Float64, weight: Float64) -> None:
    for k in range(value.size):
        use = abs(other[k] - here[k]) < _SHARPEST * here[k]
        value[k], weight[k] = other[k] if use else 0.0, 1.0 if use else 0.0


@compiled()
def _spread(surface: Surface, radius: int, row: int, first: int, plane: Float64, spread: Float64) -> None:
    """Mean squared distance of neighbourhoods from planes; arrays as in ``_refit``."""
    n = spread.size
    x, y, value, weight, count = np.empty(n), np.empty(n), np.empty(n), np.empty(n), np.zeros(n)
    spread[:] = 0.0
    for i in range(max(0, row - radius), min(surface[0].shape[0], row + radius + 1)):
        for shift in range(-radius, radius + 1):
            _compare(surface, row, i, first, shift, x, y, value, weight)
            _add_squares(x, y, value, weight, plane[0], plane[1], plane[2], spread, count)
    for k in range(n):
        spread[k] /= max(count[k], 1.0)


@compiled()
def _add_squares(
    x: Float64,
    y: Float64,
    value: Float64,
    weight: Float64,
    a: Float64,
    b: Float64,
    c: Float64,
    squares: Float64,
    count: Float64,
) -> None:
    for k in range(x.size):
        off = value[k] - a[k] * x[k] - b[k] * y[k] - c[k]
        squares[k] += weight[k] * off * off
        count[k] += weight[k]
