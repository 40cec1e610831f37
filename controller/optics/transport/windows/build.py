"""The windows of a stage, from its phase maps and white images, and the order in which products take them.

Each projector's camera picture is walked over twice: windows are counted, and then written. The order of
windows, and of tiles of them, is for speed alone, but the same in every product.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import prange

from controller.core import channels
from controller.core.arrays import Float64, FloatImage, Mask
from controller.core.jit import compiled
from controller.optics.calibrate.values import PhaseMap
from controller.optics.transport.windows.profiles import (
    BEYOND,
    GROUP,
    LANES,
    LEAST_INSIDE,
    LEAST_SHEAR,
    MOST_SHEAR,
    NEAR,
    OTHER,
    PHASE_BITS,
    PHASES,
    SHEAR_BITS,
    SHEARS,
    SKEW_STEPS,
    SKEWED,
    SKEWS,
    SMALL_PHASES,
    SMALLEST_PX,
    SORTS,
    STEP,
    STRIP,
    TILE,
    UPRIGHT,
    Profiles,
    SmallProfiles,
    Windows,
    build_profiles,
    build_small_profiles,
    kind_of,
)

BANDS: Final = 16
"""Of rows of the camera's picture, which are walked over at the same time."""
UPRIGHT_BELOW: Final = (LEAST_SHEAR + 0.5) / SHEARS
Shape = tuple[int, int, int, int]
"""Sort, table rows across and down, and skew."""


class Sight(NamedTuple):
    """What says where the camera looks into one projector's frame; all but ``colours`` and ``apart`` by camera pixel.

    ``position`` (rows, columns, 2), ``spread`` (rows, columns of the projector, 3): of its ``PhaseMap``
    ``apart`` (3, 5): what is added to place and spread of each of the camera's colours
    ``white`` (rows, columns, 3), ``use`` (rows, columns), ``colours``: as of ``build_windows``
    """

    position: FloatImage
    spread: FloatImage
    apart: Float64
    white: FloatImage
    colours: npt.NDArray[np.int64]
    use: Mask


class WindowArrays(NamedTuple):
    """Arrays of some windows, (windows,) each; as of ``Windows``."""

    site: npt.NDArray[np.int32]
    at: npt.NDArray[np.uint16]
    across: npt.NDArray[np.uint16]
    down: npt.NDArray[np.uint16]
    skew: npt.NDArray[np.int8]
    gain: FloatImage


