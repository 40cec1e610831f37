"""Dense object points from calibrated poses: one inverse depth a camera pixel, and a plane through each neighbourhood.

The inverse depth of a plane is affine in the undistorted image coordinates, so the plane fit is a 3x3 linear system.
"""

from __future__ import annotations

import numba
import numpy as np

from controller.calibrate.geometry.normal_equations import straightening
from controller.core.arrays import Float64, FloatImage, Mask
from controller.core.jit import compiled

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
    fewest = max(6, (2 * radius + 1) ** 2 // 3)
    for row in numba.prange(rows):
        for column in range(columns):
            here = inverse[row, column]
            if not here > 0.0:
                continue
            a, b, c, count = _plane(inverse, rays, row, column, radius, (0.0, 0.0, float(here)), np.inf)
            if count < fewest:
                continue
            spread = _spread(inverse, rays, row, column, radius, (a, b, c))
            for _ in range(2):
                a, b, c, count = _plane(inverse, rays, row, column, radius, (a, b, c), spread)
            if count < fewest or not c > 0.0 or (here - c) ** 2 > 25.0 * spread + 1e-16:
                continue
            # a X + b Y + cz Z = 1 is the plane; its gradient points away from the camera
            cz = c - a * rays[row, column, 0] - b * rays[row, column, 1]
            length = np.sqrt(a * a + b * b + cz * cz)
            smooth[row, column] = c
            normals[row, column, 0] = -a / length
            normals[row, column, 1] = -b / length
            normals[row, column, 2] = -cz / length
    return smooth, normals


@compiled()
def _plane(
    inverse: FloatImage,
    rays: FloatImage,
    row: int,
    column: int,
    radius: int,
    plane: tuple[float, float, float],
    spread: float,
) -> tuple[float, float, float, int]:
    """Refit inverse depth = a x + b y + c about the pixel, weighted by the distance to ``plane``; 0 where it can't."""
    rows, columns = inverse.shape
    a, b, c = plane
    x0, y0, here = rays[row, column, 0], rays[row, column, 1], inverse[row, column]
    sxx, sxy, syy, sx, sy, s, tx, ty, t = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    count = 0
    for i in range(max(0, row - radius), min(rows, row + radius + 1)):
        for j in range(max(0, column - radius), min(columns, column + radius + 1)):
            value = inverse[i, j]
            if not abs(value - here) < _SHARPEST * here:
                continue
            x, y = rays[i, j, 0] - x0, rays[i, j, 1] - y0
            off = value - (a * x + b * y + c)
            weight = 1.0 / (1.0 + off * off / (4.0 * spread + 1e-20))
            sxx += weight * x * x
            sxy += weight * x * y
            syy += weight * y * y
            sx += weight * x
            sy += weight * y
            s += weight
            tx += weight * x * value
            ty += weight * y * value
            t += weight * value
            count += 1
    if count < 3:
        return 0.0, 0.0, 0.0, 0
    pxx, pxy, pyy = sxx - sx * sx / s, sxy - sx * sy / s, syy - sy * sy / s
    qx, qy = tx - sx * t / s, ty - sy * t / s
    determinant = pxx * pyy - pxy * pxy
    if not determinant > 1e-6 * pxx * pyy:
        return 0.0, 0.0, 0.0, 0
    a, b = (qx * pyy - qy * pxy) / determinant, (qy * pxx - qx * pxy) / determinant
    return a, b, (t - a * sx - b * sy) / s, count


@compiled()
def _spread(
    inverse: FloatImage, rays: FloatImage, row: int, column: int, radius: int, plane: tuple[float, float, float]
) -> float:
    """Mean squared distance of a neighbourhood from a plane."""
    rows, columns = inverse.shape
    a, b, c = plane
    here = inverse[row, column]
    squares, count = 0.0, 0
    for i in range(max(0, row - radius), min(rows, row + radius + 1)):
        for j in range(max(0, column - radius), min(columns, column + radius + 1)):
            value = inverse[i, j]
            if not abs(value - here) < _SHARPEST * here:
                continue
            x, y = rays[i, j, 0] - rays[row, column, 0], rays[i, j, 1] - rays[row, column, 1]
            squares += (value - a * x - b * y - c) ** 2
            count += 1
    return squares / max(count, 1)
