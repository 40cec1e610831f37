"""Which windows there are: a walk over a camera picture, for one projector, that counts them and then writes them."""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt
from numba import prange

from controller.core.arrays import Float64, FloatImage, Mask
from controller.core.jit import compiled
from controller.optics.transport.windows.profiles import (
    LANES,
    PHASE_BITS,
    PHASES,
    SHEAR_BITS,
    SHEARS,
    SKEW_STEPS,
    SKEWS,
    SMALL_PHASES,
    SMALLEST_PX,
    STEP,
    Profiles,
    SmallProfiles,
)
from controller.optics.transport.windows.sample_kernels import (
    BEYOND,
    LEAST_INSIDE,
    LEAST_SHEAR,
    MOST_SHEAR,
    NEAR,
    OTHER,
    SKEWED,
    SORTS,
    STRIP,
    TILE,
    UPRIGHT,
    kind_of,
)

BANDS: Final = 16
"""Of rows of the camera's picture, which are walked over at the same time."""
UPRIGHT_BELOW: Final = (LEAST_SHEAR + 0.5) / SHEARS
Shape = tuple[int, int, int, int]
"""Sort, table rows across and down, and skew."""


@compiled(parallel=True)
def walk(
    position: FloatImage,
    spread: FloatImage,
    apart: Float64,
    white: FloatImage,
    colours: npt.NDArray[np.int64],
    use: Mask,
    table: Profiles,
    small: SmallProfiles,
    halo: int,
    fill: npt.NDArray[np.int64],
    counting: bool,
    site: npt.NDArray[np.int32],
    at: npt.NDArray[np.uint16],
    across: npt.NDArray[np.uint16],
    down: npt.NDArray[np.uint16],
    skew: npt.NDArray[np.int8],
    gain: FloatImage,
) -> None:
    """Count the windows of each band, cell and sort in ``fill`` (bands, cells), or write them from there on.

    Arrays as in ``Windows``; ``apart`` (3, 5): what is added to place and spread of each of the camera's colours
    """
    rows, columns = spread.shape[:2]
    tiles_across = (columns + TILE - 1) // TILE
    tiles = (rows + TILE - 1) // TILE * tiles_across
    one = colours.size > 0
    for band in prange(BANDS):
        for r in range(band * use.shape[0] // BANDS, (band + 1) * use.shape[0] // BANDS):
            for c in range(use.shape[1]):
                if not use[r, c]:
                    continue
                for colour in range(3):
                    if (one and colours[r & 1, c & 1] != colour) or not white[r, c, colour] > 0:
                        continue
                    x, y = position[r, c, 0] + apart[colour, 0], position[r, c, 1] + apart[colour, 1]
                    # NaN fails every comparison
                    if not (-BEYOND <= x < columns + BEYOND - 1 and -BEYOND <= y < rows + BEYOND - 1):
                        continue
                    left, top = int(np.floor(x)), int(np.floor(y))
                    near_row = min(max(int(np.floor(y + 0.5)), 0), rows - 1)
                    near_column = min(max(int(np.floor(x + 0.5)), 0), columns - 1)
                    xx = spread[near_row, near_column, 0] + apart[colour, 2]
                    xy = spread[near_row, near_column, 1] + apart[colour, 3]
                    yy = spread[near_row, near_column, 2] + apart[colour, 4]
                    if not (xx > 0 and yy > 0 and xx * yy > xy * xy):
                        continue
                    shape = _shape(xx, xy, yy, x - left, y - top, table.small[0])
                    inside = _inside(table, small, left, top, shape, rows, columns)
                    if inside == 0:
                        continue
                    tile_row = min(max(top // TILE, 0), (rows - 1) // TILE)
                    tile_column = min(max(left // TILE, 0), tiles_across - 1)
                    cell = SORTS * (colour * tiles + tile_row * tiles_across + tile_column) + shape[0]
                    e = fill[band, cell]
                    fill[band, cell] = e + 1
                    if counting:
                        continue
                    site[e] = r * use.shape[1] + c + (0 if one else colour * use.size)
                    at[e] = _buffer_place(table, shape, top - tile_row * TILE, left - tile_column * TILE, halo)
                    across[e], down[e], skew[e] = shape[1], shape[2], shape[3]
                    gain[e] = white[r, c, colour] / inside


@compiled()
def _shape(xx: float, xy: float, yy: float, x: float, y: float, small: int) -> Shape:
    """Of the window of a place that lies (x, y) beyond a pixel, both below 1."""
    if kind_of(xx) < small and kind_of(yy) < small:
        # exp(-(a dx^2 + 2 b dx dy + c dy^2) / 2) is a row of the table in x and one in y, moved by b, times exp(-b i j)
        area = xx * yy - xy * xy
        steps = int(np.floor(min(max(-xy / area, -1e3), 1e3) * SKEWS + 0.5))
        wide, high = kind_of(area / yy), kind_of(area / xx)
        b = steps / SKEWS
        by_a, by_c = b * (SMALLEST_PX * STEP**wide) ** 2, b * (SMALLEST_PX * STEP**high) ** 2
        if abs(by_a) <= UPRIGHT_BELOW:
            return UPRIGHT, _small_row(kind_of(xx), x - 0.5), _small_row(kind_of(yy), y - 0.5), 0
        if abs(steps) <= SKEW_STEPS and abs(by_a) <= 1 and abs(by_c) <= 1:
            to_x, to_y = x - 0.5 + by_a * (y - 0.5), y - 0.5 + by_c * (x - 0.5)
            return SKEWED, _small_row(wide, to_x), _small_row(high, to_y), steps
    steps = int(np.floor(min(max(xy / yy, -MOST_SHEAR), MOST_SHEAR) * SHEARS + 0.5))
    steps = 0 if abs(steps) <= LEAST_SHEAR else steps
    k = steps / SHEARS
    wide, high = kind_of(xx - 2 * k * xy + k * k * yy), kind_of(yy)
    fx, fy = min(int(x * PHASES), PHASES - 1), min(int(y * PHASES), PHASES - 1)
    return OTHER, wide * PHASES + fx, high * PHASES + fy, steps


@compiled()
def _small_row(kind: int, from_middle: float) -> int:
    """The table's row for a place so far from the middle of the window."""
    phase = int(np.floor((from_middle + 1) * PHASES))
    return kind * SMALL_PHASES + min(max(phase, 0), SMALL_PHASES - 1)


@compiled()
def _buffer_place(table: Profiles, shape: Shape, top: int, left: int, halo: int) -> int:
    """Where the window of a pixel begins in its cell's buffer; ``top`` and ``left`` are relative to the tile."""
    if shape[0] != OTHER:
        return (left - 1 + NEAR) * STRIP + top - 1 + NEAR
    width, height = table.size[shape[1] >> PHASE_BITS], table.size[shape[2] >> PHASE_BITS]
    return int((top + halo - (height // 2 - 1)) * (TILE + 2 * halo) + left + halo - (width // 2 - 1))


@compiled()
def _inside(table: Profiles, small: SmallProfiles, left: int, top: int, shape: Shape, rows: int, columns: int) -> float:
    """The sum of a window's weights on the frame; 0 where they are hardly any."""
    if shape[0] == OTHER:
        inside = _inside_other(table, left, top, shape, rows, columns)
        return inside if inside >= LEAST_INSIDE else 0.0
    within = 1 <= left < columns - 2 and 1 <= top < rows - 2
    if shape[0] == UPRIGHT and within:
        return 1.0
    whole = inside = 0.0
    skews, a, b = LANES * LANES * (SKEW_STEPS + shape[3]), LANES * shape[1], LANES * shape[2]
    for j in range(LANES):
        for i in range(LANES):
            share = small.table[a + i] * small.table[b + j]
            if shape[0] == SKEWED:
                share *= small.skews[skews + LANES * j + i]
            whole += share
            if within or (0 <= top - 1 + j < rows and 0 <= left - 1 + i < columns):
                inside += share
    return inside if inside >= LEAST_INSIDE * whole else 0.0


@compiled()
def _inside_other(table: Profiles, left: int, top: int, shape: Shape, rows: int, columns: int) -> float:
    wide, high = shape[1] >> PHASE_BITS, shape[2] >> PHASE_BITS
    fx, fy, shear = shape[1] & (PHASES - 1), shape[2] & (PHASES - 1), shape[3]
    width, height = table.size[wide], table.size[high]
    reach = width // 2 + abs(shear) * height // (2 * SHEARS) + 1
    if top - height // 2 >= 0 and top + height // 2 < rows and left - reach >= 0 and left + reach < columns:
        return 1.0
    total = 0.0
    for j in range(height):
        row = top - (height // 2 - 1) + j
        if row < 0 or row >= rows:
            continue
        x = fx + ((shear * ((j - (height // 2 - 1)) * PHASES - fy)) >> SHEAR_BITS)
        shift, f = x >> PHASE_BITS, x & (PHASES - 1)
        part = 0.0
        for i in range(width):
            column = left - (width // 2 - 1) + i + shift
            if 0 <= column < columns:
                part += table.table[table.first[wide] + f * width + i]
        total += part * table.table[table.first[high] + fy * height + j]
    return total
