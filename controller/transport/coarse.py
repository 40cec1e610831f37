"""A light transport at half the resolution of camera and projectors: where a solve may begin at a quarter of the cost.

Each pixel of the coarse camera takes the place of one sample of the four it covers, that of its own colour; its white
is their mean. A coarse projector pixel stands for the bilinear interpolation between neighbours, which adds its own
variance to the blur.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import cv2
import numpy as np
import numpy.typing as npt

from controller.arrays import FloatImage
from controller.calibrate.values import PhaseMap
from controller.compiled import compiled
from controller.transport.profiles import PHASE_BITS, PHASES, Profiles, sigma_of
from controller.transport.windows import SHEARS, TILE, Windows

if TYPE_CHECKING:
    from controller.transport.window_transport import WindowTransport

LEAST_SIDE_PX: Final = 24
"""Projectors and cameras are not halved below this."""
INTERPOLATION_PX2: Final = 1 / 6


def halved(transport: WindowTransport) -> WindowTransport | None:
    """``transport`` at half the resolution; None where a side would be less than ``LEAST_SIDE_PX``."""
    shape = transport.shape[0] // 2, transport.shape[1] // 2
    sizes = [((rows + 1) // 2, (columns + 1) // 2) for rows, columns in transport.sizes]
    if min(shape + min(sizes)) < LEAST_SIDE_PX:
        return None
    variance = sigma_of(np.arange(transport.table.size.size)) ** 2
    ones = np.ones((3, transport.pixels), np.float32)
    maps, whites = [], []
    light = np.empty((3, *transport.shape), np.float32)
    for n, size in enumerate(sizes):
        position = np.full((*shape, 2), np.nan, np.float32)
        spread = np.full((*size, 3), np.nan, np.float32)
        _places(transport.windows, transport.table, n, transport.shape[1], variance, position, spread)
        maps.append(PhaseMap(position, spread))
        transport.forward_planes(ones, projectors=(n, n + 1), out=light)
        whites.append(np.ascontiguousarray(np.moveaxis(halved_planes(light), 0, 2)))
    mask = halved_planes(transport.object_mask[None].astype(np.float32))[0] > 0
    return type(transport).of(tuple(maps), tuple(whites), transport.colours, mask, transport.mixing)


def halved_planes(planes: FloatImage) -> FloatImage:
    """Means over 2 x 2 pixels of planes (n, rows, columns); an odd last row or column is left out."""
    rows, columns = planes.shape[1] // 2, planes.shape[2] // 2
    return np.stack(
        [cv2.resize(p[: 2 * rows, : 2 * columns], (columns, rows), interpolation=cv2.INTER_AREA) for p in planes]
    )


def doubled_planes(planes: FloatImage, size: tuple[int, int]) -> FloatImage:
    """Bilinear interpolation of planes (n, rows, columns) to ``size``, which ``halved`` made half of."""
    rows, columns = planes.shape[1:]
    return np.stack(
        [cv2.resize(p, (2 * columns, 2 * rows), interpolation=cv2.INTER_LINEAR)[: size[0], : size[1]] for p in planes]
    )


@compiled()
def _places(
    windows: Windows,
    table: Profiles,
    n: int,
    columns: int,
    variance: npt.NDArray[np.float64],
    position: FloatImage,
    spread: FloatImage,
) -> None:
    """Read the place each coarse camera pixel looks at, and the blur there, from the windows of projector ``n``."""
    halo = windows.halo[0]
    side = TILE + 2 * halo
    for cell in range(windows.cell_first[n], windows.cell_first[n + 1]):
        for e in range(windows.first[cell], windows.first[cell + 1]):
            r, c = windows.site[e] // columns, windows.site[e] % columns
            i, j = r // 2, c // 2
            # the sample of a coarse pixel's own colour has the parity of that pixel
            if i >= position.shape[0] or j >= position.shape[1] or (r & 1) != (i & 1) or (c & 1) != (j & 1):
                continue
            xs, ys = np.int64(windows.across[e]), np.int64(windows.down[e])
            wide, high = xs >> PHASE_BITS, ys >> PHASE_BITS
            at = np.int64(windows.at[e])
            left = windows.place[cell, 3] - halo + at % side + table.size[wide] // 2 - 1
            top = windows.place[cell, 2] - halo + at // side + table.size[high] // 2 - 1
            x = (left + ((xs & (PHASES - 1)) + 0.5) / PHASES - 0.5) / 2
            y = (top + ((ys & (PHASES - 1)) + 0.5) / PHASES - 0.5) / 2
            position[i, j, 0], position[i, j, 1] = x, y
            k = windows.shear[e] / SHEARS
            v = min(max(int(np.floor(y + 0.5)), 0), spread.shape[0] - 1)
            u = min(max(int(np.floor(x + 0.5)), 0), spread.shape[1] - 1)
            spread[v, u, 0] = (variance[wide] + k * k * variance[high]) / 4 + INTERPOLATION_PX2
            spread[v, u, 1] = k * variance[high] / 4
            spread[v, u, 2] = variance[high] / 4 + INTERPOLATION_PX2
