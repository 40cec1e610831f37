"""Windows of the light transport in the order in which a graphics processor reads them, in bands of projector rows.

A record is four uint32: camera site; gain; table rows for x (low half) and y; first column + ``MARGIN`` (16 bits),
skew + 128 (8 bits) and colour. Records are sorted by the projector pixel at which their window begins, its *place*. So
a projector pixel finds every window that covers it in a few runs of records, and no two threads write one number.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from controller.core.arrays import FloatImage
from controller.core.jit import compiled
from controller.optics.transport.windows.products import even_gains
from controller.optics.transport.windows.profiles import (
    LANES,
    NEAR,
    OTHER,
    PHASE_BITS,
    PHASES,
    SHEAR_BITS,
    SORTS,
    STRIP,
    TILE,
    Profiles,
    SmallProfiles,
    Windows,
)

MARGIN: Final = 32
"""Windows begin at most so many pixels outside the frame."""
RECORD_BYTES: Final = 16
BLOCK: Final = 8
"""How far windows reach is known for blocks of so many pixels, each way."""

Counts = npt.NDArray[np.uint32]


@dataclass(frozen=True, slots=True, eq=False)
class Band:
    """The windows that light some rows of a projector.

    ``rows``: (first, end) of the projector; ``records`` (windows, 4) uint32; ``even`` (windows,) float32: the gain that
    makes a window's shares sum to 1
    ``first`` (rows of places x columns of places + 1,) uint32: where the records of each place begin
    ``place_row``: the projector row of the first row of places
    ``own``: (first, end) of the rows of places whose windows no other band counts as its own
    """

    rows: tuple[int, int]
    records: Counts
    even: FloatImage
    first: Counts
    place_row: int
    own: tuple[int, int]


class _Places(NamedTuple):
    """Of the windows ``e`` of one projector and sort: their row and column, and their colour."""

    e: npt.NDArray[np.int64]
    row: npt.NDArray[np.int32]
    column: npt.NDArray[np.int32]
    colour: npt.NDArray[np.uint8]


def place_columns(columns: int) -> int:
    """Columns of places of a projector."""
    return columns + MARGIN


def bands_of(windows: Windows, n: int, *, small: bool, tables: tuple[Profiles, SmallProfiles], most: int) -> list[Band]:
    """The windows of projector ``n`` in bands of at most ``most`` bytes of records each, or of one row.

    ``small``: those of LANES by LANES shares, or the others.
    """
    rows, columns = (int(side) for side in windows.size[n])
    places = _places(windows, n, small)
    highest = LANES if small else _highest(windows, tables[0], places.e)
    even = even_gains(windows, tables[1], (n, n + 1))
    per_row = np.bincount(places.row + MARGIN, minlength=rows + MARGIN)
    found = []
    for begin, end in _cut(per_row, rows, highest, most // RECORD_BYTES):
        from_row = max(begin - highest + 1, -MARGIN)
        mine = _part(places, from_row if begin else -MARGIN, end)
        place_row = from_row if begin else -MARGIN
        first, order = _sorted(mine.row - place_row, mine.column + MARGIN, end - place_row, place_columns(columns))
        records = np.empty((len(order), 4), np.uint32)
        _fill(windows, mine, order, records)
        own = (begin if begin else -MARGIN) - place_row, end - place_row
        found.append(Band((begin, end), records, even[mine.e[order]], first, place_row, own))
    return found


def reach_of(windows: Windows, n: int, table: Profiles) -> Counts:
    """(rows of blocks x columns of blocks,): how far windows that are not small may begin from a block's pixels.

    Rows above (low 8 bits), columns to the left (next 8 bits) and to the right (next 8); 0 where there are none.
    """
    rows, columns = (int(side) for side in windows.size[n])
    places = _places(windows, n, small=False)
    out = np.zeros((-(-rows // BLOCK), -(-columns // BLOCK)), np.uint32)
    _reach(windows, table, places, rows, columns, out)
    return out.ravel()


def _cut(per_row: npt.NDArray[np.int64], rows: int, highest: int, most: int) -> list[tuple[int, int]]:
    """Rows of the projector, (first, end) of each band, whose records are at most ``most`` where that is possible."""
    total = np.concatenate([[0], np.cumsum(per_row)])
    cuts, begin = [], 0
    while begin < rows:
        least = total[max(begin - highest + 1 + MARGIN, 0) if begin else 0]
        end = int(np.searchsorted(total, least + most, side="right")) - 1 - MARGIN
        end = min(max(end, begin + 1), rows)
        cuts.append((begin, end))
        begin = end
    return cuts


def _part(places: _Places, first: int, end: int) -> _Places:
    mine = np.flatnonzero((places.row >= first) & (places.row < end))
    return _Places(places.e[mine], places.row[mine], places.column[mine], places.colour[mine])


def _places(windows: Windows, n: int, small: bool) -> _Places:
    cells = slice(int(windows.cell_first[n]), int(windows.cell_first[n + 1]))
    count = np.zeros(cells.stop - cells.start, np.int64)
    _count(windows, cells.start, small, count)
    begin = np.concatenate([[0], np.cumsum(count)])
    size = int(begin[-1])
    row, column = np.empty(size, np.int32), np.empty(size, np.int32)
    found = _Places(np.empty(size, np.int64), row, column, np.empty(size, np.uint8))
    _locate(windows, cells.start, small, begin, found)
    return found


def _highest(windows: Windows, table: Profiles, e: npt.NDArray[np.int64]) -> int:
    return int(table.size[windows.down[e] >> PHASE_BITS].max(initial=1))


@compiled()
def _runs(windows: Windows, cell: int, small: bool) -> tuple[int, int]:
    first = windows.first
    if small:
        return first[SORTS * cell], first[SORTS * cell + OTHER]
    return first[SORTS * cell + OTHER], first[SORTS * (cell + 1)]


@compiled()
def _count(windows: Windows, first_cell: int, small: bool, count: npt.NDArray[np.int64]) -> None:
    for k in range(count.size):
        begin, end = _runs(windows, first_cell + k, small)
        for e in range(begin, end):
            # copies that fill a group up have no gain
            count[k] += windows.gain[e] > 0


@compiled()
def _locate(windows: Windows, first_cell: int, small: bool, at: npt.NDArray[np.int64], found: _Places) -> None:
    halo = windows.halo[0]
    side = TILE + 2 * halo
    for k in range(at.size - 1):
        i = at[k]
        _, colour, top, left = windows.place[first_cell + k]
        begin, end = _runs(windows, first_cell + k, small)
        for e in range(begin, end):
            if not windows.gain[e] > 0:
                continue
            place = np.int64(windows.at[e])
            if small:
                row, column = top + place % STRIP - NEAR, left + place // STRIP - NEAR
            else:
                row, column = top + place // side - halo, left + place % side - halo
            found.e[i], found.row[i], found.column[i], found.colour[i] = e, row, column, colour
            i += 1


@compiled()
def _sorted(
    row: npt.NDArray[np.int32], column: npt.NDArray[np.int32], rows: int, columns: int
) -> tuple[Counts, npt.NDArray[np.int64]]:
    """Where each place's windows begin, and the windows in that order, those of one place in the order they had."""
    first = np.zeros(rows * columns + 1, np.uint32)
    for i in range(row.size):
        first[np.int64(row[i]) * columns + column[i] + 1] += np.uint32(1)
    for k in range(rows * columns):
        first[k + 1] += first[k]
    fill = first[:-1].copy()
    order = np.empty(row.size, np.int64)
    for i in range(row.size):
        k = np.int64(row[i]) * columns + column[i]
        order[fill[k]] = i
        fill[k] += np.uint32(1)
    return first, order


