"""Patches from weights of any model of a projector pixel, so that studies can solve with it as with metapixels."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numba
import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from controller.core.arrays import Float64
from controller.core.errors import UsageError
from controller.core.jit import compiled
from controller.optics.transport.gaussians.patches import (
    FULL_WEIGHT,
    TILE_COLUMNS,
    TILE_ROWS,
    Patches,
    Weight,
    tile_lists,
)
from controller.optics.transport.simd.gaussians import LANES

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
    row, column, rows, groups = _boxes(indices, indptr, camera_shape[1])
    cells = rows.astype(np.int64) * groups
    margin = np.array([rows.max(initial=0), int(groups.max(initial=0)) * LANES], np.int64)
    _check_size(int(cells.sum()), margin)
    if max(rows.max(initial=0), groups.max(initial=0)) <= np.iinfo(np.uint8).max:
        # as metapixels have them, so that products are compiled once
        rows, groups = rows.astype(np.uint8), groups.astype(np.uint8)
    first = np.zeros(rows.size, np.int64)
    np.cumsum(cells[:-1], out=first[1:])
    values = np.zeros(int(cells.sum()) * LANES, Weight)
    _fill(indices, indptr, whole.data.astype(np.float64), camera_shape[1], (row, column, rows, groups), first, values)
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
def _boxes(indices: npt.NDArray[np.int64], indptr: npt.NDArray[np.int64], width: int) -> Boxes:
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
def _fill(
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
