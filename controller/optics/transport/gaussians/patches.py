"""Metapixels as patches of weights, and the tiles of the camera image they touch.

A patch is the smallest box of camera pixels around one metapixel's ellipse, stored row by row, each row padded to whole
groups of eight weights so that a product runs in full vector registers. Weights are integers: their scale cancels when
the shares at a camera pixel are normalised.

Both products walk the camera image tile by tile and know, for every tile, the patches that touch it. A tile is written
by one thread only, so a product is right where surfaces fold or occlude each other and is the same to the bit for any
number of threads.

``build_patches`` makes them of metapixels; ``patches_of_weights`` of the weights of any other model of a projector
pixel, so that studies can solve with it as with metapixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numba
import numpy as np
import numpy.typing as npt
import scipy.sparse as sp
from numba import prange

from controller.core.arrays import Float64, FloatImage
from controller.core.errors import UsageError
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


MOST_BYTES: Final = 8 << 30
"""Limit of memory for the boxes and the products; above it the machine would hang."""


def patches_of_weights(weights: Sequence[sp.csr_matrix[np.float64]], camera_shape: tuple[int, int]) -> Patches:
    """Patches for ``build_transport``: one matrix a projector, (camera pixels, projector pixels), in [0, 1].

    The box around a projector pixel's weights is stored whole, and products keep room for the largest box beside each
    tile: one projector pixel that lights much of the image makes all products slower.

    Raises UsageError("weights-wrong", "weights-too-wide").
    """
    pixels = camera_shape[0] * camera_shape[1]
    if not weights or any(
        w.shape[0] != pixels or (w.nnz and not 0 <= w.data.min() <= w.data.max() <= 1) for w in weights
    ):
        raise UsageError(
            "weights-wrong",
            what=f"The weights are not numbers from 0 to 1 with one row for each of {pixels} camera pixels.",
            remedy="Compute them for the camera image of this calibration.",
        )
    whole = sp.csc_matrix(sp.hstack(list(weights), format="csc"))
    whole.eliminate_zeros()
    indices, indptr = whole.indices.astype(np.int64), whole.indptr.astype(np.int64)
    row, column, rows, groups = _boxes_of_weights(indices, indptr, camera_shape[1])
    cells = rows.astype(np.int64) * groups
    margin = np.array([rows.max(initial=0), int(groups.max(initial=0)) * LANES], np.int64)
    _check_size(int(cells.sum()), margin)
    if max(rows.max(initial=0), groups.max(initial=0)) <= np.iinfo(np.uint8).max:
        # as metapixels have them, so that products are compiled once
        rows, groups = rows.astype(np.uint8), groups.astype(np.uint8)
    first = np.zeros(rows.size, np.int64)
    np.cumsum(cells[:-1], out=first[1:])
    values = np.zeros(int(cells.sum()) * LANES, Weight)
    _fill_weights(
        indices, indptr, whole.data.astype(np.float64), camera_shape[1], (row, column, rows, groups), first, values
    )
    start = np.cumsum([0, *(w.shape[1] for w in weights)]).astype(np.int64)
    shape = np.array(camera_shape, np.int64)
    members, tile_first = tile_lists(row, column, rows, groups, start, shape)
    return Patches(values, first.astype(np.int32), row, column, rows, groups, start, members, tile_first, shape, margin)


def _check_size(cells: int, margin: npt.NDArray[np.int64]) -> None:
    """Raise UsageError("weights-too-wide") if ``cells`` groups of weights and the products' tiles need too much."""
    tile_px = (TILE_ROWS + 2 * int(margin[0])) * (TILE_COLUMNS + 2 * int(margin[1]))
    needed = cells * LANES * np.dtype(Weight).itemsize + numba.get_num_threads() * tile_px * 3 * 4
    if needed > MOST_BYTES:
        raise UsageError(
            "weights-too-wide",
            what=f"The weights of projector pixels span up to {margin[0]} x {margin[1]} camera pixels, and would take "
            f"{needed / 1e9:.0f} GB of memory.",
            remedy="Remove weights far from a projector pixel's position, or use a smaller camera image.",
        )


Extent = npt.NDArray[np.uint8] | npt.NDArray[np.uint16]
Boxes = tuple[npt.NDArray[np.int16], npt.NDArray[np.int16], Extent, Extent]


@compiled()
def _boxes_of_weights(indices: npt.NDArray[np.int64], indptr: npt.NDArray[np.int64], width: int) -> Boxes:
    count = indptr.size - 1
    row, column = np.zeros(count, np.int16), np.zeros(count, np.int16)
    rows, groups = np.zeros(count, np.uint16), np.zeros(count, np.uint16)
    for v in range(count):
        if indptr[v] == indptr[v + 1]:
            continue
        mine = indices[indptr[v] : indptr[v + 1]]
        down, across = mine // width, mine % width
        top, left = down.min(), across.min()
        row[v], column[v], rows[v] = top, left, down.max() - top + 1
        groups[v] = (across.max() - left) // LANES + 1
    return row, column, rows, groups


@compiled()
def _fill_weights(
    indices: npt.NDArray[np.int64],
    indptr: npt.NDArray[np.int64],
    data: Float64,
    width: int,
    boxes: Boxes,
    first: npt.NDArray[np.int64],
    values: npt.NDArray[np.uint16],
) -> None:
    row, column, rows, groups = boxes
    for v in range(rows.size):
        if rows[v] == 0:
            continue
        for k in range(indptr[v], indptr[v + 1]):
            y, x = indices[k] // width - row[v], indices[k] % width - column[v]
            at = (first[v] + y * groups[v]) * LANES + x
            values[at] = np.uint16(data[k] * FULL_WEIGHT + 0.5)