@compiled()
def _fill(windows: Windows, places: _Places, order: npt.NDArray[np.int64], records: Counts) -> None:
    gains = windows.gain.view(np.uint32)
    for k in range(order.size):
        i = order[k]
        e = places.e[i]
        records[k, 0] = np.uint32(windows.site[e])
        records[k, 1] = gains[e]
        records[k, 2] = np.uint32(windows.across[e]) | np.uint32(windows.down[e]) << np.uint32(16)
        skew, column = np.uint32(np.int64(windows.skew[e]) + 128), np.uint32(places.column[i] + MARGIN)
        records[k, 3] = column | skew << np.uint32(16) | np.uint32(places.colour[i]) << np.uint32(24)


@compiled()
def _reach(windows: Windows, table: Profiles, places: _Places, rows: int, columns: int, out: Counts) -> None:
    for i in range(places.e.size):
        e = places.e[i]
        wide, high = windows.across[e] >> PHASE_BITS, windows.down[e] >> PHASE_BITS
        fx, fy = np.int64(windows.across[e] & (PHASES - 1)), np.int64(windows.down[e] & (PHASES - 1))
        width, height, shear = table.size[wide], table.size[high], np.int64(windows.skew[e])
        upper, lower = -(height // 2 - 1) * PHASES - fy, (height // 2) * PHASES - fy
        one = (fx + (shear * upper >> SHEAR_BITS)) >> PHASE_BITS
        other = (fx + (shear * lower >> SHEAR_BITS)) >> PHASE_BITS
        low, most = min(one, other), max(one, other) + width - 1
        top, left = max(places.row[i], 0), max(places.column[i] + low, 0)
        bottom, right = min(places.row[i] + height, rows), min(places.column[i] + most + 1, columns)
        for y in range(top // BLOCK, (bottom - 1) // BLOCK + 1 if bottom > top else 0):
            for x in range(left // BLOCK, (right - 1) // BLOCK + 1 if right > left else 0):
                was = np.int64(out[y, x])
                up = max(was & 255, height - 1)
                to_left, to_right = max(was >> 8 & 255, most), max(was >> 16 & 255, -low)
                out[y, x] = np.uint32(up | to_left << 8 | to_right << 16)
