"""The products T p and T' r over patches, for three channels at once.

Images are planar here, (3, rows, columns), and projector values (3, pixels): lanes of one channel lie side by side.
``gain`` (projectors, 3, rows, columns) is white image over sum of weights, 0 where a camera pixel counts for nothing;
``mixing`` (projectors, 3, 3) is camera channel by projector channel.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from controller.core.arrays import FloatImage, Mask
from controller.core.jit import compiled
from controller.optics.transport.gaussians.patches import TILE_COLUMNS, TILE_ROWS, Patches
from controller.optics.transport.simd.gaussians import LANES, collect_lanes, spread_lanes


@compiled(fastmath=True)
def _multiply(into: FloatImage, a: FloatImage, b: FloatImage) -> None:
    for i in range(into.size):
        into[i] = a[i] * b[i]


@compiled(fastmath=True)
def _multiply_add(into: FloatImage, a: FloatImage, b: FloatImage) -> None:
    for i in range(into.size):
        into[i] += a[i] * b[i]


@compiled(fastmath=True)
def _keep(into: FloatImage, lit: Mask, a: FloatImage) -> None:
    for i in range(into.size):
        into[i] = a[i] if lit[i] else np.float32(0)


@compiled(fastmath=True)
def _spread(
    patches: Patches,
    v: int,
    at: int,
    stride: int,
    light: tuple[np.float32, np.float32, np.float32],
    red: FloatImage,
    green: FloatImage,
    blue: FloatImage,
) -> None:
    """Add patch ``v``, times its light, to the three planes of a tile."""
    r, g, b = light
    k = int(patches.first[v]) * LANES
    for _ in range(patches.rows[v]):
        for i in range(patches.groups[v]):
            spread_lanes(red, green, blue, at + i * LANES, patches.weights, k, r, g, b)
            k += LANES
        at += stride


@compiled(parallel=True, fastmath=True)
def forward_planes(
    patches: Patches, gain: FloatImage, mixing: FloatImage, p: FloatImage, projectors: tuple[int, int], out: FloatImage
) -> None:
    """Write sum over the projectors n of ``gain``_n (.) G_n (M_n p_n) to ``out`` (3, rows, columns)."""
    height, width = patches.camera_shape
    margin_rows, margin_columns = patches.margin
    across = (width + TILE_COLUMNS - 1) // TILE_COLUMNS
    tiles = (height + TILE_ROWS - 1) // TILE_ROWS * across
    stride = TILE_COLUMNS + 2 * margin_columns
    size = (TILE_ROWS + 2 * margin_rows) * stride
    for t in prange(tiles):
        top, left = t // across * TILE_ROWS, t % across * TILE_COLUMNS
        bottom, right = min(top + TILE_ROWS, height), min(left + TILE_COLUMNS, width)
        out[:, top:bottom, left:right] = 0
        red, green, blue = np.empty(size, np.float32), np.empty(size, np.float32), np.empty(size, np.float32)
        for n in range(projectors[0], projectors[1]):
            begin, end = patches.tile_first[n * tiles + t], patches.tile_first[n * tiles + t + 1]
            if begin == end:
                continue
            red[:] = 0
            green[:] = 0
            blue[:] = 0
            M = mixing[n]
            for i in range(begin, end):
                v = patches.members[i]
                a, b, c = p[0, v], p[1, v], p[2, v]
                light = (
                    M[0, 0] * a + M[0, 1] * b + M[0, 2] * c,
                    M[1, 0] * a + M[1, 1] * b + M[1, 2] * c,
                    M[2, 0] * a + M[2, 1] * b + M[2, 2] * c,
                )
                at = (patches.row[v] - top + margin_rows) * stride + patches.column[v] - left + margin_columns
                _spread(patches, v, at, stride, light, red, green, blue)
            for y in range(top, bottom):
                o = (y - top + margin_rows) * stride + margin_columns
                e = o + right - left
                _multiply_add(out[0, y, left:right], gain[n, 0, y, left:right], red[o:e])
                _multiply_add(out[1, y, left:right], gain[n, 1, y, left:right], green[o:e])
                _multiply_add(out[2, y, left:right], gain[n, 2, y, left:right], blue[o:e])


@compiled(fastmath=True)
def _collect(
    patches: Patches,
    v: int,
    at: int,
    stride: int,
    red: FloatImage,
    green: FloatImage,
    blue: FloatImage,
    sums: FloatImage,
) -> tuple[np.float32, np.float32, np.float32]:
    """Sum of a tile's three planes under patch ``v``; ``sums`` (24,) is scratch."""
    sums[:] = 0
    k = int(patches.first[v]) * LANES
    for _ in range(patches.rows[v]):
        for i in range(patches.groups[v]):
            collect_lanes(red, green, blue, at + i * LANES, patches.weights, k, sums)
            k += LANES
        at += stride
    r = g = b = np.float32(0)
    for q in range(LANES):
        r += sums[q]
        g += sums[LANES + q]
        b += sums[2 * LANES + q]
    return r, g, b


