"""Levenberg and Marquardt's least squares for one elliptical Gaussian in a small window (paper 4.2.2, eq. 8).

The paper's six numbers (amplitude, centre, orientation, two sigmas) are looked for as amplitude, centre and a
triangular root L of the inverse covariance: the same ellipses, but never an invalid one, and no angle that means
nothing in a circle. Each camera pixel counts by its white light: where it is dark, the quotient is mostly noise.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from controller.core.arrays import Float64, FloatImage
from controller.core.jit import compiled

PARAMETERS: Final = 6
MOST_STEPS: Final = 40
FEWEST_PIXELS: Final = 9
FARTHEST_PX: Final = 48
"""Largest reach of a window; a larger metapixel is an error."""
DARKEST: Final = 0.02
"""Of the brightest white in the window; below it the quotient is noise."""
FAR_PX, FAR_SIGMAS = 1.0, 1.0
"""A fit that ends farther from its start than this, in sum, has converged to something else."""
MOST_RESIZED: Final = 3.0
WORST_RESIDUAL: Final = 0.5
"""Rms difference over rms of the dot; more than that is not this dot, or no dot."""
SETTLED: Final = 1e-3
"""Camera pixels, and relative size, below which a step is the last: the rest is of the order of its square."""


@compiled()
def fit_gaussian(
    image: FloatImage,
    black: FloatImage,
    white: FloatImage,
    guess_px: FloatImage,
    guess_px2: FloatImage,
    start_px: FloatImage,
    start_px2: FloatImage,
    cut: float,
    fit: Float64,
) -> float:
    """Fit one dot of a photograph.

    Parameters
    ----------
    image, black, white : (rows, columns, channels) float32, linear, one unit; ``white`` without black
    guess_px, guess_px2 : (2,), (3,) float32 centre and covariance that the outcome is judged against
    start_px, start_px2 : the same, for the window and the first step
    cut : Mahalanobis distance at which the window ends
    fit : (6,) receives x, y, xx, xy, yy and the amplitude

    Returns
    -------
    rms residual over the rms of the dot, or -1 where the fit failed
    """
    xx, xy, yy = float(start_px2[0]), float(start_px2[1]), float(start_px2[2])
    determinant = xx * yy - xy * xy
    if not (xx > 0 and yy > 0 and determinant > 0):
        return -1.0
    p = np.empty(PARAMETERS)
    p[1], p[2] = 0.0, 0.0
    p[3] = np.sqrt(yy / determinant)
    p[4] = -xy / determinant / p[3]
    p[5] = np.sqrt(1.0 / yy)
    samples = _window(image, black, white, start_px, start_px2, cut)
    if samples.shape[1] < FEWEST_PIXELS or not _first_amplitude(samples, p):
        return -1.0
    cost = _descend(samples, p)
    signal = 0.0
    for k in range(samples.shape[1]):
        signal += (samples[3, k] * samples[2, k]) ** 2
    quality = np.sqrt(cost / signal)
    if not (p[0] > 0 and quality <= WORST_RESIDUAL):
        return -1.0
    scale = p[3] * p[3] * p[5] * p[5]
    if not scale > 0:
        return -1.0
    fit[0], fit[1], fit[5] = start_px[0] + p[1], start_px[1] + p[2], p[0]
    fit[2], fit[3], fit[4] = (p[4] * p[4] + p[5] * p[5]) / scale, -p[3] * p[4] / scale, p[3] * p[3] / scale
    return float(quality) if _near(guess_px, guess_px2, fit) else -1.0


@compiled()
def _window(
    image: FloatImage, black: FloatImage, white: FloatImage, centre: FloatImage, covariance: FloatImage, cut: float
) -> FloatImage:
    """(4, n): x and y from the centre, share of the light, root of the weight, of the usable pixels within the cut."""
    none = np.empty((4, 0), np.float32)
    rows, columns, channels = image.shape
    xx, xy, yy = float(covariance[0]), float(covariance[1]), float(covariance[2])
    reach_x, reach_y = cut * np.sqrt(xx), cut * np.sqrt(yy)
    x, y = float(centre[0]), float(centre[1])
    if not (reach_x < FARTHEST_PX and reach_y < FARTHEST_PX and abs(x) < 1e6 and abs(y) < 1e6):
        return none
    top, bottom = max(int(np.ceil(y - reach_y)), 0), min(int(np.floor(y + reach_y)), rows - 1)
    left, right = max(int(np.ceil(x - reach_x)), 0), min(int(np.floor(x + reach_x)), columns - 1)
    if top > bottom or left > right:
        return none
    samples = np.empty((4, (bottom - top + 1) * (right - left + 1)), np.float32)
    n, brightest, limit = 0, 0.0, cut * cut * (xx * yy - xy * xy)
    for row in range(top, bottom + 1):
        for column in range(left, right + 1):
            dx, dy = column - x, row - y
            if yy * dx * dx - 2 * xy * dx * dy + xx * dy * dy > limit:
                continue
            light = full = 0.0
            for c in range(channels):
                light += image[row, column, c] - black[row, column, c]
                full += white[row, column, c]
            # NaN, where a photograph was saturated, fails the comparison
            if full > 0 and abs(light) < np.inf:
                samples[0, n], samples[1, n] = dx, dy
                samples[2, n], samples[3, n] = light / full, full
                brightest = max(brightest, full)
                n += 1
    kept = 0
    for k in range(n):
        if samples[3, k] > DARKEST * brightest:
            samples[:3, kept] = samples[:3, k]
            samples[3, kept] = np.sqrt(samples[3, k] / brightest)
            kept += 1
    return samples[:, :kept]


@compiled()
def _first_amplitude(samples: FloatImage, p: Float64) -> bool:
    """The amplitude that suits the starting ellipse; False where there is no light."""
    above = below = 0.0
    for k in range(samples.shape[1]):
        dx, dy = samples[0, k] - p[1], samples[1, k] - p[2]
        a, b = p[3] * dx + p[4] * dy, p[5] * dy
        g = np.exp(-0.5 * (a * a + b * b))
        weight = samples[3, k] * samples[3, k]
        above += weight * g * samples[2, k]
        below += weight * g * g
    p[0] = above / below if below > 0 else 0.0
    return bool(p[0] > 0)


@compiled()
def _descend(samples: FloatImage, p: Float64) -> float:
    """Improve ``p`` in place; the weighted squared residual at its end."""
    rows = np.empty((PARAMETERS + 1, samples.shape[1]), np.float32)
    hessian, slope = np.empty((PARAMETERS, PARAMETERS)), np.empty(PARAMETERS)
    new_hessian, new_slope = np.empty((PARAMETERS, PARAMETERS)), np.empty(PARAMETERS)
    factor, step, trial = np.empty((PARAMETERS, PARAMETERS)), np.empty(PARAMETERS), np.empty(PARAMETERS)
    damping = 1e-3
    cost = _equations(samples, p, rows, hessian, slope)
    for _ in range(MOST_STEPS):
        if not _solve(hessian, slope, damping, factor, step):
            damping *= 10
            continue
        settled = True
        for i in range(PARAMETERS):
            trial[i] = p[i] + step[i]
            unit = 1.0 if i in {1, 2} else abs(p[3])
            settled = settled and abs(step[i]) < SETTLED * (unit if i > 0 else abs(p[0]))
        new = _equations(samples, trial, rows, new_hessian, new_slope)
        if new <= cost:
            p[:] = trial
            cost = new
            hessian, new_hessian, slope, new_slope = new_hessian, hessian, new_slope, slope
            damping = max(damping * 0.1, 1e-9)
        else:
            damping *= 10
        if settled or damping > 1e9:
            break
    return cost


@compiled(fastmath=True)
def _equations(samples: FloatImage, p: Float64, rows: FloatImage, hessian: Float64, slope: Float64) -> float:
    """Gauss and Newton's normal equations at ``p``; returns the cost. ``rows`` (7, n) is scratch.

    In single precision, eight samples at a time: at the end of a fit, the sums of some hundred of them need no more.
    """
    a0, x0, y0 = np.float32(p[0]), np.float32(p[1]), np.float32(p[2])
    p3, p4, p5 = np.float32(p[3]), np.float32(p[4]), np.float32(p[5])
    for k in range(samples.shape[1]):
        dx, dy, weight = samples[0, k] - x0, samples[1, k] - y0, samples[3, k]
        a, b = p3 * dx + p4 * dy, p5 * dy
        g = weight * _falling(a * a + b * b)
        ag = a0 * g
        rows[0, k] = g
        rows[1, k] = ag * a * p3
        rows[2, k] = ag * (a * p4 + b * p5)
        rows[3, k] = -ag * a * dx
        rows[4, k] = -ag * a * dy
        rows[5, k] = -ag * b * dy
        rows[6, k] = ag - weight * samples[2, k]
    for i in range(PARAMETERS):
        slope[i] = _dot(rows[i], rows[PARAMETERS])
        for j in range(i + 1):
            hessian[i, j] = _dot(rows[i], rows[j])
    return _dot(rows[PARAMETERS], rows[PARAMETERS])


@compiled(fastmath=True)
def _falling(squared: np.float32) -> np.float32:
    """exp(-squared / 2) to 3e-5 of its value within 4 sigmas, without a call, so that it runs in vector registers."""
    x = np.float32(-1 / 32) * min(squared, np.float32(48))
    y = np.float32(1) + x * (
        np.float32(1)
        + x * (np.float32(1 / 2) + x * (np.float32(1 / 6) + x * (np.float32(1 / 24) + x * np.float32(1 / 120))))
    )
    y *= y
    y *= y
    y *= y
    return y * y


@compiled(fastmath=True)
def _dot(a: FloatImage, b: FloatImage) -> float:
    total = np.float32(0)
    for k in range(a.size):
        total += a[k] * b[k]
    return float(total)


@compiled()
def _solve(hessian: Float64, slope: Float64, damping: float, factor: Float64, step: Float64) -> bool:
    """Step of the damped equations by Cholesky; only the lower triangle of ``hessian`` is read."""
    for i in range(PARAMETERS):
        for j in range(i + 1):
            value = hessian[i, j] * (1 + damping) if i == j else hessian[i, j]
            for k in range(j):
                value -= factor[i, k] * factor[j, k]
            if i == j:
                if not value > 0:
                    return False
                factor[i, i] = np.sqrt(value)
            else:
                factor[i, j] = value / factor[j, j]
    for i in range(PARAMETERS):
        value = -slope[i]
        for k in range(i):
            value -= factor[i, k] * step[k]
        step[i] = value / factor[i, i]
    for i in range(PARAMETERS - 1, -1, -1):
        value = step[i]
        for k in range(i + 1, PARAMETERS):
            value -= factor[k, i] * step[k]
        step[i] = value / factor[i, i]
    return True


@compiled()
def _sigmas(covariance: npt.NDArray[np.float64]) -> tuple[float, float]:
    middle = (covariance[0] + covariance[2]) / 2
    apart = np.hypot((covariance[0] - covariance[2]) / 2, covariance[1])
    return np.sqrt(middle + apart), np.sqrt(max(middle - apart, 0.0))


@compiled()
def _near(guess_px: FloatImage, guess_px2: FloatImage, fit: Float64) -> bool:
    """Whether a fit ended near its initial estimate, in position and size."""
    long, short = _sigmas(guess_px2.astype(np.float64))
    fit_long, fit_short = _sigmas(fit[2:5])
    if np.hypot(fit[0] - guess_px[0], fit[1] - guess_px[1]) > FAR_PX + FAR_SIGMAS * long:
        return False
    resized = max(fit_long / long, long / fit_long, fit_short / short, short / fit_short)
    return bool(resized <= MOST_RESIZED)
