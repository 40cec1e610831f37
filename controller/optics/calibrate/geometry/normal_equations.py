"""The inner loops of the bundle adjustment: projection, derivatives, Gauss-Newton blocks and their Schur complement.

Compiled and single-threaded on purpose: the matrices are so small that threads cost more than they save.
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numba.extending import register_jitable

from controller.core.arrays import Float64, Mask
from controller.core.jit import compiled

CAMERA = 4
PROJECTOR = 10
LENS = 4
"""Of the parameters of a camera or projector: log f, cx, cy, k1."""
NEAREST = 1e-4
"""Along a projector's view axis, in baselines: anything nearer counts as behind the projector."""
BEHIND_PX = 1e6
Numbers = TypeVar("Numbers", float, Float64)


@compiled()
def straightening(k1: float, squared: float) -> float:
    """The factor s that brings a place at depth 1, ``squared`` from the axis, to where no lens had bent it.

    Newton's steps for s + k1 squared s^3 = 1; 1.5 is where the picture of the strongest barrel turns back.
    """
    bend, s = k1 * squared, 1.0
    for _ in range(20):
        step = (s + bend * s * s * s - 1.0) / max(1.0 + 3.0 * bend * s * s, 0.1)
        s = min(s - step, 1.5)
        if abs(step) < 1e-13:
            break
    return s


@register_jitable
def bending(x: Numbers, y: Numbers, k1: float, k2: float, p1: float, p2: float) -> tuple[Numbers, ...]:
    """Where OpenCV's lens puts ``x``, ``y`` at depth 1, and derivatives: x by x, either by the other, y by y."""
    r2 = x * x + y * y
    radial, grows = 1.0 + r2 * (k1 + r2 * k2), 2.0 * (k1 + 2.0 * k2 * r2)
    bent_x = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
    bent_y = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
    x_by_x = radial + grows * x * x + 2.0 * p1 * y + 6.0 * p2 * x
    y_by_y = radial + grows * y * y + 6.0 * p1 * y + 2.0 * p2 * x
    return bent_x, bent_y, x_by_x, grows * x * y + 2.0 * (p1 * x + p2 * y), y_by_y


@compiled()
def undistort(lens: Float64, px: Float64) -> Float64:
    """(points, 2) x, y at depth 1 of pixels (points, 2); ``lens`` (8,): log f, cx, cy, k1, k2, p1, p2, log fy/fx.

    A lens of the first four alone has zeros for the others.
    """
    focal, k1 = np.exp(lens[0]), lens[3]
    k2, p1, p2, aspect = 0.0, 0.0, 0.0, 1.0
    if lens.size > LENS:
        k2, p1, p2, aspect = lens[4], lens[5], lens[6], np.exp(lens[7])
    out = np.empty((len(px), 2))
    for p in range(len(px)):
        to_x, to_y = (px[p, 0] - lens[1]) / focal, (px[p, 1] - lens[2]) / (focal * aspect)
        if k2 == 0.0 and p1 == 0.0 and p2 == 0.0:
            s = straightening(k1, to_x * to_x + to_y * to_y)
            x, y = s * to_x, s * to_y
        else:
            x, y = to_x, to_y
            for _ in range(30):
                bent_x, bent_y, a, b, c = bending(x, y, k1, k2, p1, p2)
                off_x, off_y, size = bent_x - to_x, bent_y - to_y, max(a * c - b * b, 0.1)
                x, y = x - (c * off_x - b * off_y) / size, y - (a * off_y - b * off_x) / size
                if abs(off_x) + abs(off_y) < 1e-13:
                    break
        out[p, 0], out[p, 1] = x, y
    return out


