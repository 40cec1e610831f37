"""Each camera site's window of projector pixels, and the order in which the products walk them.

A site of the camera (one colour of one pixel) sees the projector's image plane at a place phi, blurred by a Gaussian of
covariance S. Its light is shared out over the projector pixels around phi. A window is kept as parameters, 15 bytes
whatever its size; the shares come from a table (``profiles``). A skewed S shifts each row of the window along x.

Windows are sorted by projector, colour and tile of the projector's image. Each such cell has a small buffer that stays
in the processor's nearest cache. Nothing is assumed about where neighbouring sites look: folds and occlusions are but
windows in other cells.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from controller.arrays import FloatImage, Mask
from controller.calibrate.values import PhaseMap
from controller.compiled import compiled
from controller.transport.profiles import KINDS, PHASE_BITS, PHASES, SMALLEST_PX, STEP, Profiles, build_profiles

TILE: Final = 64
SHEAR_BITS: Final = 6
SHEARS: Final = 1 << SHEAR_BITS
"""Steps of a window's shift, a projector row, in a pixel."""
MOST_SHEAR: Final = 1.2
"""With the widest profile, windows reach less than half a tile beyond their tile: those of a turn stay apart."""
LEAST_INSIDE: Final = 0.05
"""A site whose window lies outside the frame but for this share is not lit by it."""
LEAST_SHEAR: Final = 3
"""Steps up to this are taken as none, because windows without are faster."""
BEYOND: Final = 2
TURNS: Final = 4
"""Tiles of even and odd rows and columns: those of one turn never write to the same pixel."""


class Windows(NamedTuple):
    """The windows of all projectors, by cell.

    ``site`` (windows,) int32: camera site; ``at`` uint16: first pixel in the cell's buffer; ``across``, ``down``
    uint16: the table's row for x and y, kind times PHASES plus position between two pixels; ``shear``
    int8: how far each row is moved along x; ``gain`` float32: white light at the site over the sum of its shares
    ``first`` (cells + 1,) int64: each cell's windows; ``place`` (cells, 4) int64: projector, colour, top, left
    ``turn`` (tiles,) int64: the tiles by turn, each by its cell of the first colour; ``turn_first`` (TURNS + 1,) int64
    ``start`` (projectors + 1,) int64: first pixel of each projector; ``size`` (projectors, 2) int64: rows, columns
    ``cell_first`` (projectors + 1,) int64: each projector's cells; ``halo`` (1,) int64: of the buffers
    """

    site: npt.NDArray[np.int32]
    at: npt.NDArray[np.uint16]
    across: npt.NDArray[np.uint16]
    down: npt.NDArray[np.uint16]
    shear: npt.NDArray[np.int8]
    gain: FloatImage
    first: npt.NDArray[np.int64]
    place: npt.NDArray[np.int64]
    turn: npt.NDArray[np.int64]
    turn_first: npt.NDArray[np.int64]
    start: npt.NDArray[np.int64]
    size: npt.NDArray[np.int64]
    cell_first: npt.NDArray[np.int64]
    halo: npt.NDArray[np.int64]


