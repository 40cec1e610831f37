"""The inner loops of the bundle adjustment: Gauss-Newton blocks and their Schur complement over the points.

Compiled and single-threaded on purpose: the matrices are so small that threads cost more than they save.
"""

from __future__ import annotations

import numpy as np

from controller.core.arrays import Float64
from controller.core.jit import compiled

CAMERA = 4
PROJECTOR = 9


@compiled()
def accumulate(
    by_camera: Float64, by_projector: Float64, by_depth: Float64, residual: Float64, weight: Float64
) -> tuple[Float64, Float64, Float64, Float64, Float64]:
    """Sum J' w J and J' w r over all observations.

    Parameters
    ----------
    by_camera (points, N, 2, 4), by_projector (points, N, 2, 9), by_depth, residual (points, N, 2), weight (points, N)

    Returns
    -------
    parameters (P, P), cross (points, P) between depth and parameters, depth (points,), the gradient by the parameters
    (P,) and by the depths (points,), with P = 4 + 9 N
    """
    points, projectors = weight.shape
    size = CAMERA + PROJECTOR * projectors
    parameters, gradient = np.zeros((size, size)), np.zeros(size)
    cross, depth, depth_gradient = np.zeros((points, size)), np.zeros(points), np.zeros(points)
    row = np.empty(CAMERA + PROJECTOR)
    where = np.empty(CAMERA + PROJECTOR, dtype=np.int64)
    where[:CAMERA] = np.arange(CAMERA)
    for n in range(projectors):
        where[CAMERA:] = CAMERA + PROJECTOR * n + np.arange(PROJECTOR)
        for p in range(points):
            w = weight[p, n]
            if w == 0.0:
                continue
            for axis in range(2):
                row[:CAMERA] = by_camera[p, n, axis]
                row[CAMERA:] = by_projector[p, n, axis]
                r, d = residual[p, n, axis], by_depth[p, n, axis]
                depth[p] += w * d * d
                depth_gradient[p] += w * d * r
                for i in range(len(row)):
                    scaled = w * row[i]
                    gradient[where[i]] += scaled * r
                    cross[p, where[i]] += scaled * d
                    for j in range(i + 1):
                        parameters[where[i], where[j]] += scaled * row[j]
    return _mirrored(parameters), cross, depth, gradient, depth_gradient


@compiled()
def reduced(parameters: Float64, cross: Float64, depth: Float64) -> Float64:
    """parameters - cross' diag(1 / depth) cross, the points eliminated; points of depth 0 stay out."""
    out = parameters.copy()
    for p in range(len(depth)):
        if depth[p] <= 0.0:
            continue
        for i in range(len(out)):
            scaled = cross[p, i] / depth[p]
            if scaled != 0.0:
                for j in range(i + 1):
                    out[i, j] -= scaled * cross[p, j]
    return _mirrored(out)


@compiled()
def solve_positive(matrix: Float64, right: Float64) -> Float64:
    """Solve by Cholesky after scaling to a unit diagonal, since pixels and radians differ by orders of magnitude."""
    size = len(right)
    scale = 1.0 / np.sqrt(np.diag(matrix))
    lower = np.zeros((size, size))
    for i in range(size):
        for j in range(i + 1):
            total = matrix[i, j] * scale[i] * scale[j]
            for k in range(j):
                total -= lower[i, k] * lower[j, k]
            # rounding can make the gauge direction's pivot negative
            lower[i, j] = np.sqrt(max(total, 1e-14)) if i == j else total / lower[j, j]
    out = right * scale
    for i in range(size):
        for k in range(i):
            out[i] -= lower[i, k] * out[k]
        out[i] /= lower[i, i]
    for i in range(size - 1, -1, -1):
        for k in range(i + 1, size):
            out[i] -= lower[k, i] * out[k]
        out[i] /= lower[i, i]
    return out * scale


@compiled()
def _mirrored(lower: Float64) -> Float64:
    for i in range(len(lower)):
        for j in range(i):
            lower[j, i] = lower[i, j]
    return lower