@compiled()
def project(
    xy: Float64,
    inverse_depth: Float64,
    intrinsics: Float64,
    rotations: Float64,
    turned: Float64,
    projector_px: Float64,
    seen: Mask,
) -> Float64:
    """(points, N, 2) projected less measured projector pixels, 0 where not seen, BEHIND_PX behind a projector.

    Parameters
    ----------
    xy (points, 2) at depth 1, inverse_depth (points,), intrinsics (N, 4) log f, cx, cy, k1,
    rotations (N, 3, 3), turned (N, 3) rotated centres, projector_px (points, N, 2), seen (points, N)
    """
    points, projectors = seen.shape
    out, q = np.zeros((points, projectors, 2)), np.empty(3)
    for n in range(projectors):
        focal = np.exp(intrinsics[n, 0])
        for p in range(points):
            if not seen[p, n]:
                continue
            for i in range(3):
                q[i] = rotations[n, i, 0] * xy[p, 0] + rotations[n, i, 1] * xy[p, 1] + rotations[n, i, 2]
                q[i] -= inverse_depth[p] * turned[n, i]
            longer = 1.0 + intrinsics[n, 3] * (q[0] * q[0] + q[1] * q[1]) / (q[2] * q[2])
            for axis in range(2):
                if q[2] < NEAREST:
                    out[p, n, axis] = BEHIND_PX
                else:
                    at = focal * longer * q[axis] / q[2] + intrinsics[n, 1 + axis]
                    out[p, n, axis] = at - projector_px[p, n, axis]
    return out


@compiled()
def differentiate(
    xy: Float64,
    xy_by_camera: Float64,
    inverse_depth: Float64,
    intrinsics: Float64,
    rotations: Float64,
    turned: Float64,
    seen: Mask,
) -> tuple[Float64, Float64, Float64]:
    """Derivatives of the projected pixels by camera (points, N, 2, 4), projector (points, N, 2, 10) and inverse depth.

    The last is (points, N, 2). All are 0 where not seen and behind a projector. Arguments as of ``project``;
    ``xy_by_camera`` (points, 2, 4).
    """
    points, projectors = seen.shape
    by_camera = np.zeros((points, projectors, 2, CAMERA))
    by_projector, by_depth = np.zeros((points, projectors, 2, PROJECTOR)), np.zeros((points, projectors, 2))
    q, by_q, by_ray = np.empty(3), np.empty(3), np.empty(3)
    for n in range(projectors):
        focal, k1, turn = np.exp(intrinsics[n, 0]), intrinsics[n, 3], rotations[n]
        for p in range(points):
            rho = inverse_depth[p]
            for i in range(3):
                q[i] = turn[i, 0] * xy[p, 0] + turn[i, 1] * xy[p, 1] + turn[i, 2] - rho * turned[n, i]
            if not seen[p, n] or q[2] < NEAREST:
                continue
            x, y = q[0] / q[2], q[1] / q[2]
            r2 = x * x + y * y
            for axis in range(2):
                flat = q[axis] / q[2]
                # of focal flat (1 + k1 r2), by x and y, and so by q
                by_q[0], by_q[1] = 2.0 * focal * k1 * flat * x / q[2], 2.0 * focal * k1 * flat * y / q[2]
                by_q[axis] += focal * (1.0 + k1 * r2) / q[2]
                by_q[2] = -(by_q[0] * x + by_q[1] * y)
                for j in range(3):
                    by_ray[j] = by_q[0] * turn[0, j] + by_q[1] * turn[1, j] + by_q[2] * turn[2, j]
                for j in range(CAMERA):
                    by_camera[p, n, axis, j] = by_ray[0] * xy_by_camera[p, 0, j] + by_ray[1] * xy_by_camera[p, 1, j]
                own = by_projector[p, n, axis]
                own[0], own[1 + axis], own[3] = focal * flat * (1.0 + k1 * r2), 1.0, focal * flat * r2
                # d(exp(delta) q)/d(delta) = -[q]x, so a row g of by_q becomes q x g
                own[LENS] = q[1] * by_q[2] - q[2] * by_q[1]
                own[LENS + 1] = q[2] * by_q[0] - q[0] * by_q[2]
                own[LENS + 2] = q[0] * by_q[1] - q[1] * by_q[0]
                for j in range(3):
                    own[LENS + 3 + j] = -rho * by_ray[j]
                    by_depth[p, n, axis] -= by_q[j] * turned[n, j]
    return by_camera, by_projector, by_depth


@compiled()
def accumulate(
    by_camera: Float64, by_projector: Float64, by_depth: Float64, residual: Float64, weight: Float64
) -> tuple[Float64, Float64, Float64, Float64, Float64]:
    """Sum J' w J and J' w r over all observations.

    Parameters
    ----------
    by_camera (points, N, 2, 4), by_projector (points, N, 2, 10), by_depth, residual (points, N, 2), weight (points, N)

    Returns
    -------
    parameters (P, P), cross (points, P) between depth and parameters, depth (points,), the gradient by the parameters
    (P,) and by the depths (points,), with P = 4 + 10 N
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