def build_windows(
    maps: tuple[PhaseMap, ...], white: tuple[FloatImage, ...], colours: npt.NDArray[np.int64], use: tuple[Mask, ...]
) -> Windows:
    """Windows of the camera pixels ``use`` (rows, columns) of each projector that look at its frame.

    ``white`` (rows, columns, 3) of each; ``colours`` (2, 2) of the sites, or (0, 0): each pixel has three sites.
    """
    table = build_profiles()
    sizes = np.array([m.spread_px2.shape[:2] for m in maps], np.int64).reshape(-1, 2)
    halo = np.array([max((_halo(m.spread_px2, table) for m in maps), default=2)], np.int64)
    parts, places = [], []
    for n, phase_map in enumerate(maps):
        tiles = (-(-sizes[n] // TILE)).astype(np.int64)
        cells = 3 * int(tiles[0] * tiles[1])
        count = np.zeros(cells + 1, np.int64)
        arguments = (phase_map.projector_px, phase_map.spread_px2, white[n], colours, use[n], table, int(halo[0]))
        _walk(*arguments, count, True, *_empty(0))
        np.cumsum(count, out=count)
        filled = _empty(int(count[-1]))
        _walk(*arguments, count[:-1].copy(), False, *filled)
        parts.append((count, filled))
        cell = np.arange(cells)
        colour, tile = cell // (tiles[0] * tiles[1]), cell % (tiles[0] * tiles[1])
        at = np.stack([np.full(cells, n), colour, tile // tiles[1] * TILE, tile % tiles[1] * TILE], axis=1)
        places.append(at.astype(np.int64))
    return _joined(parts, places, sizes, halo)


_Filled = tuple[
    npt.NDArray[np.int32],
    npt.NDArray[np.uint16],
    npt.NDArray[np.uint16],
    npt.NDArray[np.uint16],
    npt.NDArray[np.int8],
    FloatImage,
]


def _empty(count: int) -> _Filled:
    return (
        np.empty(count, np.int32),
        np.empty(count, np.uint16),
        np.empty(count, np.uint16),
        np.empty(count, np.uint16),
        np.empty(count, np.int8),
        np.empty(count, np.float32),
    )


def _joined(
    parts: list[tuple[npt.NDArray[np.int64], _Filled]],
    places: list[npt.NDArray[np.int64]],
    sizes: npt.NDArray[np.int64],
    halo: npt.NDArray[np.int64],
) -> Windows:
    before = np.cumsum([0, *(count[-1] for count, _ in parts)])
    first = np.concatenate([count[:-1] + b for (count, _), b in zip(parts, before, strict=False)] + [before[-1:]])
    place = np.concatenate(places)
    cell_first = np.cumsum([0, *(p.shape[0] for p in places)]).astype(np.int64)
    tile = np.flatnonzero(place[:, 1] == 0)
    group = 2 * (place[tile, 2] // TILE % 2) + place[tile, 3] // TILE % 2
    order = np.argsort(group, kind="stable")
    turn, turn_first = tile[order], np.searchsorted(group[order], np.arange(TURNS + 1)).astype(np.int64)
    for t in range(TURNS):
        # threads take the first and the second half: both get cells of all parts of the image
        mine = turn[turn_first[t] : turn_first[t + 1]].copy()
        turn[turn_first[t] : turn_first[t + 1]] = np.concatenate([mine[::2], mine[1::2]])
    start = np.cumsum([0, *(int(rows * columns) for rows, columns in sizes)]).astype(np.int64)
    whole = [np.concatenate([filled[i] for _, filled in parts]) for i in range(6)]
    site, at, across, down, shear, gain = whole
    return Windows(
        site,
        at,
        across,
        down,
        shear,
        gain,
        first.astype(np.int64),
        place,
        turn,
        turn_first,
        start,
        sizes,
        cell_first,
        halo,
    )


def _halo(spread_px2: FloatImage, table: Profiles) -> int:
    """How far windows reach beyond their tile, pixels."""
    xx, xy, yy = (part[np.isfinite(part)].astype(np.float64) for part in np.moveaxis(spread_px2, -1, 0))
    if not yy.size:
        return BEYOND + 1
    k = np.clip(xy / np.maximum(yy, 1e-6), -MOST_SHEAR, MOST_SHEAR)
    widest = kind_of(float((xx - 2 * k * xy + k * k * yy).max()))
    highest = kind_of(float(yy.max()))
    rows = int(table.size[highest]) // 2
    return BEYOND + 2 + max(rows, int(table.size[widest]) // 2 + int(np.ceil(np.abs(k).max() * rows)))


@compiled()
def kind_of(variance: float) -> int:
    """The profile nearest to a variance, projector pixels squared."""
    kind = int(np.floor(0.5 * np.log(max(variance, 1e-6) / SMALLEST_PX**2) / np.log(STEP) + 0.5))
    return min(max(kind, 0), KINDS - 1)


@compiled()
def _walk(
    position: FloatImage,
    spread: FloatImage,
    white: FloatImage,
    colours: npt.NDArray[np.int64],
    use: Mask,
    table: Profiles,
    halo: int,
    fill: npt.NDArray[np.int64],
    counting: bool,
    site: npt.NDArray[np.int32],
    at: npt.NDArray[np.uint16],
    across: npt.NDArray[np.uint16],
    down: npt.NDArray[np.uint16],
    shear: npt.NDArray[np.int8],
    gain: FloatImage,
) -> None:
    """Count the windows of each cell (to ``fill[cell + 1]``), or write them from ``fill[cell]`` on."""
    rows, columns = spread.shape[:2]
    tiles_across = (columns + TILE - 1) // TILE
    tiles = (rows + TILE - 1) // TILE * tiles_across
    side = TILE + 2 * halo
    pixels = use.size
    for r in range(use.shape[0]):
        for c in range(use.shape[1]):
            x, y = position[r, c, 0], position[r, c, 1]
            # NaN fails every comparison
            if not (use[r, c] and -BEYOND <= x < columns + BEYOND - 1 and -BEYOND <= y < rows + BEYOND - 1):
                continue
            left, top = int(np.floor(x)), int(np.floor(y))
            near = spread[
                min(max(int(np.floor(y + 0.5)), 0), rows - 1), min(max(int(np.floor(x + 0.5)), 0), columns - 1)
            ]
            xx, xy, yy = np.float64(near[0]), np.float64(near[1]), np.float64(near[2])
            if not (xx > 0 and yy > 0 and xx * yy > xy * xy):
                continue
            steps = int(np.floor(min(max(xy / yy, -MOST_SHEAR), MOST_SHEAR) * SHEARS + 0.5))
            steps = 0 if abs(steps) <= LEAST_SHEAR else steps
            k = steps / SHEARS
            wide, high = kind_of(xx - 2 * k * xy + k * k * yy), kind_of(yy)
            fx, fy = min(int((x - left) * PHASES), PHASES - 1), min(int((y - top) * PHASES), PHASES - 1)
            inside = _inside(table, left, top, fx, fy, wide, high, steps, rows, columns)
            if inside < LEAST_INSIDE:
                continue
            tile_row, tile_column = (
                min(max(top // TILE, 0), (rows - 1) // TILE),
                min(max(left // TILE, 0), tiles_across - 1),
            )
            tile = tile_row * tiles_across + tile_column
            for colour in range(3):
                one = colours.size > 0
                if (one and colours[r & 1, c & 1] != colour) or not white[r, c, colour] > 0:
                    continue
                cell = colour * tiles + tile
                if counting:
                    fill[cell + 1] += 1
                    continue
                e = fill[cell]
                fill[cell] = e + 1
                site[e] = r * use.shape[1] + c + (0 if one else colour * pixels)
                from_row = top - tile_row * TILE + halo - (table.size[high] // 2 - 1)
                from_column = left - tile_column * TILE + halo - (table.size[wide] // 2 - 1)
                at[e] = from_row * side + from_column
                across[e], down[e] = wide * PHASES + fx, high * PHASES + fy
                shear[e] = steps
                gain[e] = white[r, c, colour] / inside


@compiled()
def _inside(
    table: Profiles, left: int, top: int, fx: int, fy: int, wide: int, high: int, shear: int, rows: int, columns: int
) -> float:
    """The sum of those shares that fall on the frame; 1 but at its border."""
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
