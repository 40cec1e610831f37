"""The products T p and T' r over windows, cell by cell.

The light of a cell is its tile's part of the projector's image, spread over its windows; the transpose collects it.
Projector values are planes (3, pixels), camera light is one number a site. ``mixing`` (projectors, 3, 3) is camera
channel by projector channel. Every site and every projector pixel is written in one order, whatever the threads do.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numba import prange

from controller.core.arrays import FloatImage
from controller.core.jit import compiled
from controller.optics.transport.simd.small_windows import (
    fill_strips,
    look_ahead,
    pour_strips,
    see_skewed,
    see_upright,
    spread_skewed,
    spread_upright,
)
from controller.optics.transport.simd.windows import sheared_add, sheared_sum, window_add, window_sum
from controller.optics.transport.windows.build import TURNS
from controller.optics.transport.windows.profiles import (
    GROUP,
    LANES,
    NEAR,
    OTHER,
    PHASE_BITS,
    PHASES,
    SKEW_STEPS,
    SKEWED,
    SORTS,
    STRIP,
    TILE,
    UPRIGHT,
    Profiles,
    SmallProfiles,
    Windows,
)

STRIPS: Final = STRIP - LANES
"""So many strips there are; each is LANES wide."""
AHEAD: Final = 256
"""Windows between asking for a site's memory and using it. On a busy machine 64 were too few."""


@compiled(fastmath=True)
def see(windows: Windows, table: Profiles, small: SmallProfiles, cell: int, light: FloatImage, out: FloatImage) -> None:
    """Add ``light`` (side, side) in the shares of each of a cell's windows, times gain, to the sites ``out``."""
    first = windows.first[SORTS * cell : SORTS * (cell + 1) + 1]
    flat, side = light.reshape(-1), light.shape[0]
    if first[UPRIGHT] < first[OTHER]:
        strips = np.empty(STRIP * STRIP * LANES, np.float32)
        corner = (windows.halo[0] - NEAR) * (side + 1)
        for x in range(STRIPS):
            for y in range(0, STRIP, LANES):
                fill_strips(flat, corner + side * y + x, side, strips, LANES * (STRIP * x + y))
        last = windows.site.size - GROUP
        for e in range(first[UPRIGHT], first[OTHER], GROUP):
            look_ahead(windows, out, min(e + AHEAD, last), e + 2 * AHEAD)
            if e < first[SKEWED]:
                see_upright(windows, small, e, strips, out)
            else:
                see_skewed(windows, small, e, strips, out)
    if first[OTHER] < first[OTHER + 1]:
        _see_other(windows, table, first[OTHER], first[OTHER + 1], side, flat, out)


@compiled(fastmath=True)
def spread(
    windows: Windows, table: Profiles, small: SmallProfiles, cell: int, values: FloatImage, sums: FloatImage
) -> None:
    """Add the ``values`` of the sites, times gain, in a cell's windows' shares to ``sums`` (side, side), all 0."""
    first = windows.first[SORTS * cell : SORTS * (cell + 1) + 1]
    flat, side = sums.reshape(-1), sums.shape[0]
    if first[UPRIGHT] < first[OTHER]:
        strips = np.zeros(STRIP * STRIP * LANES, np.float32)
        last = windows.site.size - GROUP
        for e in range(first[UPRIGHT], first[OTHER], GROUP):
            look_ahead(windows, values, min(e + AHEAD, last), e + 2 * AHEAD)
            if e < first[SKEWED]:
                spread_upright(windows, small, e, values, strips)
            else:
                spread_skewed(windows, small, e, values, strips)
        corner = (windows.halo[0] - NEAR) * (side + 1)
        for y in range(0, STRIP, LANES):
            pour_strips(strips, LANES * y, flat, corner + side * y, side)
    if first[OTHER] < first[OTHER + 1]:
        _spread_other(windows, table, first[OTHER], first[OTHER + 1], side, values, flat)


# The two loops below are one function each, not one a window: a call with arrays costs more than a window's sum.


