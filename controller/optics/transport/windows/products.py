"""The products T p and T' r over windows.

Projector values are planes (3, pixels), camera light is one number a site. ``mixing`` (projectors, 3, 3) is camera
channel by projector channel. Every site and every projector pixel is written in one order, whatever the threads do.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from controller.core.arrays import FloatImage
from controller.core.jit import compiled
from controller.optics.transport.windows.cells import see, spread
from controller.optics.transport.windows.order import TURNS
from controller.optics.transport.windows.profiles import Profiles, SmallProfiles
from controller.optics.transport.windows.sample_kernels import SORTS, TILE, Windows

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
