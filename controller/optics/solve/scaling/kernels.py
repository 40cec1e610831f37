"""The loops of ``solve.scaling.interactive``.

The scale image is kept flat, four floats a block (the fourth is 0 or of no account), with ``MARGIN`` blocks of zeros
around it, so that no window ends outside.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt
from numba import prange

from controller.bundle.live_maps import MOST_CORRELATION, MOST_RADIUS_PX, REACH, TILE
from controller.core.arrays import ByteImage, FloatImage
from controller.core.jit import compiled
from controller.optics.solve.scaling.reflected import ReflectedLight, reflected_row
from controller.optics.transport.simd.scaling import (
    SIDE,
    STEPS,
    Index,
    own_steps,
    scale_of_four,
    scale_of_one,
    window_steps,
)

MARGIN: Final = SIDE
LEVELS: Final = STEPS + 1

_REACH, _RADIUS, _CORRELATION = np.float32(REACH), np.float32(MOST_RADIUS_PX), np.float32(MOST_CORRELATION)

Used = npt.NDArray[np.int32]


@compiled(parallel=True)
def scale_twos(
    picture: FloatImage, gain: FloatImage, offset: FloatImage, used: Used, columns: int, side: int, scale: FloatImage
) -> bool:
    """Scale of blocks of 2 x 2 pixels of a radiance with ``columns`` per row; whether all used values are finite."""
    rows, wide = used.shape[0], columns // 2
    good = np.ones(rows, np.bool_)
    for y in prange(rows):
        a, b = 6 * y * columns, 6 * y * columns + 3 * columns
        into = (y + MARGIN) * side + MARGIN
        total = np.float32(0)
        for x in range(np.int64(used[y, 0]), np.int64(used[y, 1])):
            light = scale_of_four(picture, a + 6 * x, b + 6 * x, gain, offset, y * wide + x, scale, into + x)
            total += light * np.float32(0)
        for x in range(np.int64(used[y, 0])):
            k = 6 * x
            for c in range(6):
                total += (picture[a + k + c] + picture[b + k + c]) * np.float32(0)
        for k in range(6 * np.int64(used[y, 1]), 3 * columns):
            total += (picture[a + k] + picture[b + k]) * np.float32(0)
        good[y] = total == 0
    return bool(good.all())


@compiled()
def _reflected_rows(reflected: ReflectedLight, row: int, block: int, rows: int, columns: int) -> FloatImage:
    """(block, 3 x columns): light by way of other surfaces in a row of blocks; 0 where there is none."""
    found = np.zeros((block, 3 * columns), np.float32)
    if reflected.surface.size:
        for v in range(row * block, min((row + 1) * block, rows)):
            reflected_row(reflected, v, 0, columns, found[v - row * block])
    return found


@compiled()
def _scale_row(
    wanted: FloatImage,
    row: int,
    rows: int,
    gain: FloatImage,
    offset: FloatImage,
    paint: FloatImage,
    scale: FloatImage,
    into: Index,
) -> None:
    """The scale of a row of blocks; ``wanted`` (block, 3 x columns): what of the target's light is left to be made."""
    block, columns = wanted.shape[0], wanted.shape[1] // 3
    share = np.float32(1 / block**2)
    for x in range(-(-columns // block)):
        reds = greens = blues = np.float32(0)
        for v in range(min(block, rows - row * block)):
            for u in range(x * block, min((x + 1) * block, columns)):
                i = 3 * ((row * block + v) * columns + u)
                r = wanted[v, 3 * u] * gain[i] - offset[i]
                g = wanted[v, 3 * u + 1] * gain[i + 1] - offset[i + 1]
                b = wanted[v, 3 * u + 2] * gain[i + 2] - offset[i + 2]
                if paint.size:
                    k = 3 * i
                    red = r + paint[k] * r + paint[k + 1] * g + paint[k + 2] * b
                    green = g + paint[k + 3] * r + paint[k + 4] * g + paint[k + 5] * b
                    b = b + paint[k + 6] * r + paint[k + 7] * g + paint[k + 8] * b
                    r, g = red, green
                reds += max(r, np.float32(0))
                greens += max(g, np.float32(0))
                blues += max(b, np.float32(0))
        scale[4 * (into + x)], scale[4 * (into + x) + 1] = reds * share, greens * share
        scale[4 * (into + x) + 2] = blues * share


@compiled(parallel=True)
def scale_plainly(
    picture: FloatImage,
    block: int,
    gain: FloatImage,
    offset: FloatImage,
    used: Used,
    side: int,
    scale: FloatImage,
    reflected: ReflectedLight,
    paint: FloatImage,
) -> bool:
    """The scale of a radiance (rows, columns, 3) of the targets' size, in blocks; whether all is finite.

    ``paint`` (9 x target pixels,): as ``LiveMaps.paint``; of no size where there is none
    """
    rows, columns, _ = picture.shape
    high = -(-rows // block)
    good = np.ones(high, np.bool_)
    for row in prange(high):
        total = np.float32(0)
        wanted = _reflected_rows(reflected, row, block, rows, columns)
        for v in range(row * block, min((row + 1) * block, rows)):
            line = wanted[v - row * block]
            for u in range(columns):
                for c in range(3):
                    total += picture[v, u, c] * np.float32(0)
                    line[3 * u + c] = picture[v, u, c] - line[3 * u + c]
        _scale_row(wanted, row, rows, gain, offset, paint, scale, (row + MARGIN) * side + MARGIN)
        good[row] = total == 0
    return bool(good.all())


@compiled(parallel=True)
def _reduced(picture: FloatImage, factor: int, out: FloatImage) -> None:
    """Means over blocks of ``factor`` pixels, the edge repeated."""
    rows, columns, _ = picture.shape
    share = np.float32(1 / factor**2)
    for y in prange(out.shape[0]):
        for x in range(out.shape[1]):
            for c in range(3):
                light = np.float32(0)
                for j in range(factor):
                    for i in range(factor):
                        light += picture[min(y * factor + j, rows - 1), min(x * factor + i, columns - 1), c]
                out[y, x, c] = light * share


def small_picture(picture: FloatImage, factor: int) -> FloatImage:
    """A radiance reduced to the targets' size."""
    rows, columns, _ = picture.shape
    small = np.empty((-(-rows // factor), -(-columns // factor), 3), np.float32)
    _reduced(picture, factor, small)
    return small


@compiled(parallel=True)
def scale_picture(
    picture: ByteImage,
    light: FloatImage,
    block: int,
    gain: FloatImage,
    offset: FloatImage,
    used: Used,
    side: int,
    scale: FloatImage,
    reflected: ReflectedLight,
    paint: FloatImage,
) -> None:
    """The scale of a picture (rows, columns, 3) of the targets' size; ``light`` (256,): radiance of its values.

    ``paint``: as of ``scale_plainly``
    """
    rows, columns, _ = picture.shape
    for row in prange(-(-rows // block)):
        into = (row + MARGIN) * side + MARGIN
        first, last = np.int64(used[row, 0]), np.int64(used[row, 1])
        if block == 1 and paint.size == 0 and reflected.surface.size:
            less = np.empty((1, 3 * columns), np.float32)
            reflected_row(reflected, row, first, last, less[0])
            for x in range(first, last):
                r = light[picture[row, x, 0]] - less[0, 3 * x]
                g = light[picture[row, x, 1]] - less[0, 3 * x + 1]
                b = light[picture[row, x, 2]] - less[0, 3 * x + 2]
                scale_of_one(r, g, b, gain, offset, row * columns + x, scale, into + x)
            continue
        if block == 1 and paint.size == 0:
            for x in range(first, last):
                r, g, b = light[picture[row, x, 0]], light[picture[row, x, 1]], light[picture[row, x, 2]]
                scale_of_one(r, g, b, gain, offset, row * columns + x, scale, into + x)
            continue
        wanted = _reflected_rows(reflected, row, block, rows, columns)
        for v in range(row * block, min((row + 1) * block, rows)):
            line = wanted[v - row * block]
            for u in range(columns):
                for c in range(3):
                    line[3 * u + c] = light[picture[v, u, c]] - line[3 * u + c]
        _scale_row(wanted, row, rows, gain, offset, paint, scale, into)


@compiled(parallel=True)
def show(
    scale: FloatImage,
    side: int,
    at: npt.NDArray[np.int32],
    shares: ByteImage,
    gain: FloatImage,
    unmix: FloatImage,
    segment: np.float32,
    levels: npt.NDArray[np.uint16],
    noise: ByteImage,
    columns: int,
    out: ByteImage,
) -> None:
    """Each pixel's mean of the scale, times its base, unmixed, through the response, dithered. All arrays flat.

    ``segment``: as of ``OutputMaps``
    """
    for y in prange(at.size // columns):
        tile = np.int64(y & (TILE - 1)) * (3 * TILE)
        for x in range(columns):
            # indices without a sign: numba looks at the others, whether they count from the end
            i, k = np.uint64(y * columns + x), np.uint64(tile + 3 * (x & (TILE - 1)))
            first = np.int64(at[i])
            r = g = b = np.int64(0)
            if first >= 0 and segment > 0:
                r, g, b = own_steps(scale, first, side, shares, np.int64(i), gain, unmix, segment)
            elif first >= 0:
                r, g, b = window_steps(scale, first, side, shares, np.int64(i), gain, unmix)
            j, bits = np.uint64(3) * i, np.uint32(8)
            green, blue = np.uint64(g) + np.uint64(LEVELS), np.uint64(b) + np.uint64(2 * LEVELS)
            out[j] = (np.uint32(levels[np.uint64(r)]) + np.uint32(noise[k])) >> bits
            out[j + np.uint64(1)] = (np.uint32(levels[green]) + np.uint32(noise[k + np.uint64(1)])) >> bits
            out[j + np.uint64(2)] = (np.uint32(levels[blue]) + np.uint32(noise[k + np.uint64(2)])) >> bits


@compiled()
def _half_window(sigma: np.float32) -> np.float32:
    """How far a Gaussian of this standard deviation counts."""
    return min(max(_REACH * sigma, np.float32(0.5)), _RADIUS)


@compiled()
def _height(shape: FloatImage, u: int, v: int) -> np.float32:
    """A Gaussian's height at a column and row; ``shape`` as for ``_shares_in``."""
    dx, dy, r = (u - shape[0]) / shape[2], (v - shape[1]) / shape[3], shape[4]
    return np.float32(np.exp(np.float32(-0.5) * (dx * dx - 2 * r * dx * dy + dy * dy) / (1 - r * r)))


@compiled()
def _shares_in(
    shape: FloatImage, left: int, top: int, block: int, present: ByteImage, found: FloatImage, lit: FloatImage
) -> None:
    """A Gaussian's shares of the sixteen blocks from (``left``, ``top``) on, and those of pixels with base light.

    ``shape``: middle x, y, standard deviations x, y, correlation
    """
    x, y, reach_x, reach_y = shape[0], shape[1], _half_window(shape[2]), _half_window(shape[3])
    found[:], lit[:] = 0, 0
    first_row = max(top * block, int(np.ceil(y - reach_y)), 0)
    first_column = max(left * block, int(np.ceil(x - reach_x)), 0)
    for v in range(first_row, min((top + SIDE) * block, int(np.floor(y + reach_y)) + 1, present.shape[0])):
        for u in range(first_column, min((left + SIDE) * block, int(np.floor(x + reach_x)) + 1, present.shape[1])):
            share = _height(shape, u, v)
            k = (v // block - top) * SIDE + u // block - left
            found[k] += share
            lit[k] += share * present[v, u]


@compiled()
def _brightest(shape: FloatImage, present: ByteImage) -> tuple[int, int]:
    """The (row, column) with base light at which a Gaussian is highest; (-1, -1) if it reaches none."""
    x, y, reach_x, reach_y = shape[0], shape[1], _half_window(shape[2]), _half_window(shape[3])
    row, column, most = -1, -1, np.float32(0)
    for v in range(max(int(np.ceil(y - reach_y)), 0), min(int(np.floor(y + reach_y)) + 1, present.shape[0])):
        for u in range(max(int(np.ceil(x - reach_x)), 0), min(int(np.floor(x + reach_x)) + 1, present.shape[1])):
            share = _height(shape, u, v) * present[v, u]
            if share > most:
                row, column, most = v, u, share
    return row, column


@compiled(parallel=True)
def shares_of(
    centre: FloatImage,
    shape: ByteImage,
    sigmas: FloatImage,
    block: int,
    present: ByteImage,
    side: int,
    at: npt.NDArray[np.int32],
    shares: ByteImage,
) -> None:
    """Each pixel's Gaussian (``bundle.live_maps``) by blocks: the window's first block, and sixteen shares of 255.

    The window lies around the middle. Where that has no base light, and only the edge of the Gaussian reaches some, it
    lies around the brightest pixel there: the reference scales such a pixel by what its edge sees.
    """
    for i in prange(at.size):
        at[i] = -1
        if shape[i, 0] == 0:
            continue
        r = (np.float32(shape[i, 2]) - np.float32(128)) / np.float32(127)
        pixel = np.empty(5, np.float32)
        pixel[0], pixel[1], pixel[2], pixel[3] = centre[i, 0], centre[i, 1], sigmas[shape[i, 0]], sigmas[shape[i, 1]]
        pixel[4] = min(max(r, -_CORRELATION), _CORRELATION)
        found, lit = np.empty(SIDE * SIDE, np.float32), np.empty(SIDE * SIDE, np.float32)
        left = int(np.floor((pixel[0] + np.float32(0.5)) / block - np.float32(0.5))) - (SIDE // 2 - 1)
        top = int(np.floor((pixel[1] + np.float32(0.5)) / block - np.float32(0.5))) - (SIDE // 2 - 1)
        _shares_in(pixel, left, top, block, present, found, lit)
        most = found.max()
        if lit.max() < 255 * most / 510:  # less than the smallest share: 8 bits lose it
            row, column = _brightest(pixel, present)
            if row < 0:
                continue
            left, top = column // block - (SIDE // 2 - 1), row // block - (SIDE // 2 - 1)
            _shares_in(pixel, left, top, block, present, found, lit)
            most = np.float32(0)
            for k in range(SIDE * SIDE):
                most = max(most, found[k] if lit[k] > 0 else np.float32(0))
        if most > 0:
            at[i] = (top + MARGIN) * side + left + MARGIN
            for k in range(SIDE * SIDE):
                shares[i, k] = np.uint8(min(np.float32(255) * found[k] / most, np.float32(255)) + np.float32(0.5))


@compiled(parallel=True)
def sums_of(present: FloatImage, side: int, at: npt.NDArray[np.int32], shares: ByteImage, out: FloatImage) -> None:
    """Each pixel's sum of its shares times ``present``, a number a block."""
    for i in prange(at.size):
        if at[i] < 0:
            continue
        total = np.float32(0)
        for row in range(SIDE):
            for k in range(SIDE):
                total += np.float32(shares[i, row * SIDE + k]) * present[at[i] + row * side + k]
        out[i] = total
