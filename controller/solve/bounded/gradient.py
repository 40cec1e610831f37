"""The compiled steps of the bounded solver, on planes (3, ...)."""

from __future__ import annotations

import numpy as np
from numba import prange

from controller.core.arrays import FloatImage
from controller.core.jit import compiled


@compiled(parallel=True, fastmath=True)
def weighted_residual(light: FloatImage, target: FloatImage, weights: FloatImage, out: FloatImage) -> float:
    """Write weights (light - target) to ``out``; return the sum of weights (light - target)^2.

    ``light``, ``target``, ``out`` (3, rows, columns), ``out`` may be ``light``; ``weights`` (rows, columns)
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
def _add_differences(into: FloatImage, here: FloatImage, there: FloatImage, weight: FloatImage) -> None:
    for i in range(into.size):
        into[i] += weight[i] * (here[i] - there[i])


@compiled(fastmath=True)
def _step_row(
    y: FloatImage, x: FloatImage, gradient: FloatImage, majoriser: FloatImage, new: FloatImage, step: FloatImage
) -> tuple[float, float]:
    kkt = uphill = np.float32(0)
    for i in range(y.size):
        d = majoriser[i]
        to = y[i] - gradient[i] / max(d, np.float32(1e-30))
        to = min(max(to, np.float32(0)), np.float32(1))
        to = to if d > 0 else np.float32(0)
        new[i] = to
        step[i] = to - y[i]
        kkt += d * (to - y[i]) * (to - y[i])
        uphill += d * (y[i] - to) * (to - x[i])
    return float(kkt), float(uphill)


@compiled(parallel=True, fastmath=True)
def projected_step(
    y: FloatImage,
    x: FloatImage,
    gradient: FloatImage,
    majoriser: FloatImage,
    across: FloatImage,
    down: FloatImage,
    start: int,
    rows: int,
    columns: int,
    new: FloatImage,
) -> tuple[float, float]:
    """Write one projected gradient step from ``y`` to ``new`` for the projector whose pixels start at ``start``.

    All arrays (3, pixels of all projectors), each projector row by row. ``gradient`` is that of the data; that of the
    smoothness is added here. It is overwritten with new - y. Returns two sums: majoriser x step^2, whose size measures
    the KKT residual, and majoriser x (y - new) x (new - x), positive where the momentum points uphill.
    """
    sums = np.zeros((rows, 2), np.float64)
    for v in prange(rows):
        a = start + v * columns
        e = a + columns
        total = np.empty(columns, np.float32)
        for c in range(3):
            here, edges = y[c, a:e], across[c, a : e - 1]
            total[:] = gradient[c, a:e]
            _add_differences(total[:-1], here[:-1], here[1:], edges)
            _add_differences(total[1:], here[1:], here[:-1], edges)
            if v > 0:
                _add_differences(total, here, y[c, a - columns : a], down[c, a - columns : a])
            if v < rows - 1:
                _add_differences(total, here, y[c, e : e + columns], down[c, a:e])
            kkt, uphill = _step_row(here, x[c, a:e], total, majoriser[c, a:e], new[c, a:e], gradient[c, a:e])
            sums[v, 0] += kkt
            sums[v, 1] += uphill
    return float(sums[:, 0].sum()), float(sums[:, 1].sum())


@compiled(parallel=True, fastmath=True)
def extrapolate(
    new: FloatImage, x: FloatImage, step: FloatImage, momentum: float, overrelaxation: float, y: FloatImage
) -> None:
    """Write new + momentum (new - x) + overrelaxation step to ``y``; all (3, pixels)."""
    beta, gamma = np.float32(momentum), np.float32(overrelaxation)
    for i in prange(new.shape[1]):
        for c in range(3):
            y[c, i] = new[c, i] + beta * (new[c, i] - x[c, i]) + gamma * step[c, i]


@compiled(parallel=True, fastmath=True)
def extrapolate_buffer(
    new: FloatImage, last: FloatImage, before: FloatImage, momentum: float, overrelaxation: float
) -> None:
    """Write new + momentum (new - last) + overrelaxation (new - before) to ``new``, the old new to ``last``."""
    beta, gamma = np.float32(momentum), np.float32(overrelaxation)
    for i in prange(new.size):
        value = new[i]
        new[i] = value + beta * (value - last[i]) + gamma * (value - before[i])
        last[i] = value


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
def add_smoothness(
    data: FloatImage,
    across: FloatImage,
    down: FloatImage,
    strength: float,
    start: int,
    rows: int,
    columns: int,
    majoriser: FloatImage,
) -> None:
    """Scale one projector's smoothness weights, 0 beside dark pixels; write data + twice their sums to ``majoriser``.

    All (3, pixels of all projectors); dark is a pixel without ``data``. ``start``, ``rows``, ``columns``: the projector
    """
    s = np.float32(strength)
    for v in prange(rows):
        for c in range(3):
            for x in range(columns):
                i = start + v * columns + x
                lit = data[c, i] > 0
                across[c, i] *= s if lit and x + 1 < columns and data[c, i + 1] > 0 else np.float32(0)
                down[c, i] *= s if lit and v + 1 < rows and data[c, i + columns] > 0 else np.float32(0)
    for v in prange(rows):
        for c in range(3):
            for x in range(columns):
                i = start + v * columns + x
                edges = across[c, i] + down[c, i]
                edges += across[c, i - 1] if x > 0 else np.float32(0)
                edges += down[c, i - columns] if v > 0 else np.float32(0)
                majoriser[c, i] = data[c, i] + np.float32(2) * edges


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