@compiled(fastmath=True)
def _see_other(
    windows: Windows, table: Profiles, first: int, last: int, side: int, light: FloatImage, out: FloatImage
) -> None:
    site, at, shears = windows.site[first:last], windows.at[first:last], windows.skew[first:last]
    across, downs, gain = windows.across[first:last], windows.down[first:last], windows.gain[first:last]
    shares, begins, sizes = table.table, table.first, table.size
    for e in range(site.size):
        xs, ys, a, shear = np.int64(across[e]), np.int64(downs[e]), np.int64(at[e]), np.int64(shears[e])
        wide, high, fx, fy = xs >> PHASE_BITS, ys >> PHASE_BITS, xs & (PHASES - 1), ys & (PHASES - 1)
        width, height, base = sizes[wide], sizes[high], begins[wide]
        down = begins[high] + fy * height
        if shear == 0:
            total = window_sum(light, a, side, shares, base + fx * width, down, width, height)
        else:
            below = -(height // 2 - 1) * PHASES - fy
            total = sheared_sum(light, a, side, shares, base, down, width, height, fx, shear, below)
        out[site[e]] += gain[e] * total


@compiled(fastmath=True)
def _spread_other(
    windows: Windows, table: Profiles, first: int, last: int, side: int, values: FloatImage, sums: FloatImage
) -> None:
    site, at, shears = windows.site[first:last], windows.at[first:last], windows.skew[first:last]
    across, downs, gain = windows.across[first:last], windows.down[first:last], windows.gain[first:last]
    shares, begins, sizes = table.table, table.first, table.size
    for e in range(site.size):
        value = values[site[e]] * gain[e]
        xs, ys, a, shear = np.int64(across[e]), np.int64(downs[e]), np.int64(at[e]), np.int64(shears[e])
        wide, high, fx, fy = xs >> PHASE_BITS, ys >> PHASE_BITS, xs & (PHASES - 1), ys & (PHASES - 1)
        width, height, base = sizes[wide], sizes[high], begins[wide]
        down = begins[high] + fy * height
        if shear == 0:
            window_add(sums, a, side, shares, base + fx * width, down, width, height, value)
        else:
            below = -(height // 2 - 1) * PHASES - fy
            sheared_add(sums, a, side, shares, base, down, width, height, fx, shear, below, value)


@compiled(parallel=True)
def even_gains(windows: Windows, small: SmallProfiles, projectors: tuple[int, int]) -> FloatImage:
    """(windows,): what takes the place of gains so that each window's shares sum to 1, white light left out.

    Only those of ``projectors``, from one up to, not including, another, are written.
    """
    even = np.empty(windows.gain.size, np.float32)
    begin, end = SORTS * windows.cell_first[projectors[0]], SORTS * windows.cell_first[projectors[1]]
    for i in prange(begin, end):
        for e in range(windows.first[i], windows.first[i + 1]):
            total = np.float32(1)
            if i % SORTS == SKEWED:
                a, b = LANES * np.int64(windows.across[e]), LANES * np.int64(windows.down[e])
                skews = LANES * LANES * (SKEW_STEPS + np.int64(windows.skew[e]))
                total = np.float32(0)
                for j in range(LANES):
                    for k in range(LANES):
                        total += small.table[a + k] * small.table[b + j] * small.skews[skews + LANES * j + k]
            even[e] = 1 / total if windows.gain[e] > 0 else 0
    return even


Projectors = tuple[int, int]
"""From one up to, not including, another."""


@compiled(fastmath=True)
def _buffered(windows: Windows, tile: int, mixing: FloatImage, p: FloatImage) -> FloatImage:
    """The light of a tile and its halo in the camera's channels, 0 beyond the frame: (3, side, side)."""
    n, halo = windows.place[tile, 0], windows.halo[0]
    side = TILE + 2 * halo
    light = np.zeros((3, side, side), np.float32)
    rows, columns = windows.size[n]
    top, left = windows.place[tile, 2] - halo, windows.place[tile, 3] - halo
    a, b = max(left, 0), min(left + side, columns)
    for y in range(max(top, 0), min(top + side, rows)):
        k = windows.start[n] + y * columns
        r, g, s = p[0, k + a : k + b], p[1, k + a : k + b], p[2, k + a : k + b]
        for c in range(3):
            red, green, blue = mixing[c, 0], mixing[c, 1], mixing[c, 2]
            to = light[c, y - top, a - left : b - left]
            for i in range(to.size):
                to[i] = red * r[i] + green * g[i] + blue * s[i]
    return light


@compiled()
def _windows_of(windows: Windows, tile: int, apart: int) -> int:
    """How many a tile has; its cells are ``apart``."""
    count = 0
    for cell in range(tile, tile + 3 * apart, apart):
        count += windows.first[SORTS * (cell + 1)] - windows.first[SORTS * cell]
    return count


@compiled(fastmath=True)
def _poured(windows: Windows, tile: int, mixing: FloatImage, sums: FloatImage, out: FloatImage) -> None:
    """Add a tile's sums (3, side, side) of the camera's channels to the planes ``out`` (3, pixels)."""
    n, halo = windows.place[tile, 0], windows.halo[0]
    side = sums.shape[1]
    rows, columns = windows.size[n]
    top, left = windows.place[tile, 2] - halo, windows.place[tile, 3] - halo
    a, b = max(left, 0), min(left + side, columns)
    for y in range(max(top, 0), min(top + side, rows)):
        row, c0, c1 = y - top, a - left, b - left
        # not slices of a slice, whose elements numba can't know to lie side by side
        r, g, s = sums[0, row, c0:c1], sums[1, row, c0:c1], sums[2, row, c0:c1]
        k = windows.start[n] + y * columns
        for c in range(3):
            red, green, blue = mixing[0, c], mixing[1, c], mixing[2, c]
            to = out[c, k + a : k + b]
            for i in range(to.size):
                to[i] += red * r[i] + green * g[i] + blue * s[i]


@compiled(parallel=True, fastmath=True)
def forward_sites(
    windows: Windows,
    table: Profiles,
    small: SmallProfiles,
    mixing: FloatImage,
    p: FloatImage,
    projectors: Projectors,
    out: FloatImage,
) -> None:
    """Add the light of the projectors at every site to ``out`` (sites,)."""
    bands = (windows.turn_first.size - 1) // (windows.start.size - 1) // TURNS
    for band in range(bands):
        for n in range(projectors[0], projectors[1]):
            begin = windows.turn_first[(n * bands + band) * TURNS]
            end = windows.turn_first[(n * bands + band + 1) * TURNS]
            apart = (windows.cell_first[n + 1] - windows.cell_first[n]) // 3
            for i in prange(end - begin):
                tile = windows.turn[begin + i]
                if not _windows_of(windows, tile, apart):
                    continue
                light = _buffered(windows, tile, mixing[n], p)
                for colour in range(3):
                    see(windows, table, small, tile + colour * apart, light[colour], out)


@compiled(parallel=True, fastmath=True)
def adjoint_sites(
    windows: Windows,
    table: Profiles,
    small: SmallProfiles,
    mixing: FloatImage,
    r: FloatImage,
    projectors: Projectors,
    out: FloatImage,
) -> None:
    """Write the transpose of ``forward_sites``, from ``r`` (sites,), to their pixels of ``out`` (3, pixels)."""
    side = TILE + 2 * windows.halo[0]
    begin, end = windows.start[projectors[0]], windows.start[projectors[1]]
    for i in prange((end - begin) // 4096 + 1):
        out[:, begin + 4096 * i : min(begin + 4096 * (i + 1), end)] = 0
    bands = (windows.turn_first.size - 1) // (windows.start.size - 1) // TURNS
    for band in range(bands):
        for turn in range(TURNS):
            # the projectors' tiles of this turn, one after the other
            ends = np.zeros(projectors[1] - projectors[0] + 1, np.int64)
            for n in range(projectors[0], projectors[1]):
                k = (n * bands + band) * TURNS + turn
                m = n - projectors[0]
                ends[m + 1] = ends[m] + windows.turn_first[k + 1] - windows.turn_first[k]
            for i in prange(ends[-1]):
                n = projectors[0] + int(np.searchsorted(ends, i, side="right")) - 1
                k = (n * bands + band) * TURNS + turn
                tile = windows.turn[windows.turn_first[k] + i - ends[n - projectors[0]]]
                apart = (windows.cell_first[n + 1] - windows.cell_first[n]) // 3
                if not _windows_of(windows, tile, apart):
                    continue
                sums = np.zeros((3, side, side), np.float32)
                for colour in range(3):
                    spread(windows, table, small, tile + colour * apart, r, sums[colour])
                _poured(windows, tile, mixing[n], sums, out)
