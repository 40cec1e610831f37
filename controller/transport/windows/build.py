"""The windows of a stage, from its phase maps and white images."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from controller.calibrate.values import PhaseMap
from controller.core.arrays import FloatImage, Mask
from controller.transport.windows.order import place_cells, settle, take_turns
from controller.transport.windows.profiles import GROUP, Profiles, build_profiles, build_small_profiles
from controller.transport.windows.sample_kernels import BEYOND, MOST_SHEAR, NEAR, OTHER, SORTS, Windows, kind_of
from controller.transport.windows.walk import walk

_Filled = tuple[
    npt.NDArray[np.int32],
    npt.NDArray[np.uint16],
    npt.NDArray[np.uint16],
    npt.NDArray[np.uint16],
    npt.NDArray[np.int8],
    FloatImage,
]
"""``site``, ``at``, ``across``, ``down``, ``skew`` and ``gain`` of some windows."""


def build_windows(
    maps: tuple[PhaseMap, ...], white: tuple[FloatImage, ...], colours: npt.NDArray[np.int64], use: tuple[Mask, ...]
) -> Windows:
    """Windows of the camera pixels ``use`` (rows, columns) of each projector that look at its frame.

    ``white`` (rows, columns, 3) of each; ``colours`` (2, 2) of the sites, or (0, 0): each pixel has three sites.
    """
    tables = build_profiles(), build_small_profiles()
    sizes = np.array([m.spread_px2.shape[:2] for m in maps], np.int64).reshape(-1, 2)
    halo = max((_halo(m.spread_px2, tables[0]) for m in maps), default=NEAR)
    place, cell_first = place_cells(sizes)
    walks = [
        (phase_map.projector_px, phase_map.spread_px2, white[n], colours, use[n], *tables, halo)
        for n, phase_map in enumerate(maps)
    ]
    # all are counted first, so that there is one array of each kind from the beginning
    counts, rooms = [], []
    for n, arguments in enumerate(walks):
        count = np.zeros(SORTS * int(cell_first[n + 1] - cell_first[n]), np.int64)
        walk(*arguments, count, True, *_empty(0))
        small = np.arange(count.size) % SORTS != OTHER
        counts.append(count)
        rooms.append(np.where(small, -(-count // GROUP) * GROUP, count))
    room = np.concatenate(rooms)
    first = np.concatenate([[0], np.cumsum(room)])
    filled = _empty(int(first[-1]))
    for n, arguments in enumerate(walks):
        cells = slice(SORTS * int(cell_first[n]), SORTS * int(cell_first[n + 1]) + 1)
        own = first[cells] - first[cells.start]
        part = slice(int(first[cells.start]), int(first[cells.stop - 1]))
        mine = _part(filled, part)
        walk(*arguments, own[:-1].copy(), False, *mine)
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


def _empty(count: int) -> _Filled:
    return (
        np.empty(count, np.int32),
        np.empty(count, np.uint16),
        np.empty(count, np.uint16),
        np.empty(count, np.uint16),
        np.empty(count, np.int8),
        np.empty(count, np.float32),
    )


def _part(filled: _Filled, part: slice) -> _Filled:
    site, at, across, down, skew, gain = filled
    return site[part], at[part], across[part], down[part], skew[part], gain[part]


def _halo(spread_px2: FloatImage, table: Profiles) -> int:
    """How far windows reach beyond their tile, pixels."""
    xx, xy, yy = (part[np.isfinite(part)].astype(np.float64) for part in np.moveaxis(spread_px2, -1, 0))
    if not yy.size:
        return NEAR
    k = np.clip(xy / np.maximum(yy, 1e-6), -MOST_SHEAR, MOST_SHEAR)
    widest = kind_of(float((xx - 2 * k * xy + k * k * yy).max()))
    highest = kind_of(float(yy.max()))
    rows = int(table.size[highest]) // 2
    reach = BEYOND + 2 + max(rows, int(table.size[widest]) // 2 + int(np.ceil(np.abs(k).max() * rows)))
    return max(reach, NEAR)
