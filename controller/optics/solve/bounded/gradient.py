"""The compiled steps of the bounded solver, with the gradient of eq. 3, on planes (3, ...)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import prange

from controller.core.arrays import FloatImage
from controller.core.jit import compiled

EdgeWeights = npt.NDArray[np.uint16]
"""Squared weights of the smoothness edges (3, pixels), in steps of 1 / EDGE_WEIGHT_STEPS (docs/decisions/0004)."""


@compiled(parallel=True, fastmath=True)
def weighted_residual(light: FloatImage, target: FloatImage, weights: FloatImage, out: FloatImage) -> float:
    """Write weights (light - target) to ``out``; return the sum of weights (light - target)^2.

    ``light``, ``target``, ``out`` (3, rows, columns), ``out`` may be one of the others; ``weights`` (rows, columns)
    """
    rows, columns = weights.shape
    sums = np.zeros(rows, np.float64)
    for y in prange(rows):
        for c in range(3):
            row = np.float32(0)
            for x in range(columns):
                e = light[c, y, x] - target[c, y, x]
                row += weights[y, x] * e * e
                out[c, y, x] = weights[y, x] * e
            sums[y] += row
    return float(sums.sum())


@compiled(fastmath=True)
def _add_differences(
    into: FloatImage, here: FloatImage, there: FloatImage, weight: EdgeWeights, strength_per_step: np.float32
) -> None:
    for i in range(into.size):
        into[i] += strength_per_step * np.float32(weight[i]) * (here[i] - there[i])


@compiled(fastmath=True)
def _step_row(
    y: FloatImage, x: FloatImage, gradient: FloatImage, majoriser: FloatImage, step: FloatImage
) -> tuple[float, float]:
    kkt = uphill = np.float32(0)
    for i in range(y.size):
        d = majoriser[i]
        to = y[i] - gradient[i] / max(d, np.float32(1e-30))
        to = min(max(to, np.float32(0)), np.float32(1))
        to = to if d > 0 else np.float32(0)
        step[i] = to - y[i]
        kkt += d * (to - y[i]) * (to - y[i])
        uphill += d * (y[i] - to) * (to - x[i])
    return float(kkt), float(uphill)


@compiled(fastmath=True)
def within_segment(p: FloatImage, segment: np.float32, majoriser: FloatImage, out: FloatImage) -> None:
    """The nearest colour to ``p`` (3,) in [0, 1] that a projector with a white segment can show, by majoriser.

    Each p_c <= 1 - s + s min(p): brighter than that a saturated colour can't be, but it may become paler. The darkest
    colour rises by mu while the others fall by what they are then still above; the best mu is where both pull alike.
    """
    least = 0
    for c in range(1, 3):
        if p[c] < p[least]:
            least = c
    others = (least + 1) % 3, (least + 2) % 3
    first, second = (others[0], others[1]) if p[others[0]] >= p[others[1]] else (others[1], others[0])
    top = 1 - segment + segment * p[least]
    out[0], out[1], out[2] = p[0], p[1], p[2]
    if p[first] <= top:
        return
    own, d = max(majoriser[least], np.float32(1e-30)), majoriser[first]
    rise = segment * d * (p[first] - top) / (own + segment * segment * d)
    if p[second] > top + segment * rise:
        d2 = majoriser[second]
        pull = segment * (d * (p[first] - top) + d2 * (p[second] - top))
        rise = pull / (own + segment * segment * (d + d2))
    if p[least] <= 0:
        rise = np.float32(0)  # no light of that colour was wanted, and how little is not known here
    darkest, between = p[least] + rise, p[second]
    if darkest > between:
        # both rise together from there
        d2 = majoriser[second]
        pull = own * p[least] + d2 * between + segment * d * (p[first] - (1 - segment))
        darkest = between = max(pull / (own + d2 + segment * segment * d), between)
    top = 1 - segment + segment * darkest
    out[least], out[first], out[second] = darkest, min(p[first], top), min(between, top)


@compiled(parallel=True, fastmath=True)
def projected_step(
    y: FloatImage,
    x: FloatImage,
    gradient: FloatImage,
    majoriser: FloatImage,
    across: EdgeWeights,
    down: EdgeWeights,
    strength_per_step: float,
    start: int,
    rows: int,
    columns: int,
    segment: float,
) -> tuple[float, float]:
    """Overwrite ``gradient`` by a projected gradient step from ``y``; the projector's pixels start at ``start``.

    All arrays (3, pixels of all projectors), each projector row by row. ``gradient`` is that of the data; that of the
    smoothness is added here. Returns two sums: majoriser x step^2, whose size measures the KKT residual, and
    majoriser x (y - new) x (new - x), positive where the momentum points uphill; new is y + step.
    ``across``, ``down``, ``strength_per_step``: as in ``Problem``
    ``segment``: the projector's share of white that only greys get; see ``LightTransport.segments``
    """
    sums = np.zeros((rows, 2), np.float64)
    unit = np.float32(strength_per_step)
    for v in prange(rows):
        a = start + v * columns
        e = a + columns
        total = np.empty(columns, np.float32)
        for c in range(3):
            here, edges = y[c, a:e], across[c, a : e - 1]
            total[:] = gradient[c, a:e]
            _add_differences(total[:-1], here[:-1], here[1:], edges, unit)
            _add_differences(total[1:], here[1:], here[:-1], edges, unit)
            if v > 0:
                _add_differences(total, here, y[c, a - columns : a], down[c, a - columns : a], unit)
            if v < rows - 1:
                _add_differences(total, here, y[c, e : e + columns], down[c, a:e], unit)
            kkt, uphill = _step_row(here, x[c, a:e], total, majoriser[c, a:e], gradient[c, a:e])
            sums[v, 0] += kkt
            sums[v, 1] += uphill
        if segment > 0:
            new, saturated, share = np.empty(3, np.float32), np.empty(3, np.float32), np.float32(segment)
            for i in range(a, e):
                for c in range(3):
                    new[c] = min(max(y[c, i] + gradient[c, i], np.float32(0)), np.float32(1))
                within_segment(new, share, majoriser[:, i], saturated)
                for c in range(3):
                    d, was, to = majoriser[c, i], new[c], saturated[c]
                    sums[v, 0] += d * ((to - y[c, i]) ** 2 - (was - y[c, i]) ** 2)
                    sums[v, 1] += d * ((y[c, i] - to) * (to - x[c, i]) - (y[c, i] - was) * (was - x[c, i]))
                    gradient[c, i] = to - y[c, i]
    return float(sums[:, 0].sum()), float(sums[:, 1].sum())


@compiled(parallel=True, fastmath=True)
def extrapolate(y: FloatImage, x: FloatImage, step: FloatImage, momentum: float, overrelaxation: float) -> None:
    """Write new = y + step, in [0, 1], to ``x``, and new + momentum (new - x) + overrelaxation step to ``y``.

    All (3, pixels)
    """
    beta, gamma = np.float32(momentum), np.float32(overrelaxation)
    for i in prange(x.shape[1]):
        for c in range(3):
            new = min(max(y[c, i] + step[c, i], np.float32(0)), np.float32(1))
            y[c, i] = new + beta * (new - x[c, i]) + gamma * step[c, i]
            x[c, i] = new


@compiled(parallel=True, fastmath=True)
def extrapolate_buffer(
    new: FloatImage, last: FloatImage, before: FloatImage, momentum: float, overrelaxation: float
) -> None:
    """Write new + momentum (new - last) + overrelaxation (new - before) to ``new`` and ``before``, new to ``last``."""
    beta, gamma = np.float32(momentum), np.float32(overrelaxation)
    for i in prange(new.size):
        value = new[i]
        ahead = value + beta * (value - last[i]) + gamma * (value - before[i])
        new[i], before[i], last[i] = ahead, ahead, value


@compiled(parallel=True, fastmath=True)
def scale_base(
    mixed: FloatImage,
    means: FloatImage,
    coverage: FloatImage,
    unmix: FloatImage,
    start: int,
    end: int,
    out: FloatImage,
) -> None:
    """Write clip(unmix (mixed (.) means (.) coverage)) for the pixels of one projector; all planes (3, pixels)."""
    for i in prange(start, end):
        a = mixed[0, i] * means[0, i] * coverage[0, i]
        b = mixed[1, i] * means[1, i] * coverage[1, i]
        c = mixed[2, i] * means[2, i] * coverage[2, i]
        for k in range(3):
            value = unmix[k, 0] * a + unmix[k, 1] * b + unmix[k, 2] * c
            out[k, i] = min(max(value, np.float32(0)), np.float32(1))


@compiled(parallel=True, fastmath=True)
def add_smoothness_to_majoriser(
    majoriser: FloatImage,
    across: EdgeWeights,
    down: EdgeWeights,
    strength_per_step: float,
    start: int,
    rows: int,
    columns: int,
) -> None:
    """Make one projector's edge weights 0 beside dark pixels; add twice their sums to ``majoriser``.

    All (3, pixels of all projectors). ``majoriser`` holds the data's part; a pixel is dark where it is 0, and stays so.
    ``start``, ``rows``, ``columns``: the projector
    """
    twice = np.float32(2 * strength_per_step)
    for v in prange(rows):
        for c in range(3):
            for x in range(columns):
                i = start + v * columns + x
                lit = majoriser[c, i] > 0
                if not (lit and x + 1 < columns and majoriser[c, i + 1] > 0):
                    across[c, i] = 0
                if not (lit and v + 1 < rows and majoriser[c, i + columns] > 0):
                    down[c, i] = 0
    for v in prange(rows):
        for c in range(3):
            for x in range(columns):
                i = start + v * columns + x
                edges = np.int64(across[c, i]) + np.int64(down[c, i])
                edges += np.int64(across[c, i - 1]) if x > 0 else 0
                edges += np.int64(down[c, i - columns]) if v > 0 else 0
                majoriser[c, i] += twice * np.float32(edges)


@compiled(parallel=True, fastmath=True)
def inner(a: FloatImage, b: FloatImage) -> float:
    """The inner product of two flat arrays, added up in blocks so that it is the same for any number of threads."""
    block = 1 << 14
    sums = np.zeros((a.size + block - 1) // block, np.float64)
    for k in prange(sums.size):
        total = np.float32(0)
        for i in range(k * block, min((k + 1) * block, a.size)):
            total += a[i] * b[i]
        sums[k] = total
    return float(sums.sum())
