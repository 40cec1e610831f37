"""Parts of T over windows as plain sparse matrices, for solvers that need explicit equations."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from controller.core.arrays import Float64, FloatImage
from controller.core.jit import compiled
from controller.optics.transport.planes import CameraBox
from controller.optics.transport.windows.profiles import (
    LANES,
    NEAR,
    OTHER,
    PHASE_BITS,
    PHASES,
    SHEAR_BITS,
    SKEW_STEPS,
    SKEWED,
    SORTS,
    STRIP,
    TILE,
    Profiles,
    SmallProfiles,
    Windows,
)

Sites = npt.NDArray[np.int64]


class SampleRows(NamedTuple):
    """What makes the rows of T at a camera's samples; fields as in ``WindowTransport``.

    ``window`` (projectors, sites) int32: the window of each camera site, -1 where it has none
    """

    windows: Windows
    profiles: Profiles
    small: SmallProfiles
    window: npt.NDArray[np.int32]


def windows_of_sites(windows: Windows, sites: int) -> npt.NDArray[np.int32]:
    """``SampleRows.window`` of so many camera sites."""
    projectors = len(windows.size)
    found = np.full((projectors, sites), -1, np.int32)
    for n in range(projectors):
        first, last = windows.first[SORTS * windows.cell_first[n]], windows.first[SORTS * windows.cell_first[n + 1]]
        # not those that only fill a group up
        own = first + np.flatnonzero(windows.gain[first:last])
        found[n, windows.site[own]] = own
    return found


def site_rows(rows_of: SampleRows, n: int, sites: Sites, pixels: Sites) -> sp.csr_matrix[np.float64]:
    """(sites, pixels): gain times shares at some camera sites, colour mixing left out.

    ``pixels``: of projector n, rising. No array is as large as the projector: there are many such parts.
    """
    windows, table, small, window = rows_of
    chosen = window[n, sites].astype(np.int64)
    row = np.flatnonzero(chosen >= 0)
    chosen = chosen[row]
    cell = np.searchsorted(windows.first, chosen, side="right") - 1
    other = cell % SORTS == OTHER
    kinds = windows.across[chosen[other]] >> PHASE_BITS, windows.down[chosen[other]] >> PHASE_BITS
    size = int((table.size[kinds[0]] * table.size[kinds[1]]).sum()) + LANES * LANES * int((~other).sum())
    rows, columns, values = np.empty(size, np.int64), np.empty(size, np.int64), np.empty(size)
    count = _entries(windows, table, small, chosen, cell, row, pixels, rows, columns, values)
    return sp.csr_matrix((values[:count], (rows[:count], columns[:count])), shape=(sites.size, pixels.size))


@compiled()
def _entries(
    windows: Windows,
    table: Profiles,
    small: SmallProfiles,
    chosen: Sites,
    cell: Sites,
    row: Sites,
    pixels: Sites,
    rows: Sites,
    columns: Sites,
    values: Float64,
) -> int:
    n = 0
    for i in range(chosen.size):
        _, _, top, left = windows.place[cell[i] // SORTS]
        height, width = windows.size[windows.place[cell[i] // SORTS, 0]]
        if cell[i] % SORTS == OTHER:
            shares = _other_shares(windows, table, chosen[i])
        else:
            shares = _shares(windows, small, chosen[i], cell[i] % SORTS == SKEWED)
        for down, along, share in shares:
            y, x = top + down, left + along
            if not (0 <= y < height and 0 <= x < width):
                continue
            place = np.searchsorted(pixels, y * width + x)
            if place < pixels.size and pixels[place] == y * width + x:
                rows[n], columns[n], values[n] = row[i], place, share
                n += 1
    return n


@compiled()
def _shares(windows: Windows, small: SmallProfiles, e: int, skewed: bool) -> list[tuple[int, int, float]]:
    """Row and column from the tile's corner on, and gain times share, of each pixel of a small window."""
    at, xs, ys = np.int64(windows.at[e]), LANES * np.int64(windows.across[e]), LANES * np.int64(windows.down[e])
    top, left = at % STRIP - NEAR, at // STRIP - NEAR
    skews = LANES * LANES * (SKEW_STEPS + np.int64(windows.skew[e]))
    found = []
    for j in range(LANES):
        for k in range(LANES):
            share = np.float64(windows.gain[e]) * small.table[xs + k] * small.table[ys + j]
            factor = small.skews[skews + LANES * j + k] if skewed else np.float32(1)
            found.append((int(top + j), int(left + k), float(share * factor)))
    return found


