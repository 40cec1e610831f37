"""One camera pixel's position from the phases of several sinusoids: coarse ones choose, fine ones measure.

The coarse phase knows the place within 24 px to about a third of a pixel. Two fine sinusoids, along x and y, know it a
few times better but only up to their fringe; a third, diagonal one, contradicts most wrong choices: a step of one
fringe along x or y moves its phase by two sevenths of a turn. All phases that are sure are then combined, each
weighted by the inverse of its variance.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from controller.core.arrays import FloatImage
from controller.core.jit import compiled
from controller.optics.capture.patterns import BLUR_FREQUENCIES, CELL_PX, PERIOD_PX

WAVES = ("phase-x", "phase-y", *(f"blur-{name}" for name in BLUR_FREQUENCIES))
"""Prefixes of the sinusoids in the order of the kernel's arguments."""
FRINGE_PX = 1 / BLUR_FREQUENCIES["x"][0]
DIAGONAL_PX = 1 / BLUR_FREQUENCIES["d"][0]
"""In x + y."""

DARK, CODED, FINE, CONTRADICTED = 0, 1, 2, 4
"""States of a pixel, added up: nothing; coarse phase and Gray code agree; fine phases used; fine phases disagree."""

COARSE_SYSTEMATIC_PX = 0.35
"""Error of the coarse phase apart from noise (light from elsewhere, response), for the choice of a fringe."""
COARSE_FLOOR_PX = 0.10
"""The same error in the final weights, after the choice."""
FINE_SYSTEMATIC_PX = 0.12
FINE_FLOOR_PX = 0.01
MOST_FINE_NOISE_PX = 0.6
LEAST_FINE_CONTRAST = 0.05
SURE_BY = 9.0
"""Squared standard deviations by which the best fringes must be better than the second best."""
WORST_FIT = 16.0
CODE_REACH_PX = CELL_PX / 2 + 2.0
"""Of the coarse phase's position from the middle of the cell that the code tells, or from a map from before."""
PHASE_NOISE = float(np.sqrt(2 / 3))
"""Of a three-step phase, in radians, for noise of one amplitude."""


@compiled()
def _nearest(within: float, period: float, near: float) -> float:
    return within + period * float(np.round((near - within) / period))


@compiled()
def _fringe(
    coarse: npt.NDArray[np.float64], spread: npt.NDArray[np.float64], fine: npt.NDArray[np.float64],
    noise: npt.NDArray[np.float64], best: npt.NDArray[np.float64],
) -> bool:  # fmt: skip
    """The fringes of x and y that fit coarse and diagonal phases best, into ``best``; whether they are sure.

    ``coarse`` x, y px; ``spread`` their standard deviations; ``fine`` x, y, x + y within their fringes, px; ``noise``
    of these, inf where not usable (then the coarse value stands for the fine one).
    """
    least, second = np.inf, np.inf
    use_x, use_y, use_d = np.isfinite(noise[0]), np.isfinite(noise[1]), np.isfinite(noise[2])
    x0 = _nearest(fine[0], FRINGE_PX, coarse[0]) if use_x else coarse[0]
    y0 = _nearest(fine[1], FRINGE_PX, coarse[1]) if use_y else coarse[1]
    variance_d = FINE_SYSTEMATIC_PX**2 + (noise[2] ** 2 if use_d else 0.0)
    variance_d += min(noise[0], spread[0]) ** 2 + min(noise[1], spread[1]) ** 2
    x_off, y_off = (x0 - coarse[0]) ** 2 / spread[0] ** 2, (y0 - coarse[1]) ** 2 / spread[1] ** 2
    best[0], best[1] = x0, y0
    first = x_off + y_off
    if use_d:
        best[2] = _nearest(fine[2], DIAGONAL_PX, x0 + y0)
        first += (x0 + y0 - best[2]) ** 2 / variance_d
    # what another fringe costs in coarse phase alone; nearly every pixel is settled by this
    x_other = (FRINGE_PX - abs(x0 - coarse[0])) ** 2 / spread[0] ** 2 - x_off if use_x else np.inf
    y_other = (FRINGE_PX - abs(y0 - coarse[1])) ** 2 / spread[1] ** 2 - y_off if use_y else np.inf
    if first <= WORST_FIT and min(x_other, y_other) + x_off + y_off - first >= SURE_BY:
        return True
    for i in range(-1 if use_x else 0, 2 if use_x else 1):
        for j in range(-1 if use_y else 0, 2 if use_y else 1):
            x, y = x0 + i * FRINGE_PX, y0 + j * FRINGE_PX
            cost = ((x - coarse[0]) / spread[0]) ** 2 + ((y - coarse[1]) / spread[1]) ** 2
            if use_d:
                cost += (x + y - _nearest(fine[2], DIAGONAL_PX, x + y)) ** 2 / variance_d
            if cost < least:
                least, second = cost, least
                best[0], best[1] = x, y
            elif cost < second:
                second = cost
    if use_d:
        best[2] = _nearest(fine[2], DIAGONAL_PX, best[0] + best[1])
    return bool(least <= WORST_FIT and second - least >= SURE_BY)


