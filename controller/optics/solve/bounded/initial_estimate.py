"""Where a solve starts: the best frames for a stage whose light were smooth, place by place.

At one place of the camera's image, all projectors together make the light B p, with three rows and three columns a
projector. Where one colour for all projectors gives the wanted light within [0, 1], that is the initial estimate.
Elsewhere the projectors have to differ: one may give a colour without crosstalk, another one's crosstalk may be needed.
Sweeps find that slowly, since it changes the light by little; here it is a problem of a few unknowns
(docs/decisions/0008).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final
from weakref import WeakKeyDictionary

import numpy as np
from numba import prange

from controller.core.arrays import Float64, FloatImage
from controller.core.jit import compiled
from controller.optics.transport import LightTransport

FAINTEST: Final = 1e-3
"""Fraction of a projector's brightest observed pixel below which a pixel counts as in shadow."""
BLOCK_PX: Final = 4
"""Places are blocks of camera pixels, about one and a half metapixels wide; of 2, a sweep less, for twice the time."""
RIDGE: Final = 1e-4
"""Pull towards equal projectors, of the mean squared light: decides where the light leaves a choice."""
MOST_STEPS: Final = 40
MOST_HALVINGS: Final = 30
CLOSE: Final = 1e-6
"""The light may miss its optimum by this part of the root of the pull, a hundredth of all projectors' light."""
SINGLE_MOST_HALVINGS: Final = 20
SINGLE_CLOSE: Final = 1e-6
"""The same for a graphics processor, in single precision; the latter is a part of all projectors' light."""
LEVEL: Final = 1e-3
"""Share of a step's slope that may be left, uphill, at its end."""
LEAST_DETERMINANT: Final = 1e-3
"""Of the three colours at a place, relative to those of pure primaries."""


@dataclass(frozen=True, slots=True, eq=False)
class WhiteLight:
    """What solves need of a stage's projectors alone, each showing white: calculated once.

    ``observed`` (3, pixels) float32: the mean over each pixel's own light
    ``faint`` (projectors,): up to this an observed pixel counts as in shadow
    ``blocks`` (projectors, 3, rows, columns) float32: means over blocks of camera pixels
    """

    observed: FloatImage
    faint: tuple[float, ...]
    blocks: FloatImage


_white: Final[WeakKeyDictionary[LightTransport, WhiteLight]] = WeakKeyDictionary()


def white_light(transport: LightTransport) -> WhiteLight:
    """Of a stage; kept as long as its transport is. What two threads ask for at once may be calculated twice."""
    made = _white.get(transport)
    if made is None:
        made = _white[transport] = _see_white(transport)
    return made


def _see_white(transport: LightTransport) -> WhiteLight:
    grid = blocks_of(transport.camera_shape)
    blocks = np.empty((len(transport.sizes), 3, *grid), np.float32)
    observed, ones = np.empty((3, transport.pixels), np.float32), np.ones((3, transport.pixels), np.float32)
    light, faint = np.empty((3, *transport.camera_shape), np.float32), []
    for n, white in enumerate(blocks):
        own = transport.span(n)
        transport.forward_planes(ones, projectors=(n, n + 1), out=light)
        block_means(light, white)
        observed[:, own] = transport.gaussian_mean_planes(light, projectors=(n, n + 1))[:, own]
        faint.append(float(FAINTEST * observed[:, own].max(initial=0)))
    return WhiteLight(observed, tuple(faint), blocks)


