"""Where a solve starts: the best frames for a stage whose light were smooth, place by place.

At one place of the camera's image, all projectors together make the light B p, with three rows and three columns a
projector. Where one colour for all projectors gives the wanted light within [0, 1], that is the initial estimate.
Elsewhere the projectors have to differ: one may give a colour without crosstalk, another one's crosstalk may be needed.
Sweeps find that slowly, since it changes the light by little; here it is a problem of a few unknowns
(docs/decisions/0025).
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numba import prange

from controller.core.arrays import Float64, FloatImage
from controller.core.jit import compiled
from controller.transport import LightTransport

BLOCK_PX: Final = 4
"""Places are blocks of camera pixels, about one and a half metapixels wide; of 2, a sweep less, for twice the time."""
RIDGE: Final = 1e-4
"""Pull towards equal projectors, of the mean squared light: decides where the light leaves a choice."""
MOST_STEPS: Final = 60
LEAST_DETERMINANT: Final = 1e-3
"""Of the three colours at a place, relative to those of pure primaries."""


def initial_estimate(transport: LightTransport, target_light: FloatImage) -> FloatImage:
    """(3, pixels of all projectors) in [0, 1] for ``target_light`` (3, camera rows, columns), the light to be made.

    The latter is overwritten.
    """
    count = len(transport.sizes)
    blocks = tuple(-(-side // BLOCK_PX) for side in transport.camera_shape)
    white = np.empty((count, 3, *blocks), np.float32)
    target = np.empty((3, *blocks), np.float32)
    _block_means(target_light, target)
    ones, light = np.ones((3, transport.pixels), np.float32), target_light
    for n in range(count):
        transport.forward_planes(ones, projectors=(n, n + 1), out=light)
        _block_means(light, white[n])
    del ones
    _solve_blocks(white, transport.mixing.astype(np.float64), target)
    found = np.zeros((3, transport.pixels), np.float32)
    for n in range(count):
        _upsample(white[n], light)
        found[:, transport.span(n)] = transport.gaussian_mean_planes(light, projectors=(n, n + 1))[:, transport.span(n)]
    return np.clip(found, 0, 1, out=found)


@compiled(parallel=True)
def _block_means(image: FloatImage, out: FloatImage) -> None:
    """Means of (3, rows, columns) over blocks."""
    _, rows, columns = image.shape
    for y in prange(out.shape[1]):
        for c in range(3):
            for x in range(out.shape[2]):
                total, n = np.float32(0), 0
                for r in range(BLOCK_PX * y, min(BLOCK_PX * (y + 1), rows)):
                    for k in range(BLOCK_PX * x, min(BLOCK_PX * (x + 1), columns)):
                        total += image[c, r, k]
                        n += 1
                out[c, y, x] = total / np.float32(n)


@compiled(parallel=True)
def _upsample(blocks: FloatImage, out: FloatImage) -> None:
    """Each pixel of (3, rows, columns) from its block."""
    for y in prange(out.shape[1]):
        for c in range(3):
            for x in range(out.shape[2]):
                out[c, y, x] = blocks[c, y // BLOCK_PX, x // BLOCK_PX]


@compiled(parallel=True)
def _solve_blocks(white: FloatImage, mixing: Float64, target: FloatImage) -> None:
    """Replace ``white`` (projectors, 3, rows, columns) by what each projector should show there."""
    count, _, rows, columns = white.shape
    for y in prange(rows):
        B, p, light = np.empty((3, 3 * count)), np.empty(3 * count), np.empty(3)
        for x in range(columns):
            for n in range(count):
                for c in range(3):
                    for d in range(3):
                        B[c, 3 * n + d] = white[n, c, y, x] * mixing[n, c, d]
            for c in range(3):
                light[c] = target[c, y, x]
            _solve_block(B, light, p)
            for n in range(count):
                for c in range(3):
                    white[n, c, y, x] = p[3 * n + c]


@compiled()
def _solve_block(B: Float64, light: Float64, p: Float64) -> None:
    """Write what makes the ``light`` (3,) by B p, 0 <= p <= 1, as nearly and as alike as possible to ``p``."""
    a, b, c, d, e, f, g, h, i = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(0, p.size, 3):
        a, b, c = a + B[0, k], b + B[0, k + 1], c + B[0, k + 2]
        d, e, f = d + B[1, k], e + B[1, k + 1], f + B[1, k + 2]
        g, h, i = g + B[2, k], h + B[2, k + 1], i + B[2, k + 2]
    determinant = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)
    size = (a * a + e * e + i * i) / 3
    if not determinant > LEAST_DETERMINANT * size * np.sqrt(size):
        # without light, or in fewer than three colours: channel by channel
        r, s, t = light[0] / max(a, 1e-30), light[1] / max(e, 1e-30), light[2] / max(i, 1e-30)
    else:
        r = light[0] * (e * i - f * h) + light[1] * (c * h - b * i) + light[2] * (b * f - c * e)
        s = light[0] * (f * g - d * i) + light[1] * (a * i - c * g) + light[2] * (c * d - a * f)
        t = light[0] * (d * h - e * g) + light[1] * (b * g - a * h) + light[2] * (a * e - b * d)
        r, s, t = r / determinant, s / determinant, t / determinant
    for k in range(0, p.size, 3):
        p[k], p[k + 1], p[k + 2] = min(max(r, 0.0), 1.0), min(max(s, 0.0), 1.0), min(max(t, 0.0), 1.0)
    if size > 0 and (min(r, s, t) < 0 or max(r, s, t) > 1):
        _active_set(B, light, RIDGE * size, p)


@compiled()
def _active_set(B: Float64, light: Float64, ridge: float, p: Float64) -> None:
    """min |B p - light|^2 + ridge |p - start|^2 in the unit box, from ``p``: active sets, exact but for the cap."""
    n = p.size
    H = B.T @ B + ridge * np.eye(n)
    start = p.copy()
    fixed = np.zeros(n, np.bool_)
    for _ in range(MOST_STEPS):
        gradient = B.T @ (B @ p - light) + ridge * (p - start)
        free = np.flatnonzero(~fixed)
        direction = np.zeros(n)
        if free.size > 0:
            part = np.empty((free.size, free.size))
            for i in range(free.size):
                for j in range(free.size):
                    part[i, j] = H[free[i], free[j]]
            direction[free] = -np.linalg.solve(part, gradient[free])
        length, stop = 1.0, -1
        for k in range(free.size):
            i = int(free[k])
            d = direction[i]
            room = (1 - p[i]) / d if d > 1e-12 else (p[i] / -d if d < -1e-12 else 1.0)
            if room < length:
                length, stop = room, i
        p += length * direction
        if stop >= 0:
            p[stop] = 1.0 if direction[stop] > 0 else 0.0
            fixed[stop] = True
            continue
        gradient = B.T @ (B @ p - light) + ridge * (p - start)
        worst, most = -1, 1e-9 * ridge
        for i in range(n):
            inward = gradient[i] if p[i] > 0.5 else -gradient[i]
            if fixed[i] and inward > most:
                worst, most = i, inward
        if worst < 0:
            return
        fixed[worst] = False