@compiled(parallel=True)
def count_windows(sight: Sight, table: Profiles, small: SmallProfiles, counts: npt.NDArray[np.int64]) -> None:
    """Add the windows of each band of camera rows, cell and sort to ``counts`` (bands, cells)."""
    height, width = sight.use.shape
    for band in prange(BANDS):
        for r in range(band * height // BANDS, (band + 1) * height // BANDS):
            for c in range(width):
                for colour in range(3):
                    left, top, shape, inside = _window(sight, table, small, r, c, colour)
                    if inside > 0:
                        counts[band, _place(sight, left, top, colour)[0] + shape[0]] += 1


@compiled(parallel=True)
def write_windows(
    sight: Sight, table: Profiles, small: SmallProfiles, halo: int, ahead: npt.NDArray[np.int64], windows: WindowArrays
) -> None:
    """Write the windows that ``count_windows`` counts.

    ``ahead`` (bands, cells): where the next window of a band, cell and sort goes; it moves on with each
    """
    height, width = sight.use.shape
    # names of their own: where it writes to arrays of a tuple, numba's parallel loop frees their memory twice
    site, at, across, down, skew, gain = windows
    apart = 0 if sight.colours.size > 0 else sight.use.size  # sites of one colour from those of the next
    for band in prange(BANDS):
        for r in range(band * height // BANDS, (band + 1) * height // BANDS):
            for c in range(width):
                for colour in range(3):
                    left, top, shape, inside = _window(sight, table, small, r, c, colour)
                    if inside > 0:
                        cell, tile_top, tile_left = _place(sight, left, top, colour)
                        e = ahead[band, cell + shape[0]]
                        ahead[band, cell + shape[0]] = e + 1
                        site[e] = r * width + c + colour * apart
                        at[e] = _buffer_place(table, shape, top - tile_top, left - tile_left, halo)
                        across[e], down[e], skew[e] = shape[1], shape[2], shape[3]
                        gain[e] = sight.white[r, c, colour] / inside


@compiled()
def _window(
    sight: Sight, table: Profiles, small: SmallProfiles, r: int, c: int, colour: int
) -> tuple[int, int, Shape, float]:
    """Of one colour at a camera pixel: column and row of the projector pixel, shape, and the sum of its shares.

    The sum is 0 where there is no window.
    """
    none = (0, 0, (0, 0, 0, 0), 0.0)
    if not sight.use[r, c] or not sight.white[r, c, colour] > 0:
        return none
    if sight.colours.size > 0 and sight.colours[r & 1, c & 1] != colour:
        return none
    rows, columns = sight.spread.shape[:2]
    apart = sight.apart
    x, y = sight.position[r, c, 0] + apart[colour, 0], sight.position[r, c, 1] + apart[colour, 1]
    # NaN fails every comparison
    if not (-BEYOND <= x < columns + BEYOND - 1 and -BEYOND <= y < rows + BEYOND - 1):
        return none
    row = min(max(int(np.floor(y + 0.5)), 0), rows - 1)
    column = min(max(int(np.floor(x + 0.5)), 0), columns - 1)
    xx = sight.spread[row, column, 0] + apart[colour, 2]
    xy = sight.spread[row, column, 1] + apart[colour, 3]
    yy = sight.spread[row, column, 2] + apart[colour, 4]
    if not (xx > 0 and yy > 0 and xx * yy > xy * xy):
        return none
    left, top = int(np.floor(x)), int(np.floor(y))
    shape = _shape(xx, xy, yy, x - left, y - top, table.small[0])
    return left, top, shape, _inside(table, small, left, top, shape, rows, columns)


@compiled()
def _place(sight: Sight, left: int, top: int, colour: int) -> tuple[int, int, int]:
    """The first sort of the cell that a window belongs to, and row and column where its tile begins."""
    rows, columns = sight.spread.shape[:2]
    tiles_across = (columns + TILE - 1) // TILE
    tiles = (rows + TILE - 1) // TILE * tiles_across
    tile_row = min(max(top // TILE, 0), (rows - 1) // TILE)
    tile_column = min(max(left // TILE, 0), tiles_across - 1)
    return SORTS * (colour * tiles + tile_row * tiles_across + tile_column), tile_row * TILE, tile_column * TILE


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


TURNS: Final = 4
"""Tiles of even and odd rows and columns: those of one turn never write to the same pixel."""
BAND: Final = 4
"""Rows of tiles in a band, at least. All projectors take their turns in a band before the next: most of what they see
there is the same part of the camera's picture, which stays in the processor's last cache meanwhile."""

Numbers = npt.NDArray[np.int64]


def place_cells(sizes: Numbers) -> tuple[Numbers, Numbers]:
    """(cells, 4): projector, colour, top and left of each cell; (projectors + 1,): each projector's first."""
    places = []
    for n, (rows, columns) in enumerate(sizes):
        colour, top, left = np.mgrid[0:3, 0:rows:TILE, 0:columns:TILE].reshape(3, -1)
        places.append(np.stack([np.full(colour.size, n), colour, top, left], axis=1))
    first = np.cumsum([0, *(part.shape[0] for part in places)])
    return np.concatenate(places).astype(np.int64), first.astype(np.int64)


def take_turns(place: Numbers, sizes: Numbers, windows: Numbers, cell_first: Numbers) -> tuple[Numbers, Numbers]:
    """The tiles by projector, band and turn, and where each of these begins.

    ``windows`` (cells,): how many there are; tiles with many and few are dealt out evenly over any parts of a turn.
    """
    rows_of_tiles = -(-sizes[:, 0] // TILE)
    bands = max(int(rows_of_tiles.max(initial=1)) // BAND, 1)
    turns, count = [], []
    for n, height in enumerate(rows_of_tiles):
        cells = np.arange(cell_first[n], cell_first[n + 1])
        tiles = cells[: cells.size // 3]
        many = windows[cells].reshape(3, -1).sum(axis=0)
        row, column = place[tiles, 2] // TILE, place[tiles, 3] // TILE
        turn = (row * bands // height) * TURNS + 2 * (row % 2) + column % 2
        for t in range(bands * TURNS):
            mine = np.flatnonzero(turn == t)
            dealt = mine[np.argsort(-many[mine], kind="stable")][_reversed_bits(mine.size)]
            turns.append(tiles[dealt])
            count.append(mine.size)
    return np.concatenate(turns), np.cumsum([0, *count]).astype(np.int64)


def _reversed_bits(count: int) -> Numbers:
    """Numbers below ``count`` by their binary digits read backwards: each half, quarter, ... has some of any size."""
    numbers = np.arange(count)
    digits = max(count - 1, 1).bit_length()
    backwards = sum(((numbers >> k) & 1) << (digits - 1 - k) for k in range(digits))
    return np.asarray(np.argsort(backwards, kind="stable"), np.int64)


@compiled(parallel=True)
def settle(
    first: Numbers,
    count: Numbers,
    site: npt.NDArray[np.int32],
    at: npt.NDArray[np.uint16],
    across: npt.NDArray[np.uint16],
    down: npt.NDArray[np.uint16],
    skew: npt.NDArray[np.int8],
    gain: FloatImage,
) -> None:
    """Put the small windows of each cell in the order of ``_rounds``, and fill groups up with copies without gain."""
    for i in prange(count.size):
        if i % SORTS == OTHER or count[i] == 0:
            continue
        a, b = first[i], first[i] + count[i]
        order = a + _rounds(at[a:b])
        site[a:b], at[a:b], across[a:b] = site[order], at[order], across[order]
        down[a:b], skew[a:b], gain[a:b] = down[order], skew[order], gain[order]
        for e in range(b, first[i + 1]):
            site[e], at[e], across[e] = site[b - 1], at[b - 1], across[b - 1]
            down[e], skew[e], gain[e] = down[b - 1], skew[b - 1], 0


@compiled()
def _rounds(at: npt.NDArray[np.uint16]) -> Numbers:
    """Row by row of the projector; within a row one window of each pixel, then the second of each, and so on.

    So windows that overlap without beginning at the same pixel are far apart, and none waits for another's sums.
    """
    ahead = np.full(STRIP * STRIP, -1, np.int64)
    after = np.empty(at.size, np.int64)
    for e in range(at.size - 1, -1, -1):
        key = at[e] % STRIP * STRIP + at[e] // STRIP
        after[e] = ahead[key]
        ahead[key] = e
    order = np.empty(at.size, np.int64)
    n = 0
    for row in range(STRIP):
        some = True
        while some:
            some = False
            for key in range(row * STRIP, (row + 1) * STRIP):
                e = ahead[key]
                if e >= 0:
                    order[n] = e
                    ahead[key] = after[e]
                    n += 1
                    some = True
    return order


def build_windows(
    maps: tuple[PhaseMap, ...],
    white: tuple[FloatImage, ...],
    colours: npt.NDArray[np.int64],
    use: tuple[Mask, ...],
    mixing: FloatImage,
) -> Windows:
    """Windows of the camera pixels ``use`` (rows, columns) of each projector that look at its frame.

    ``white`` (rows, columns, 3) of each; ``colours`` (2, 2) of the sites, or (0, 0): each pixel has three sites;
    ``mixing`` (projectors, 3, 3).
    """
    tables = build_profiles(), build_small_profiles()
    sizes = np.array([m.spread_px2.shape[:2] for m in maps], np.int64).reshape(-1, 2)
    apart = [_apart(m, mixing[n]) for n, m in enumerate(maps)]
    halo = max((_halo(m.spread_px2, apart[n], tables[0]) for n, m in enumerate(maps)), default=NEAR)
    place, cell_first = place_cells(sizes)
    sights = [
        Sight(phase_map.projector_px, phase_map.spread_px2, apart[n], white[n], colours, use[n])
        for n, phase_map in enumerate(maps)
    ]
    # all are counted first, so that there is one array of each kind from the beginning
    bands, counts, rooms = [], [], []
    for n, sight in enumerate(sights):
        bands.append(np.zeros((BANDS, SORTS * int(cell_first[n + 1] - cell_first[n])), np.int64))
        count_windows(sight, *tables, bands[n])
        count = bands[n].sum(axis=0)
        small = np.arange(count.size) % SORTS != OTHER
        counts.append(count)
        rooms.append(np.where(small, -(-count // GROUP) * GROUP, count))
    room = np.concatenate(rooms)
    first = np.concatenate([[0], np.cumsum(room)])
    filled = _empty(int(first[-1]))
    for n, sight in enumerate(sights):
        cells = slice(SORTS * int(cell_first[n]), SORTS * int(cell_first[n + 1]) + 1)
        own = first[cells] - first[cells.start]
        part = slice(int(first[cells.start]), int(first[cells.stop - 1]))
        site, at, across, down, skew, gain = filled
        mine = WindowArrays(site[part], at[part], across[part], down[part], skew[part], gain[part])
        begins = own[:-1] + np.cumsum(bands[n], axis=0) - bands[n]
        write_windows(sight, *tables, halo, begins, mine)
        settle(own, counts[n], *mine)
    turn, turn_first = take_turns(place, sizes, room.reshape(-1, SORTS).sum(axis=1), cell_first)
    start = np.cumsum([0, *(int(rows * columns) for rows, columns in sizes)]).astype(np.int64)
    return Windows(
        *filled,
        first,
        place,
        turn,
        turn_first,
        start,
        sizes,
        cell_first,
        # small windows reach no farther
        np.array([halo if room[OTHER::SORTS].any() else NEAR], np.int64),
    )


def _empty(count: int) -> WindowArrays:
    return WindowArrays(
        np.empty(count, np.int32),
        np.empty(count, np.uint16),
        np.empty(count, np.uint16),
        np.empty(count, np.uint16),
        np.empty(count, np.int8),
        np.empty(count, np.float32),
    )


def _apart(phase_map: PhaseMap, mixing: FloatImage) -> Float64:
    """(3, 5): x and y of where a channel of the camera looks, less the map's place; xx, xy, yy more of its spread.

    A channel sees a mixture of the projector's colours. Where they lie apart, it looks at the mean of their places, and
    their distance from it is spread (docs/decisions/0006).
    """
    if phase_map.colours_px is None:
        return np.zeros((3, 5))
    mixed = mixing.astype(np.float64)
    x, y = np.asarray(phase_map.colours_px, np.float64).T
    mean_x, mean_y = mixed @ x, mixed @ y
    more = mixed @ (x * x) - mean_x**2, mixed @ (x * y) - mean_x * mean_y, mixed @ (y * y) - mean_y**2
    return np.stack([-mean_x, -mean_y, *more], axis=1)


def _halo(spread_px2: FloatImage, apart: Float64, table: Profiles) -> int:
    """How far windows reach beyond their tile, pixels."""
    known = spread_px2[channels.finite(spread_px2)].astype(np.float64)
    if not known.size:
        return NEAR
    return max(_reach(known + more, table) for more in np.unique(apart[:, 2:], axis=0))


def _reach(spread_px2: Float64, table: Profiles) -> int:
    xx, xy, yy = spread_px2.T
    k = np.clip(xy / np.maximum(yy, 1e-6), -MOST_SHEAR, MOST_SHEAR)
    widest = kind_of(float((xx - 2 * k * xy + k * k * yy).max()))
    highest = kind_of(float(yy.max()))
    rows = int(table.size[highest]) // 2
    reach = BEYOND + 2 + max(rows, int(table.size[widest]) // 2 + int(np.ceil(np.abs(k).max() * rows)))
    return max(reach, NEAR)
