"""The windows of a stage, from its phase maps and white images."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from controller.core import channels
from controller.core.arrays import Float64, FloatImage, Mask
from controller.optics.calibrate.values import PhaseMap
from controller.optics.transport.windows.order import place_cells, settle, take_turns
from controller.optics.transport.windows.profiles import GROUP, Profiles, build_profiles, build_small_profiles
from controller.optics.transport.windows.sample_kernels import BEYOND, MOST_SHEAR, NEAR, OTHER, SORTS, Windows, kind_of
from controller.optics.transport.windows.walk import BANDS, walk

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
    walks = [
        (phase_map.projector_px, phase_map.spread_px2, apart[n], white[n], colours, use[n], *tables, halo)
        for n, phase_map in enumerate(maps)
    ]
    # all are counted first, so that there is one array of each kind from the beginning
    bands, counts, rooms = [], [], []
    for n, arguments in enumerate(walks):
        bands.append(np.zeros((BANDS, SORTS * int(cell_first[n + 1] - cell_first[n])), np.int64))
        walk(*arguments, bands[n], True, *_empty(0))
        count = bands[n].sum(axis=0)
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
        begins = own[:-1] + np.cumsum(bands[n], axis=0) - bands[n]
        walk(*arguments, begins, False, *mine)
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
