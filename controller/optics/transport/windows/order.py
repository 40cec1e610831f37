"""The order in which windows, and tiles of them, are taken: for speed alone, but the same in every product."""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt
from numba import prange

from controller.core.arrays import FloatImage
from controller.core.jit import compiled
from controller.optics.transport.windows.sample_kernels import OTHER, SORTS, STRIP, TILE

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
