"""Parts of T over windows as plain sparse matrices: for solvers that want their equations written out."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from controller.arrays import Float64
from controller.compiled import compiled
from controller.transport.profiles import PHASE_BITS, PHASES, Profiles
from controller.transport.window_transport import WindowTransport
from controller.transport.windows import SHEAR_BITS, TILE, Windows

Sites = npt.NDArray[np.int64]


@lru_cache(maxsize=1)
def windows_of_sites(transport: WindowTransport) -> npt.NDArray[np.int32]:
    """(projectors, sites) int32: the window of each camera site, -1 where it has none."""
    windows = transport.windows
    sites = transport.lit[0].size * (1 if transport.colours.size else 3)
    found = np.full((len(transport.sizes), sites), -1, np.int32)
    for n in range(len(transport.sizes)):
        first, last = windows.first[windows.cell_first[n]], windows.first[windows.cell_first[n + 1]]
        found[n, windows.site[first:last]] = np.arange(first, last, dtype=np.int32)
    return found


def site_rows(transport: WindowTransport, n: int, sites: Sites) -> sp.csr_matrix[np.float64]:
    """(sites, pixels of projector n): gain times shares at some camera sites, colour mixing left out."""
    chosen = windows_of_sites(transport)[n, sites].astype(np.int64)
    row = np.flatnonzero(chosen >= 0)
    chosen = chosen[row]
    windows, table = transport.windows, transport.table
    kinds = windows.across[chosen] >> PHASE_BITS, windows.down[chosen] >> PHASE_BITS
    size = int((table.size[kinds[0]] * table.size[kinds[1]]).sum())
    rows, columns, values = np.empty(size, np.int64), np.empty(size, np.int64), np.empty(size)
    cell = np.searchsorted(windows.first, chosen, side="right") - 1
    count = _entries(windows, table, chosen, cell, row, rows, columns, values)
    shape = (sites.size, transport.sizes[n][0] * transport.sizes[n][1])
    return sp.csr_matrix((values[:count], (rows[:count], columns[:count])), shape=shape)


@compiled()
def _entries(
    windows: Windows,
    table: Profiles,
    chosen: Sites,
    cell: Sites,
    row: Sites,
    rows: Sites,
    columns: Sites,
    values: Float64,
) -> int:
    halo = windows.halo[0]
    side = TILE + 2 * halo
    n = 0
    for i in range(chosen.size):
        e = chosen[i]
        height_px, width_px = windows.size[windows.place[cell[i], 0]]
        xs, ys, shear = np.int64(windows.across[e]), np.int64(windows.down[e]), np.int64(windows.shear[e])
        wide, high, fx, fy = xs >> PHASE_BITS, ys >> PHASE_BITS, xs & (PHASES - 1), ys & (PHASES - 1)
        width, height = table.size[wide], table.size[high]
        top = windows.place[cell[i], 2] - halo + np.int64(windows.at[e]) // side
        left = windows.place[cell[i], 3] - halo + np.int64(windows.at[e]) % side
        for j in range(height):
            x = fx + ((shear * ((j - (height // 2 - 1)) * PHASES - fy)) >> SHEAR_BITS)
            shift, f = x >> PHASE_BITS, x & (PHASES - 1)
            down = np.float64(windows.gain[e]) * table.table[table.first[high] + fy * height + j]
            for k in range(width):
                y, c = top + j, left + shift + k
                if 0 <= y < height_px and 0 <= c < width_px:
                    rows[n], columns[n] = row[i], y * width_px + c
                    values[n] = down * table.table[table.first[wide] + f * width + k]
                    n += 1
    return n


def interpolation(transport: WindowTransport, channel: int, pixels: Sites, sites: Sites) -> sp.csr_matrix[np.float64]:
    """(pixels, sites): what each site gives to some camera pixels (flat) in one channel; ``sites`` rise."""
    columns = transport.shape[1]
    if not transport.colours.size:
        at = np.searchsorted(sites, pixels + channel * transport.lit[0].size)
        return sp.csr_matrix((np.ones(pixels.size), (np.arange(pixels.size), at)), shape=(pixels.size, sites.size))
    y, x = pixels // columns, pixels % columns
    own = transport.colours[y & 1, x & 1] == channel
    parts = []
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            r, c = y + dy, x + dx
            ok = (r >= 0) & (c >= 0) & (r < transport.shape[0]) & (c < columns)
            ok &= transport.colours[r & 1, c & 1] == channel
            ok &= ~own | ((dy == 0) & (dx == 0))
            parts.append((np.flatnonzero(ok), np.searchsorted(sites, (r * columns + c)[ok])))
    row, at = (np.concatenate(part) for part in zip(*parts, strict=True))
    count = np.bincount(row, minlength=pixels.size)
    return sp.csr_matrix((1.0 / count[row], (row, at)), shape=(pixels.size, sites.size))


def box_rows(
    transport: WindowTransport, box: tuple[int, int, int, int], unknown: Sites, channels: tuple[int, ...]
) -> sp.csr_matrix[np.float64]:
    """Rows (channel, pixel of the box) of T in the columns (channel, unknown pixel).

    ``box``: camera pixels from (top, left) up to, not including, (bottom, right); ``unknown`` rising
    """
    top, left, bottom, right = box
    height, width = transport.shape
    y, x = np.mgrid[top:bottom, left:right]
    pixels: Sites = (y * width + x).ravel()
    blocks = []
    for c in channels:
        near = np.mgrid[max(top - 1, 0) : min(bottom + 1, height), max(left - 1, 0) : min(right + 1, width)]
        y, x = near.reshape(2, -1)
        sites = y * width + x + (0 if transport.colours.size else c * height * width)
        if transport.colours.size:
            sites = sites[transport.colours[y & 1, x & 1] == c]
        D = interpolation(transport, c, pixels, sites)
        parts = []
        for n in range(len(transport.sizes)):
            span = transport.span(n)
            mine = unknown[(unknown >= span.start) & (unknown < span.stop)]
            rows = sp.csc_matrix(site_rows(transport, n, sites))[:, mine - span.start]
            part = D @ rows
            parts.append(sp.hstack([part * float(transport.mixing[n, c, d]) for d in channels], format="csc"))
        count = [part.shape[1] // len(channels) for part in parts]
        whole = sp.hstack(parts, format="csc")
        # from (projector, channel, pixel) to (channel, projector, pixel)
        first = np.cumsum([0, *(len(channels) * k for k in count)])
        order = [np.arange(k) + first[n] + d * k for d in range(len(channels)) for n, k in enumerate(count)]
        blocks.append(whole[:, np.concatenate(order)])
    return sp.csr_matrix(sp.vstack(blocks, format="csr"))