def blocks_of(camera_shape: tuple[int, int]) -> tuple[int, int]:
    """How many blocks of camera pixels lie one above the other, and side by side."""
    return -(-camera_shape[0] // BLOCK_PX), -(-camera_shape[1] // BLOCK_PX)


def initial_estimate(transport: LightTransport, target: FloatImage) -> FloatImage:
    """(3, pixels of all projectors) in [0, 1] for ``target`` (3, rows, columns): the wanted light by blocks."""
    shown = white_light(transport).blocks.copy()
    _solve_blocks(shown, transport.mixing.astype(np.float64), target)
    found = np.empty((3, transport.pixels), np.float32)
    light = np.empty((3, *transport.camera_shape), np.float32)
    for n, blocks in enumerate(shown):
        _upsample(blocks, light)
        found[:, transport.span(n)] = transport.gaussian_mean_planes(light, projectors=(n, n + 1))[:, transport.span(n)]
    return np.clip(found, 0, 1, out=found)


@compiled(parallel=True)
def block_means(image: FloatImage, out: FloatImage) -> None:
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
    # light of each camera channel by the colours of all projectors together
    rr, rg, rb, gr, gg, gb, br, bg, bb = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(0, p.size, 3):
        rr, rg, rb = rr + B[0, k], rg + B[0, k + 1], rb + B[0, k + 2]
        gr, gg, gb = gr + B[1, k], gg + B[1, k + 1], gb + B[1, k + 2]
        br, bg, bb = br + B[2, k], bg + B[2, k + 1], bb + B[2, k + 2]
    determinant = rr * (gg * bb - gb * bg) - rg * (gr * bb - gb * br) + rb * (gr * bg - gg * br)
    size = (rr * rr + gg * gg + bb * bb) / 3
    if not determinant > LEAST_DETERMINANT * size * np.sqrt(size):
        # without light, or in fewer than three colours: channel by channel
        red, green, blue = light[0] / max(rr, 1e-30), light[1] / max(gg, 1e-30), light[2] / max(bb, 1e-30)
    else:
        red = light[0] * (gg * bb - gb * bg) + light[1] * (rb * bg - rg * bb) + light[2] * (rg * gb - rb * gg)
        green = light[0] * (gb * br - gr * bb) + light[1] * (rr * bb - rb * br) + light[2] * (rb * gr - rr * gb)
        blue = light[0] * (gr * bg - gg * br) + light[1] * (rg * br - rr * bg) + light[2] * (rr * gg - rg * gr)
        red, green, blue = red / determinant, green / determinant, blue / determinant
    for k in range(0, p.size, 3):
        p[k], p[k + 1], p[k + 2] = min(max(red, 0.0), 1.0), min(max(green, 0.0), 1.0), min(max(blue, 0.0), 1.0)
    if size > 0 and (min(red, green, blue) < 0 or max(red, green, blue) > 1):
        _shared_out(B, light, RIDGE * size, p)


@compiled()
def _shared_out(B: Float64, light: Float64, ridge: float, p: Float64) -> None:
    """Write min |B p - light|^2 + ridge |p - start|^2 in the unit box to ``p``, which holds the start.

    With y = (B p - light) / ridge, the best p is start - B' y, bounds kept. So there are three unknowns, however many
    projectors there are: Newton's method on ridge y = B p(y) - light, the gradient of a convex function of y. A step
    is halved until that function still falls at its end.
    """
    start = p.copy()
    y, gradient, step = np.zeros(3), np.empty(3), np.empty(3)
    _dual(B, light, ridge, start, y, p, gradient)
    close = CLOSE * ridge**0.5
    for _ in range(MOST_STEPS):
        if max(abs(gradient[0]), abs(gradient[1]), abs(gradient[2])) < close:
            return
        _newton_step(B, ridge, start, y, gradient, step)
        slope = gradient[0] * step[0] + gradient[1] * step[1] + gradient[2] * step[2]
        if not slope < 0:
            return
        length = 1.0
        for _ in range(MOST_HALVINGS):
            ahead = y + length * step
            _dual(B, light, ridge, start, ahead, p, gradient)
            if gradient[0] * step[0] + gradient[1] * step[1] + gradient[2] * step[2] <= -LEVEL * slope:
                break
            length /= 2
        y[:] = ahead


@compiled()
def _dual(B: Float64, light: Float64, ridge: float, start: Float64, y: Float64, p: Float64, gradient: Float64) -> None:
    """Write start - B' y in the unit box to ``p``, and ridge y + light - B p to ``gradient``."""
    for c in range(3):
        gradient[c] = ridge * y[c] + light[c]
    for k in range(p.size):
        p[k] = min(max(start[k] - B[0, k] * y[0] - B[1, k] * y[1] - B[2, k] * y[2], 0.0), 1.0)
        for c in range(3):
            gradient[c] -= B[c, k] * p[k]


@compiled()
def _newton_step(B: Float64, ridge: float, start: Float64, y: Float64, gradient: Float64, step: Float64) -> None:
    """Write -(ridge I + B_f B_f')^-1 gradient, f the numbers that are off their bounds, to ``step``."""
    h00, h01, h02, h11, h12, h22 = ridge, 0.0, 0.0, ridge, 0.0, ridge
    for k in range(start.size):
        red, green, blue = B[0, k], B[1, k], B[2, k]
        if 0 < start[k] - red * y[0] - green * y[1] - blue * y[2] < 1:
            h00, h01, h02, h11, h12, h22 = (
                h00 + red * red,
                h01 + red * green,
                h02 + red * blue,
                h11 + green * green,
                h12 + green * blue,
                h22 + blue * blue,
            )
    # the Hessian h = l l' (Cholesky: it is positive definite), then l z = -gradient and l' step = z
    l00 = h00**0.5
    l10, l20 = h01 / l00, h02 / l00
    l11 = (h11 - l10 * l10) ** 0.5
    l21 = (h12 - l10 * l20) / l11
    l22 = (h22 - l20 * l20 - l21 * l21) ** 0.5
    z0 = -gradient[0] / l00
    z1 = (-gradient[1] - l10 * z0) / l11
    z2 = (-gradient[2] - l20 * z0 - l21 * z1) / l22
    step[2] = z2 / l22
    step[1] = (z1 - l21 * step[2]) / l11
    step[0] = (z0 - l10 * step[1] - l20 * step[2]) / l00
