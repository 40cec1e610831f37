"""A phase map made smooth within each surface, without mixing surfaces."""

from __future__ import annotations

import numba
import numpy as np

from controller.arrays import FloatImage, Mask
from controller.compiled import compiled

FEWEST_NEIGHBOURS = 7
WORST_RESIDUAL_PX = 0.5
WIDEST_RADIUS = 3
STEEPEST = 4.0
"""Times the typical slope; a larger change between neighbours is a jump to another surface."""
PROJECTOR_PX_AROUND = 0.9
"""Half the window's width: square projector pixels make the phase a staircase, which a whole pixel averages out."""


def fit_planes(position_px: FloatImage, valid: Mask) -> tuple[FloatImage, Mask]:
    """Fit a plane through each pixel's neighbours on the same surface.

    A neighbour is on the same surface when it differs by no more than some times the map's typical slope.

    Parameters
    ----------
    position_px : (rows, columns, 2) float32 projector px
    valid : (rows, columns)

    Returns
    -------
    the planes' values, NaN where not valid, and where they are valid: enough neighbours, and the pixel itself on it
    """
    slope = _typical_slope(position_px, valid)
    radius = int(np.clip(np.ceil(PROJECTOR_PX_AROUND / max(slope, 1e-3)), 1, WIDEST_RADIUS))
    smooth, kept = np.full_like(position_px, np.nan), np.zeros_like(valid)
    _fit(position_px, valid, radius, STEEPEST * slope, smooth, kept)
    return smooth, kept


def _typical_slope(position_px: FloatImage, valid: Mask) -> float:
    """Median change between adjacent camera pixels, projector px, the larger of both directions."""
    every = max(1, valid.shape[0] // 500)
    across = np.hypot(*np.moveaxis(np.diff(position_px[::every], axis=1), 2, 0))[
        valid[::every, 1:] & valid[::every, :-1]
    ]
    rows = position_px[:, ::every], valid[:, ::every]
    down = np.hypot(*np.moveaxis(np.diff(rows[0], axis=0), 2, 0))[rows[1][1:] & rows[1][:-1]]
    return max((float(np.median(change)) for change in (across, down) if change.size), default=1.0)


@compiled(parallel=True, fastmath=False)
def _fit(position: FloatImage, valid: Mask, radius: int, slope: float, smooth: FloatImage, kept: Mask) -> None:
    rows, columns = valid.shape
    for row in numba.prange(rows):
        for column in range(columns):
            if valid[row, column]:
                _fit_one(position, valid, row, column, radius, slope, smooth, kept)


@compiled()
def _fit_one(
    position: FloatImage,
    valid: Mask,
    row: int,
    column: int,
    radius: int,
    slope: float,
    smooth: FloatImage,
    kept: Mask,
) -> None:
    """Least squares of position = a + b dx + c dy over the neighbours; keeps a."""
    x0, y0 = position[row, column, 0], position[row, column, 1]
    n = sx = sy = sxx = sxy = syy = 0.0
    p = px = py = q = qx = qy = 0.0
    for r in range(max(row - radius, 0), min(row + radius + 1, valid.shape[0])):
        for c in range(max(column - radius, 0), min(column + radius + 1, valid.shape[1])):
            if not valid[r, c]:
                continue
            dx, dy = float(c - column), float(r - row)
            u, v = position[r, c, 0] - x0, position[r, c, 1] - y0
            reach = slope * max(abs(dx), abs(dy)) + 0.75
            if abs(u) > reach or abs(v) > reach:
                continue
            n += 1
            sx += dx
            sy += dy
            sxx += dx * dx
            sxy += dx * dy
            syy += dy * dy
            p += u
            px += u * dx
            py += u * dy
            q += v
            qx += v * dx
            qy += v * dy
    if n < FEWEST_NEIGHBOURS:
        return
    # the plane's value at (0, 0) by Cramer's rule on the 3x3 normal equations
    a, b, c2 = sxx * syy - sxy * sxy, sy * sxy - sx * syy, sx * sxy - sy * sxx
    determinant = n * a + sx * b + sy * c2
    if determinant < 1e-3 * n * n * n:
        return
    u, v = (a * p + b * px + c2 * py) / determinant, (a * q + b * qx + c2 * qy) / determinant
    if abs(u) <= WORST_RESIDUAL_PX and abs(v) <= WORST_RESIDUAL_PX:
        smooth[row, column, 0], smooth[row, column, 1] = x0 + u, y0 + v
        kept[row, column] = True
