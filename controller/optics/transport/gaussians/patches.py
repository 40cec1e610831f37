"""Metapixels as patches of weights, and the tiles of the camera image they touch.

A patch is the smallest box of camera pixels around one metapixel's ellipse, stored row by row, each row padded to whole
groups of eight weights so that a product runs in full vector registers. Weights are integers: their scale cancels when
the shares at a camera pixel are normalised.

Both products walk the camera image tile by tile and know, for every tile, the patches that touch it. A tile is written
by one thread only, so a product is right where surfaces fold or occlude each other and is the same to the bit for any
number of threads.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import prange

from controller.core.arrays import FloatImage
from controller.core.jit import compiled
from controller.optics.calibrate.values import Metapixels
from controller.optics.transport.simd.gaussians import LANES

CUT: float = 3.0
"""Gaussians end at this Mahalanobis distance."""
LARGEST_PX = 255
"""A metapixel wider or higher than this is a failed fit; it is left dark."""
TILE_ROWS = 64
TILE_COLUMNS = 256

Weight = np.uint16
FULL_WEIGHT = 65535


class Patches(NamedTuple):
    """The metapixels of all projectors, one after the other, in row-major order of each projector's image.

    ``weights`` (groups * 8,) uint16: 65535 at a Gaussian's centre
    ``first`` (pixels,) int32: where a patch's weights begin, in groups of eight
    ``row``, ``column`` (pixels,) int16: camera pixel of the patch's first weight
    ``rows``, ``groups`` (pixels,) uint8: extent; 0 rows where a projector pixel lights nothing; uint16 where weights
        of another model span more than 255 rows (``custom_weights``)
    ``start`` (projectors + 1,) int64: first pixel of each projector
    ``members`` int32, ``tile_first`` (projectors * tiles + 1,) int64: the patches that touch each tile, by projector
    ``camera_shape``, ``margin`` (2,) int64: (rows, columns) of the image, and the largest patch
    """

    weights: npt.NDArray[np.uint16]
    first: npt.NDArray[np.int32]
    row: npt.NDArray[np.int16]
    column: npt.NDArray[np.int16]
    rows: npt.NDArray[np.uint8] | npt.NDArray[np.uint16]
    groups: npt.NDArray[np.uint8] | npt.NDArray[np.uint16]
    start: npt.NDArray[np.int64]
    members: npt.NDArray[np.int32]
    tile_first: npt.NDArray[np.int64]
    camera_shape: npt.NDArray[np.int64]
    margin: npt.NDArray[np.int64]


def build_patches(metapixels: tuple[Metapixels, ...], camera_shape: tuple[int, int]) -> Patches:
    """Evaluate every metapixel's Gaussian at the camera pixels within ``CUT`` (paper 4.2.3)."""
    shape = np.array(camera_shape, np.int64)
    start = np.cumsum([0, *(m.valid.size for m in metapixels)]).astype(np.int64)
    centre = np.concatenate([m.centre_px.reshape(-1, 2) for m in metapixels]).astype(np.float32, copy=False)
    covariance = np.concatenate([m.covariance_px2.reshape(-1, 3) for m in metapixels]).astype(np.float32, copy=False)
    valid = np.concatenate([m.valid.ravel() for m in metapixels])
    row, column, rows, groups = _boxes(centre, covariance, valid, shape)
    cells = rows.astype(np.int64) * groups
    first = np.zeros(cells.size, np.int64)
    np.cumsum(cells[:-1], out=first[1:])
    weights = np.zeros(int(cells.sum()) * LANES, Weight)
    _fill(centre, covariance, row, column, rows, groups, first, weights)
    margin = np.array([rows.max(initial=0), groups.max(initial=0) * LANES], np.int64)
    members, tile_first = tile_lists(row, column, rows, groups, start, shape)
    return Patches(
        weights, first.astype(np.int32), row, column, rows, groups, start, members, tile_first, shape, margin
    )


