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
    counts, parts, other = [], [], False
    for n, phase_map in enumerate(maps):
        count = np.zeros(SORTS * int(cell_first[n + 1] - cell_first[n]), np.int64)
        arguments = (phase_map.projector_px, phase_map.spread_px2, white[n], colours, use[n], *tables, halo)
        walk(*arguments, count, True, *_empty(0))
        small = np.arange(count.size) % SORTS != OTHER
        room = np.where(small, -(-count // GROUP) * GROUP, count)
        first = np.concatenate([[0], np.cumsum(room)])
        filled = _empty(int(first[-1]))
        walk(*arguments, first[:-1].copy(), False, *filled)
        settle(first, count, *filled)
        counts.append(room)
        other = other or bool(room[OTHER::SORTS].any())
        parts.append(filled)
    room = np.concatenate(counts)
    first = np.concatenate([[0], np.cumsum(room)])
    turn, turn_first = take_turns(place, sizes, room.reshape(-1, SORTS).sum(axis=1), cell_first)
    start = np.cumsum([0, *(int(rows * columns) for rows, columns in sizes)]).astype(np.int64)
    site, at, across, down, skew, gain = (np.concatenate(of_all) for of_all in zip(*parts, strict=True))
    return Windows(
        site,
        at,
        across,
        down,
        skew,
        gain,
        first,
        place,
        turn,
        turn_first,
        start,
        sizes,
        cell_first,
        # small windows reach no farther
        np.array([halo if other else NEAR], np.int64),
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
