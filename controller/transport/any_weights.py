"""Patches from weights of any model of a projector pixel, so that studies can solve with it as with metapixels."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from controller.arrays import Float64
from controller.compiled import compiled
from controller.errors import UsageError
from controller.transport.lanes import LANES
from controller.transport.patches import FULL_WEIGHT, LARGEST_PX, Patches, Weight, tile_lists


def patches_of_weights(weights: Sequence[sp.csr_matrix[np.float64]], camera_shape: tuple[int, int]) -> Patches:
    """Patches for ``LightTransport.build``: one matrix a projector, (camera pixels, projector pixels), in [0, 1].

    Projector pixels whose weights span more than 255 camera pixels light nothing. Raises UsageError("weights-wrong").
    """
    pixels = camera_shape[0] * camera_shape[1]
    if not weights or any(
        w.shape[0] != pixels or (w.nnz and not 0 <= w.data.min() <= w.data.max() <= 1) for w in weights
    ):
        raise UsageError(
            "weights-wrong",
            what=f"The weights are not numbers from 0 to 1 with one row for each of {pixels} camera pixels.",
            remedy="Make them for the camera image of this calibration.",
        )
    whole = sp.csc_matrix(sp.hstack(list(weights), format="csc"))
    whole.eliminate_zeros()
    indices, indptr = whole.indices.astype(np.int64), whole.indptr.astype(np.int64)
    row, column, rows, groups = _boxes(indices, indptr, camera_shape[1])
    first = np.zeros(rows.size, np.int64)
    np.cumsum((rows.astype(np.int64) * groups)[:-1], out=first[1:])
    values = np.zeros(int((rows.astype(np.int64) * groups).sum()) * LANES, Weight)
    _fill(indices, indptr, whole.data.astype(np.float64), camera_shape[1], (row, column, rows, groups), first, values)
    start = np.cumsum([0, *(w.shape[1] for w in weights)]).astype(np.int64)
    shape = np.array(camera_shape, np.int64)
    margin = np.array([rows.max(initial=0), groups.max(initial=0) * LANES], np.int64)
    members, tile_first = tile_lists(row, column, rows, groups, start, shape)
    return Patches(values, first.astype(np.int32), row, column, rows, groups, start, members, tile_first, shape, margin)


Boxes = tuple[npt.NDArray[np.int16], npt.NDArray[np.int16], npt.NDArray[np.uint8], npt.NDArray[np.uint8]]


@compiled()
def _boxes(indices: npt.NDArray[np.int64], indptr: npt.NDArray[np.int64], width: int) -> Boxes:
    count = indptr.size - 1
    row, column = np.zeros(count, np.int16), np.zeros(count, np.int16)
    rows, groups = np.zeros(count, np.uint8), np.zeros(count, np.uint8)
    for v in range(count):
        if indptr[v] == indptr[v + 1]:
            continue
        mine = indices[indptr[v] : indptr[v + 1]]
        down, across = mine // width, mine % width
        top, left = down.min(), across.min()
        high, wide = down.max() - top + 1, across.max() - left + 1
        if high < LARGEST_PX and wide < LARGEST_PX - LANES:
            row[v], column[v], rows[v], groups[v] = top, left, high, (wide + LANES - 1) // LANES
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
