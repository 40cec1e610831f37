"""Each camera site's window of projector pixels, and the order in which the products walk them.

A site of the camera (one colour of one pixel) sees the projector's image plane at a place phi, blurred by a Gaussian of
covariance S. Its light is shared out over the projector pixels around phi. A window is kept as parameters, 15 bytes
whatever its size; the shares come from tables (``profiles``). There are three sorts of windows: small and upright,
small and skewed, and any others, whose rows a skewed S shifts along x (docs/decisions/0006).

Windows are sorted by projector, colour and tile of the projector's image. Each such cell has a small buffer that stays
in the processor's near caches. Nothing is assumed about where neighbouring sites look: folds and occlusions are but
windows in other cells.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from controller.core.arrays import FloatImage
from controller.core.jit import compiled
from controller.optics.transport.windows.profiles import KINDS, SMALLEST_PX, STEP

TILE: Final = 64
NEAR: Final = 4
STRIP: Final = TILE + 2 * NEAR
"""Rows and columns that the small windows of a tile reach; see ``simd.small_windows``."""
MOST_SHEAR: Final = 1.2
"""With the widest profile, windows reach less than half a tile beyond their tile: those of a turn stay apart."""
LEAST_SHEAR: Final = 3
"""Steps up to this are taken as none, because windows without are faster."""
LEAST_INSIDE: Final = 0.05
"""A site with less than this share of its window inside the frame is not lit by it."""
BEYOND: Final = 2
UPRIGHT, SKEWED, OTHER = 0, 1, 2
SORTS: Final = 3


class Windows(NamedTuple):
    """The windows of all projectors, by cell and sort.

    ``site`` (windows,) int32: camera site; ``at`` uint16: first pixel in the cell's buffer, for small windows strip
    times STRIP plus row; ``across``, ``down`` uint16: the table's row for x and y, kind times phases plus position
    between two pixels; ``skew`` int8: how far each row is moved along x, for small windows what couples x and y
    ``gain`` float32: white light at the site over the sum of its shares; 0 in copies that fill a group up
    ``first`` (SORTS cells + 1,) int64: each cell's upright, skewed and other windows, the former two in whole groups
    ``place`` (cells, 4) int64: projector, colour, top, left of the tile
    ``turn`` (tiles,) int64: the tiles, each by its cell of the first colour, in the order in which products take them;
    ``turn_first`` int64: where those of a projector, band and turn begin, in this order; see ``windows.order``
    ``start`` (projectors + 1,) int64: first pixel of each projector; ``size`` (projectors, 2) int64: rows, columns
    ``cell_first`` (projectors + 1,) int64: each projector's cells; ``halo`` (1,) int64: of the buffers
    """

    site: npt.NDArray[np.int32]
    at: npt.NDArray[np.uint16]
    across: npt.NDArray[np.uint16]
    down: npt.NDArray[np.uint16]
    skew: npt.NDArray[np.int8]
    gain: FloatImage
    first: npt.NDArray[np.int64]
    place: npt.NDArray[np.int64]
    turn: npt.NDArray[np.int64]
    turn_first: npt.NDArray[np.int64]
    start: npt.NDArray[np.int64]
    size: npt.NDArray[np.int64]
    cell_first: npt.NDArray[np.int64]
    halo: npt.NDArray[np.int64]


@compiled()
def kind_of(variance: float) -> int:
    """The profile nearest to a variance, projector pixels squared."""
    kind = int(np.floor(0.5 * np.log(max(variance, 1e-6) / SMALLEST_PX**2) / np.log(STEP) + 0.5))
    return min(max(kind, 0), KINDS - 1)
