"""A phase map made smooth within each surface, without mixing surfaces."""

from __future__ import annotations

import cv2
import numba
import numpy as np

from controller.core import channels
from controller.core.arrays import Float64, FloatImage, Mask
from controller.core.jit import compiled

FEWEST_NEIGHBOURS = 7
WORST_RESIDUAL_PX = 0.5
WIDEST_RADIUS = 3
STEEPEST = 4.0
"""Times the typical slope; a larger change between neighbours is a jump to another surface."""
NARROWEST_PX = 2.0
"""Width of the window, camera px, where projector pixels are smaller than that."""
CURVED_RADIUS = 2
WORST_CURVED_PX = 0.25
MOST_PULL = 1.0
"""Relative change of the light from a camera pixel to the next; more is an edge, not paint."""


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
    # square projector pixels make the phase a staircase, which the mean over a whole pixel takes away
    width_px = max(NARROWEST_PX, 1 / max(slope, 1e-3))
    weights = np.clip((width_px + 1) / 2 - np.arange(WIDEST_RADIUS + 1), 0, 1)
    weights = weights[: max(2, np.count_nonzero(weights))]
    smooth, kept = np.full_like(position_px, np.nan), np.zeros_like(valid)
    # at a border, a narrow window would lack the other half of a staircase
    wide = np.ones(weights.size + 2)
    _fit(position_px, valid, weights, wide, STEEPEST * slope, smooth, kept)
    return smooth, kept


def fit_curved(position_px: FloatImage, valid: Mask, otherwise_px: FloatImage) -> FloatImage:
    """Value of the polynomial of second degree through each pixel's 5x5 neighbours, by least squares.

    ``otherwise_px`` stands where a neighbour is missing or off the polynomial, as at edges. (rows, columns, 2) float32
    """
    side = 2 * CURVED_RADIUS + 1
    y, x = (
        np.mgrid[-CURVED_RADIUS : CURVED_RADIUS + 1, -CURVED_RADIUS : CURVED_RADIUS + 1]
        .astype(np.float64)
        .reshape(2, -1)
    )
    terms = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
    kernel = np.linalg.pinv(terms)[0].reshape(side, side)
    filled = np.where(valid[..., None], position_px, np.float32(0))
    fitted = cv2.filter2D(filled, -1, kernel)
    # in place: a large camera's picture leaves little memory for copies
    off = channels.largest(np.abs(np.subtract(fitted, filled, out=filled), out=filled))
    del filled
    off[~valid] = np.inf
    around = np.ones((side, side), np.uint8)
    use = cv2.dilate(off, around, borderType=cv2.BORDER_CONSTANT, borderValue=np.inf) < WORST_CURVED_PX
    return np.where(use[..., None], fitted, otherwise_px)


def _typical_slope(position_px: FloatImage, valid: Mask) -> float:
    """Median change between adjacent camera pixels, projector px, the larger of both directions."""
    every = max(1, valid.shape[0] // 500)
    across = np.hypot(*np.moveaxis(np.diff(position_px[::every], axis=1), 2, 0))[
        valid[::every, 1:] & valid[::every, :-1]
    ]
    rows = position_px[:, ::every], valid[:, ::every]
    down = np.hypot(*np.moveaxis(np.diff(rows[0], axis=0), 2, 0))[rows[1][1:] & rows[1][:-1]]
    return max((float(np.median(change)) for change in (across, down) if change.size), default=1.0)


def correct_for_paint(position_px: FloatImage, valid: Mask, light: FloatImage, variance_px2: float) -> FloatImage:
    """Take back what the object's paint does to positions.

    A camera pixel averages over its blur, and what is paler counts more: its mean position is pulled towards the paler
    side. For a Gaussian blur of variance s^2 the pull is exactly s^2 J grad(L) / L, with J the slope of the map and L
    the light as the camera sees it, blur included.

    Parameters
    ----------
    position_px : (rows, columns, 2) float32 projector px
    valid : (rows, columns)
    light : (rows, columns) of the projector's white
    variance_px2 : of the camera's blur, camera px squared

    Returns
    -------
    as ``position_px``; unchanged where a neighbour is missing or on another surface
    """
    slope = STEEPEST * _typical_slope(position_px, valid)
    corrected = position_px.copy()
    _correct(position_px, valid, light, variance_px2, slope, corrected)
    return corrected


@compiled(parallel=True)
def _correct(
    position: FloatImage, valid: Mask, light: FloatImage, variance: float, slope: float, corrected: FloatImage
) -> None:
    rows, columns = valid.shape
    for row in numba.prange(1, rows - 1):
        for column in range(1, columns - 1):
            if not (valid[row, column] and light[row, column] > 0):
                continue
            for down in range(2):
                r0, c0, r1, c1 = row - down, column - 1 + down, row + down, column + 1 - down
                dx = (position[r1, c1, 0] - position[r0, c0, 0]) / 2
                dy = (position[r1, c1, 1] - position[r0, c0, 1]) / 2
                if valid[r0, c0] and valid[r1, c1] and abs(dx) <= slope and abs(dy) <= slope:
                    pull = (light[r1, c1] - light[r0, c0]) / (2 * light[row, column])
                    pull = variance * min(max(pull, -MOST_PULL), MOST_PULL)
                    corrected[row, column, 0] -= pull * dx
                    corrected[row, column, 1] -= pull * dy


@compiled(parallel=True, fastmath=False)
def _fit(
    position: FloatImage, valid: Mask, weights: Float64, wide: Float64, slope: float, smooth: FloatImage, kept: Mask
) -> None:
    rows, columns = valid.shape
    for row in numba.prange(rows):
        for column in range(columns):
            if valid[row, column] and not _fit_one(
                position, valid, row, column, weights, (2 * weights.size - 1) ** 2, slope, smooth, kept
            ):
                _fit_one(position, valid, row, column, wide, FEWEST_NEIGHBOURS, slope, smooth, kept)


@compiled()
def _fit_one(
    position: FloatImage,
    valid: Mask,
    row: int,
    column: int,
    weights: Float64,
    fewest: int,
    slope: float,
    smooth: FloatImage,
    kept: Mask,
) -> bool:
    """Least squares of position = a + b dx + c dy over the neighbours; keeps a. False with ``fewest`` not reached.

    ``weights`` by the distance along rows and along columns.
    """
    radius, count = weights.size - 1, 0
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
            weight = weights[abs(r - row)] * weights[abs(c - column)]
            count += 1
            n += weight
            sx += weight * dx
            sy += weight * dy
            sxx += weight * dx * dx
            sxy += weight * dx * dy
            syy += weight * dy * dy
            p += weight * u
            px += weight * u * dx
            py += weight * u * dy
            q += weight * v
            qx += weight * v * dx
            qy += weight * v * dy
    if count < fewest:
        return False
    # the plane's value at (0, 0) by Cramer's rule on the 3x3 normal equations
    a, b, c2 = sxx * syy - sxy * sxy, sy * sxy - sx * syy, sx * sxy - sy * sxx
    determinant = n * a + sx * b + sy * c2
    if determinant < 1e-3 * n * n * n:
        return False
    u, v = (a * p + b * px + c2 * py) / determinant, (a * q + b * qx + c2 * qy) / determinant
    if abs(u) <= WORST_RESIDUAL_PX and abs(v) <= WORST_RESIDUAL_PX:
        smooth[row, column, 0], smooth[row, column, 1] = x0 + u, y0 + v
        kept[row, column] = True
    return True