@compiled()
def _other_shares(windows: Windows, table: Profiles, e: int) -> list[tuple[int, int, float]]:
    """The same of any other window."""
    halo = windows.halo[0]
    side = TILE + 2 * halo
    at, xs, ys = np.int64(windows.at[e]), np.int64(windows.across[e]), np.int64(windows.down[e])
    wide, high, fx, fy = xs >> PHASE_BITS, ys >> PHASE_BITS, xs & (PHASES - 1), ys & (PHASES - 1)
    width, height = table.size[wide], table.size[high]
    top, left = at // side - halo, at % side - halo
    found = []
    for j in range(height):
        x = fx + ((np.int64(windows.skew[e]) * ((j - (height // 2 - 1)) * PHASES - fy)) >> SHEAR_BITS)
        shift, f = x >> PHASE_BITS, x & (PHASES - 1)
        down = np.float64(windows.gain[e]) * table.table[table.first[high] + fy * height + j]
        for k in range(width):
            share = down * np.float64(table.table[table.first[wide] + f * width + k])
            found.append((int(top + j), int(left + shift + k), float(share)))
    return found


def interpolation(
    colours: npt.NDArray[np.int64], camera_shape: tuple[int, int], channel: int, pixels: Sites, sites: Sites
) -> sp.csr_matrix[np.float64]:
    """(pixels, sites): what each site gives to some camera pixels (flat) in one channel; ``sites`` rise."""
    rows, columns = camera_shape
    if not colours.size:
        at = np.searchsorted(sites, pixels + channel * rows * columns)
        return sp.csr_matrix((np.ones(pixels.size), (np.arange(pixels.size), at)), shape=(pixels.size, sites.size))
    y, x = pixels // columns, pixels % columns
    own = colours[y & 1, x & 1] == channel
    parts = []
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            r, c = y + dy, x + dx
            ok = (r >= 0) & (c >= 0) & (r < rows) & (c < columns)
            ok &= colours[r & 1, c & 1] == channel
            ok &= ~own | ((dy == 0) & (dx == 0))
            parts.append((np.flatnonzero(ok), np.searchsorted(sites, (r * columns + c)[ok])))
    row, at = (np.concatenate(part) for part in zip(*parts, strict=True))
    count = np.bincount(row, minlength=pixels.size)
    return sp.csr_matrix((1.0 / count[row], (row, at)), shape=(pixels.size, sites.size))


def window_rows(
    rows_of: SampleRows,
    colours: npt.NDArray[np.int64],
    mixing: FloatImage,
    camera_shape: tuple[int, int],
    box: CameraBox,
    pixels: Sites,
    channels: tuple[int, ...],
) -> sp.csr_matrix[np.float64]:
    """``LightTransport.submatrix`` of windows; ``colours`` and ``mixing`` as in ``WindowTransport``."""
    top, left, bottom, right = box
    height, width = camera_shape
    start = rows_of.windows.start
    y, x = np.mgrid[top:bottom, left:right]
    in_box: Sites = (y * width + x).ravel()
    blocks = []
    for c in channels:
        near = np.mgrid[max(top - 1, 0) : min(bottom + 1, height), max(left - 1, 0) : min(right + 1, width)]
        y, x = near.reshape(2, -1)
        sites = y * width + x + (0 if colours.size else c * height * width)
        if colours.size:
            sites = sites[colours[y & 1, x & 1] == c]
        D = interpolation(colours, camera_shape, c, in_box, sites)
        parts = []
        for n in range(len(start) - 1):
            mine = pixels[(pixels >= start[n]) & (pixels < start[n + 1])]
            part = sp.csc_matrix(D @ site_rows(rows_of, n, sites, mine - start[n]))
            parts.append(sp.hstack([part * float(mixing[n, c, d]) for d in channels], format="csc"))
        count = [part.shape[1] // len(channels) for part in parts]
        whole = sp.hstack(parts, format="csc")
        # from (projector, channel, pixel) to (channel, projector, pixel)
        first = np.cumsum([0, *(len(channels) * k for k in count)])
        order = [np.arange(k) + first[n] + d * k for d in range(len(channels)) for n, k in enumerate(count)]
        blocks.append(whole[:, np.concatenate(order)])
    return sp.csr_matrix(sp.vstack(blocks, format="csr"))
