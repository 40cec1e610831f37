"""The products T p and T' r over windows.

Projector values are planes (3, pixels), camera light is one number a site. ``mixing`` (projectors, 3, 3) is camera
channel by projector channel. Every site and every projector pixel is written in one order, whatever the threads do.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numba import prange

from controller.arrays import FloatImage
from controller.compiled import compiled
from controller.transport.profiles import LANES, PHASE_BITS, PHASES, Profiles
from controller.transport.window_lanes import fetch, small_add, small_sum, window_add, window_sum
from controller.transport.windows import SHEAR_BITS, TILE, TURNS, Windows

AHEAD: Final = 32
"""Windows between asking for a site's memory and using it: runs of sites are too short for the processor to foresee."""

# The two loops below are one function each, not one a window: a call with arrays costs more than a small window's sum.


@compiled(fastmath=True)
def _see(windows: Windows, table: Profiles, cell: int, side: int, light: FloatImage, out: FloatImage) -> None:
    """Add the light of a cell's buffer in the shares of each of its windows, times gain, to the sites ``out``."""
    first, last = windows.first[cell], windows.first[cell + 1]
    site, at, shears = windows.site[first:last], windows.at[first:last], windows.shear[first:last]
    across, downs, gain = windows.across[first:last], windows.down[first:last], windows.gain[first:last]
    shares, begins, sizes, small = table.table, table.first, table.size, table.small[0] * PHASES
    for e in range(site.size):
        fetch(out, site[min(e + AHEAD, site.size - 1)])
        xs, ys, a, shear = np.int64(across[e]), np.int64(downs[e]), np.int64(at[e]), np.int64(shears[e])
        if shear == 0 and xs < small and ys < small:
            out[site[e]] += gain[e] * small_sum(light, a, side, shares, LANES * xs, LANES * ys)
            continue
        wide, high, fx, fy = xs >> PHASE_BITS, ys >> PHASE_BITS, xs & (PHASES - 1), ys & (PHASES - 1)
        width, height = sizes[wide], sizes[high]
        base, down = begins[wide], begins[high] + fy * height
        dy = -(height // 2 - 1) * PHASES - fy
        total = np.float32(0)
        for j in range(0, height, LANES):
            x0 = fx + ((shear * dy) >> SHEAR_BITS)
            x1 = fx + ((shear * (dy + PHASES)) >> SHEAR_BITS)
            x2 = fx + ((shear * (dy + 2 * PHASES)) >> SHEAR_BITS)
            x3 = fx + ((shear * (dy + 3 * PHASES)) >> SHEAR_BITS)
            a0, a1 = a + (x0 >> PHASE_BITS), a + side + (x1 >> PHASE_BITS)
            a2, a3 = a + 2 * side + (x2 >> PHASE_BITS), a + 3 * side + (x3 >> PHASE_BITS)
            s0, s1 = base + (x0 & (PHASES - 1)) * width, base + (x1 & (PHASES - 1)) * width
            s2, s3 = base + (x2 & (PHASES - 1)) * width, base + (x3 & (PHASES - 1)) * width
            for g in range(0, width, LANES):
                rows, parts = (a0 + g, a1 + g, a2 + g, a3 + g), (s0 + g, s1 + g, s2 + g, s3 + g)
                total += window_sum(light, rows, shares, parts, down + j)
            a += LANES * side
            dy += LANES * PHASES
        out[site[e]] += gain[e] * total


@compiled(fastmath=True)
def _spread(
    windows: Windows, table: Profiles, cell: int, side: int, values: FloatImage, weighted: bool, sums: FloatImage
) -> None:
    """Add the ``values`` of the sites, times gain where ``weighted``, to a cell's buffer in the shares of its windows.

    Sites beyond ``values`` are passed over.
    """
    first, last = windows.first[cell], windows.first[cell + 1]
    site, at, shears = windows.site[first:last], windows.at[first:last], windows.shear[first:last]
    across, downs, gain = windows.across[first:last], windows.down[first:last], windows.gain[first:last]
    shares, begins, sizes, small = table.table, table.first, table.size, table.small[0] * PHASES
    for e in range(site.size):
        fetch(values, site[min(e + AHEAD, site.size - 1)])
        if site[e] >= values.size:
            continue
        value = values[site[e]] * (gain[e] if weighted else np.float32(1))
        xs, ys, a, shear = np.int64(across[e]), np.int64(downs[e]), np.int64(at[e]), np.int64(shears[e])
        if shear == 0 and xs < small and ys < small:
            small_add(sums, a, side, shares, LANES * xs, LANES * ys, value)
            continue
        wide, high, fx, fy = xs >> PHASE_BITS, ys >> PHASE_BITS, xs & (PHASES - 1), ys & (PHASES - 1)
        width, height = sizes[wide], sizes[high]
        base, down = begins[wide], begins[high] + fy * height
        dy = -(height // 2 - 1) * PHASES - fy
        for j in range(0, height, LANES):
            x0 = fx + ((shear * dy) >> SHEAR_BITS)
            x1 = fx + ((shear * (dy + PHASES)) >> SHEAR_BITS)
            x2 = fx + ((shear * (dy + 2 * PHASES)) >> SHEAR_BITS)
            x3 = fx + ((shear * (dy + 3 * PHASES)) >> SHEAR_BITS)
            a0, a1 = a + (x0 >> PHASE_BITS), a + side + (x1 >> PHASE_BITS)
            a2, a3 = a + 2 * side + (x2 >> PHASE_BITS), a + 3 * side + (x3 >> PHASE_BITS)
            s0, s1 = base + (x0 & (PHASES - 1)) * width, base + (x1 & (PHASES - 1)) * width
            s2, s3 = base + (x2 & (PHASES - 1)) * width, base + (x3 & (PHASES - 1)) * width
            for g in range(0, width, LANES):
                rows, parts = (a0 + g, a1 + g, a2 + g, a3 + g), (s0 + g, s1 + g, s2 + g, s3 + g)
                window_add(sums, rows, shares, parts, down + j, value)
            a += LANES * side
            dy += LANES * PHASES


@compiled(fastmath=True)
def _buffered(
    p: FloatImage, weights: FloatImage, start: int, rows: int, columns: int, top: int, left: int, side: int
) -> FloatImage:
    """The light of a cell's tile and halo in one camera channel, 0 beyond the frame."""
    light = np.zeros(side * side, np.float32)
    a, b = max(left, 0), min(left + side, columns)
    red, green, blue = weights
    for y in range(max(top, 0), min(top + side, rows)):
        to = light[(y - top) * side + a - left : (y - top) * side + b - left]
        k = start + y * columns
        r, g, s = p[0, k + a : k + b], p[1, k + a : k + b], p[2, k + a : k + b]
        for i in range(to.size):
            to[i] = red * r[i] + green * g[i] + blue * s[i]
    return light


@compiled(parallel=True, fastmath=True)
def forward_sites(
    windows: Windows, table: Profiles, mixing: FloatImage, p: FloatImage, projectors: tuple[int, int], out: FloatImage
) -> None:
    """Add the light of the projectors at every site to ``out`` (sites,)."""
    halo = windows.halo[0]
    side = TILE + 2 * halo
    for n in range(projectors[0], projectors[1]):
        begin, end = windows.cell_first[n], windows.cell_first[n + 1]
        half = (end - begin + 1) // 2
        for i in prange(end - begin):
            # neighbours go to different threads, so that both have as much to do
            cell = begin + (2 * i if i < half else 2 * (i - half) + 1)
            first, last = windows.first[cell], windows.first[cell + 1]
            if first == last:
                continue
            colour = windows.place[cell, 1]
            rows, columns = windows.size[n]
            top, left = windows.place[cell, 2] - halo, windows.place[cell, 3] - halo
            light = _buffered(p, mixing[n, colour], windows.start[n], rows, columns, top, left, side)
            _see(windows, table, cell, side, light, out)


@compiled(fastmath=True)
def _pour(
    sums: FloatImage,
    factor: float,
    start: int,
    rows: int,
    columns: int,
    top: int,
    left: int,
    side: int,
    out: FloatImage,
) -> None:
    """Add a cell's buffer to the plane ``out`` (pixels,) of one channel."""
    a, b = max(left, 0), min(left + side, columns)
    for y in range(max(top, 0), min(top + side, rows)):
        since = sums[(y - top) * side + a - left : (y - top) * side + b - left]
        to = out[start + y * columns + a : start + y * columns + b]
        for i in range(to.size):
            to[i] += factor * since[i]


@compiled(parallel=True, fastmath=True)
def adjoint_sites(
    windows: Windows,
    table: Profiles,
    mixing: FloatImage,
    r: FloatImage,
    weighted: bool,
    projectors: tuple[int, int],
    out: FloatImage,
) -> None:
    """Write the transpose of ``forward_sites``: ``r`` (sites,) to those pixels of ``out`` (3, pixels) that are theirs.

    ``weighted``: with the windows' gains; else every site counts alike.
    """
    halo = windows.halo[0]
    side = TILE + 2 * halo
    begin, end = windows.start[projectors[0]], windows.start[projectors[1]]
    for i in prange((end - begin) // 4096 + 1):
        out[:, begin + 4096 * i : min(begin + 4096 * (i + 1), end)] = 0
    for t in range(TURNS):
        begin, end = windows.turn_first[t], windows.turn_first[t + 1]
        for i in prange(end - begin):
            tile = windows.turn[begin + i]
            n = windows.place[tile, 0]
            if n < projectors[0] or n >= projectors[1]:
                continue
            apart = (windows.cell_first[n + 1] - windows.cell_first[n]) // 3
            rows, columns = windows.size[n]
            top, left = windows.place[tile, 2] - halo, windows.place[tile, 3] - halo
            for colour in range(3):
                cell = tile + colour * apart
                if windows.first[cell] == windows.first[cell + 1]:
                    continue
                sums = np.zeros(side * side, np.float32)
                _spread(windows, table, cell, side, r, weighted, sums)
                for c in range(3):
                    m = mixing[n, colour, c]
                    if m != 0:
                        _pour(sums, m, windows.start[n], rows, columns, top, left, side, out[c])
