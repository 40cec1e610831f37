"""The light of one cell: its tile's part of the projector's image, spread over its windows, and the transpose."""

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
from controller.optics.transport.windows.profiles import (
    GROUP,
    LANES,
    PHASE_BITS,
    PHASES,
    SKEW_STEPS,
    Profiles,
    SmallProfiles,
)
from controller.optics.transport.windows.sample_kernels import NEAR, OTHER, SKEWED, SORTS, STRIP, UPRIGHT, Windows

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
    windows: Windows,
    table: Profiles,
    small: SmallProfiles,
    cell: int,
    values: FloatImage,
    sums: FloatImage,
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