@compiled(parallel=True)
def _boxes(
    centre: FloatImage, covariance: FloatImage, valid: npt.NDArray[np.bool_], shape: npt.NDArray[np.int64]
) -> tuple[npt.NDArray[np.int16], npt.NDArray[np.int16], npt.NDArray[np.uint8], npt.NDArray[np.uint8]]:
    count = valid.size
    row = np.zeros(count, np.int16)
    column = np.zeros(count, np.int16)
    rows = np.zeros(count, np.uint8)
    groups = np.zeros(count, np.uint8)
    for v in prange(count):
        x, y = np.float64(centre[v, 0]), np.float64(centre[v, 1])
        xx, xy, yy = np.float64(covariance[v, 0]), np.float64(covariance[v, 1]), np.float64(covariance[v, 2])
        # NaN fails every comparison, so the conditions are put the positive way round.
        if not (valid[v] and xx > 0.0 and yy > 0.0 and xx * yy - xy * xy > 0.0):
            continue
        reach_x, reach_y = CUT * np.sqrt(xx), CUT * np.sqrt(yy)
        if not (2 * reach_x < LARGEST_PX - LANES and 2 * reach_y < LARGEST_PX - 1):
            continue
        if not (x + reach_x >= 0 and y + reach_y >= 0 and x - reach_x < shape[1] and y - reach_y < shape[0]):
            continue
        top, bottom = max(int(np.ceil(y - reach_y)), 0), min(int(np.floor(y + reach_y)), shape[0] - 1)
        left, right = max(int(np.ceil(x - reach_x)), 0), min(int(np.floor(x + reach_x)), shape[1] - 1)
        if bottom < top or right < left:
            continue
        row[v], column[v] = top, left
        rows[v] = bottom - top + 1
        groups[v] = (right - left) // LANES + 1
    return row, column, rows, groups


@compiled(parallel=True)
def _fill(
    centre: FloatImage,
    covariance: FloatImage,
    row: npt.NDArray[np.int16],
    column: npt.NDArray[np.int16],
    rows: npt.NDArray[np.uint8],
    groups: npt.NDArray[np.uint8],
    first: npt.NDArray[np.int64],
    weights: npt.NDArray[np.uint16],
) -> None:
    for v in prange(rows.size):
        if rows[v] == 0:
            continue
        xx, xy, yy = np.float64(covariance[v, 0]), np.float64(covariance[v, 1]), np.float64(covariance[v, 2])
        scale = 1.0 / (xx * yy - xy * xy)
        k = first[v] * LANES
        for r in range(rows[v]):
            dy = row[v] + r - np.float64(centre[v, 1])
            for q in range(groups[v] * LANES):
                dx = column[v] + q - np.float64(centre[v, 0])
                squared = (yy * dx * dx - 2.0 * xy * dx * dy + xx * dy * dy) * scale
                if squared <= CUT * CUT:
                    weights[k] = np.uint16(np.exp(-0.5 * squared) * FULL_WEIGHT + 0.5)
                k += 1


@compiled()
def tile_lists(
    row: npt.NDArray[np.int16],
    column: npt.NDArray[np.int16],
    rows: npt.NDArray[np.uint8] | npt.NDArray[np.uint16],
    groups: npt.NDArray[np.uint8] | npt.NDArray[np.uint16],
    start: npt.NDArray[np.int64],
    shape: npt.NDArray[np.int64],
) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.int64]]:
    """The patches that touch each tile, by projector and tile, and where each tile's list begins."""
    down, across = (shape[0] + TILE_ROWS - 1) // TILE_ROWS, (shape[1] + TILE_COLUMNS - 1) // TILE_COLUMNS
    tiles = down * across
    tile_first = np.zeros((start.size - 1) * tiles + 1, np.int64)
    members = np.zeros(0, np.int32)
    fill = tile_first[:-1].copy()
    for counting in (True, False):
        for n in range(start.size - 1):
            for v in range(start[n], start[n + 1]):
                if rows[v] == 0:
                    continue
                last_down = min((row[v] + rows[v] - 1) // TILE_ROWS, down - 1)
                last_across = min((column[v] + groups[v] * LANES - 1) // TILE_COLUMNS, across - 1)
                for i in range(row[v] // TILE_ROWS, last_down + 1):
                    for j in range(column[v] // TILE_COLUMNS, last_across + 1):
                        t = n * tiles + i * across + j
                        if counting:
                            tile_first[t + 1] += 1
                        else:
                            members[fill[t]] = v
                            fill[t] += 1
        if counting:
            tile_first[:] = np.cumsum(tile_first)
            fill = tile_first[:-1].copy()
            members = np.zeros(tile_first[-1], np.int32)
    return members, tile_first