@compiled()
def _combine(
    coarse: npt.NDArray[np.float64], spread: npt.NDArray[np.float64], best: npt.NDArray[np.float64],
    noise: npt.NDArray[np.float64],
) -> None:  # fmt: skip
    """Weighted least squares of x and y from x, y (coarse and fine) and x + y; the result replaces ``best``'s x, y."""
    floor = FINE_FLOOR_PX**2
    wx, wy = 1 / spread[0] ** 2, 1 / spread[1] ** 2
    sx, sy = wx * coarse[0], wy * coarse[1]
    fx = 1 / (noise[0] ** 2 + floor)
    fy = 1 / (noise[1] ** 2 + floor)
    fd = 1 / (noise[2] ** 2 + floor)
    if fx > 0:
        sx, wx = sx + fx * best[0], wx + fx
    if fy > 0:
        sy, wy = sy + fy * best[1], wy + fy
    if fd > 0:
        sx, sy = sx + fd * best[2], sy + fd * best[2]
    determinant = (wx + fd) * (wy + fd) - fd * fd
    best[0], best[1] = ((wy + fd) * sx - fd * sy) / determinant, ((wx + fd) * sy - fd * sx) / determinant


@compiled()
def _coarse_of(within: float, near_px: float) -> tuple[float, bool]:
    position = _nearest(within, float(PERIOD_PX), near_px)
    return position, abs(position - near_px) <= CODE_REACH_PX


@compiled()
def locate_pixel(
    waves: FloatImage, row: int, column: int, near_x: float, near_y: float, half: float, sigma: float,
    work: npt.NDArray[np.float64],
) -> int:  # fmt: skip
    """Position of one camera pixel into ``work[0]``, x and y px; its state is returned.

    Parameters
    ----------
    waves : (10, rows, columns) cosine and sine amplitude of each of ``WAVES`` in turn
    near_x, near_y : px, the middle of the Gray code's cell, or what a map from before tells
    half : half the white's light; ``sigma`` noise of one photograph, same unit
    work : (5, 3) float64 scratch
    """
    best, coarse, spread, fine, noise = work[0], work[1], work[2], work[3], work[4]
    agree = True
    for axis in range(2):
        a, b = waves[2 * axis, row, column], waves[2 * axis + 1, row, column]
        amplitude = np.sqrt(a * a + b * b)
        if not amplitude > 0:  # a dark pixel, the same value in every photograph
            return DARK
        coarse[axis], near = _coarse_of(np.arctan2(b, a) * (PERIOD_PX / (2 * np.pi)), near_x if axis == 0 else near_y)
        agree = agree and near
        spread[axis] = PHASE_NOISE * sigma / amplitude * (PERIOD_PX / (2 * np.pi))
        best[axis] = coarse[axis]
    if not agree:
        return DARK
    for k in range(3):
        a, b = waves[4 + 2 * k, row, column], waves[5 + 2 * k, row, column]
        amplitude = np.sqrt(a * a + b * b)
        per_rad = (DIAGONAL_PX if k == 2 else FRINGE_PX) / (2 * np.pi)
        fine[k] = np.arctan2(b, a) * per_rad
        noise[k] = PHASE_NOISE * sigma / amplitude * per_rad if amplitude > LEAST_FINE_CONTRAST * half else np.inf
        if not noise[k] <= MOST_FINE_NOISE_PX:
            noise[k] = np.inf
    if not (np.isfinite(noise[0]) or np.isfinite(noise[1])):
        return CODED
    for axis in range(2):
        work[2, axis] = np.sqrt(spread[axis] ** 2 + COARSE_SYSTEMATIC_PX**2)
    if not _fringe(coarse, spread, fine, noise, best):
        best[0], best[1] = coarse[0], coarse[1]
        return CODED | CONTRADICTED
    for axis in range(2):
        work[2, axis] = np.sqrt(spread[axis] ** 2 - COARSE_SYSTEMATIC_PX**2 + COARSE_FLOOR_PX**2)
    _combine(coarse, spread, best, noise)
    return CODED | FINE