@compiled(parallel=True, fastmath=True)
def adjoint_planes(
    patches: Patches, gain: FloatImage, mixing: FloatImage, r: FloatImage, projectors: tuple[int, int], out: FloatImage
) -> None:
    """Write M_n' G_n' (``gain``_n (.) r) for the projectors n to ``out`` (3, pixels of all projectors)."""
    height, width = patches.camera_shape
    margin_rows, margin_columns = patches.margin
    across = (width + TILE_COLUMNS - 1) // TILE_COLUMNS
    tiles = (height + TILE_ROWS - 1) // TILE_ROWS * across
    stride = TILE_COLUMNS + margin_columns
    size = (TILE_ROWS + margin_rows) * stride
    out[:, patches.start[projectors[0]] : patches.start[projectors[1]]] = 0
    for t in prange(tiles):
        top, left = t // across * TILE_ROWS, t % across * TILE_COLUMNS
        bottom, right = min(top + TILE_ROWS + margin_rows, height), min(left + stride, width)
        red, green, blue = np.zeros(size, np.float32), np.zeros(size, np.float32), np.zeros(size, np.float32)
        sums = np.empty(3 * LANES, np.float32)
        for n in range(projectors[0], projectors[1]):
            begin, end = patches.tile_first[n * tiles + t], patches.tile_first[n * tiles + t + 1]
            if begin == end:
                continue
            for y in range(top, bottom):
                o = (y - top) * stride
                e = o + right - left
                _multiply(red[o:e], gain[n, 0, y, left:right], r[0, y, left:right])
                _multiply(green[o:e], gain[n, 1, y, left:right], r[1, y, left:right])
                _multiply(blue[o:e], gain[n, 2, y, left:right], r[2, y, left:right])
            M = mixing[n]
            for i in range(begin, end):
                v = patches.members[i]
                # A patch that touches several tiles is summed by the one its first weight lies in.
                if patches.row[v] < top or patches.column[v] < left:
                    continue
                at = (patches.row[v] - top) * stride + patches.column[v] - left
                a, b, c = _collect(patches, v, at, stride, red, green, blue, sums)
                out[0, v] = M[0, 0] * a + M[1, 0] * b + M[2, 0] * c
                out[1, v] = M[0, 1] * a + M[1, 1] * b + M[2, 1] * c
                out[2, v] = M[0, 2] * a + M[1, 2] * b + M[2, 2] * c


@compiled(parallel=True, fastmath=True)
def gaussian_sums(
    patches: Patches, lit: Mask, image: FloatImage, factor: FloatImage, projectors: tuple[int, int], out: FloatImage
) -> None:
    """Write ``factor``_v times the sum of ``image`` under each Gaussian to ``out`` (3, pixels of all projectors).

    ``lit`` (projectors, rows, columns): camera pixels that count; ``factor`` (pixels,); ``image`` (3, rows, columns)
    """
    height, width = patches.camera_shape
    margin_rows, margin_columns = patches.margin
    across = (width + TILE_COLUMNS - 1) // TILE_COLUMNS
    tiles = (height + TILE_ROWS - 1) // TILE_ROWS * across
    stride = TILE_COLUMNS + margin_columns
    size = (TILE_ROWS + margin_rows) * stride
    out[:, patches.start[projectors[0]] : patches.start[projectors[1]]] = 0
    for t in prange(tiles):
        top, left = t // across * TILE_ROWS, t % across * TILE_COLUMNS
        bottom, right = min(top + TILE_ROWS + margin_rows, height), min(left + stride, width)
        red, green, blue = np.zeros(size, np.float32), np.zeros(size, np.float32), np.zeros(size, np.float32)
        sums = np.empty(3 * LANES, np.float32)
        for n in range(projectors[0], projectors[1]):
            begin, end = patches.tile_first[n * tiles + t], patches.tile_first[n * tiles + t + 1]
            if begin == end:
                continue
            for y in range(top, bottom):
                o = (y - top) * stride
                e = o + right - left
                _keep(red[o:e], lit[n, y, left:right], image[0, y, left:right])
                _keep(green[o:e], lit[n, y, left:right], image[1, y, left:right])
                _keep(blue[o:e], lit[n, y, left:right], image[2, y, left:right])
            for i in range(begin, end):
                v = patches.members[i]
                if patches.row[v] < top or patches.column[v] < left:
                    continue
                at = (patches.row[v] - top) * stride + patches.column[v] - left
                a, b, c = _collect(patches, v, at, stride, red, green, blue, sums)
                out[0, v], out[1, v], out[2, v] = a * factor[v], b * factor[v], c * factor[v]


@compiled(parallel=True, fastmath=True)
def multiply_add(into: FloatImage, a: FloatImage, b: FloatImage) -> None:
    """Add ``a`` times ``b`` to ``into``, all (3, rows, columns)."""
    rows = into.shape[1]
    for line in prange(3 * rows):
        _multiply_add(into[line // rows, line % rows], a[line // rows, line % rows], b[line // rows, line % rows])
