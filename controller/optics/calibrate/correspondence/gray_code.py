"""Codes to cells: which cell of the projector's frame each camera pixel looks at."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
import numpy.typing as npt

from controller.core.arrays import FloatImage, Mask
from controller.core.channels import finite
from controller.core.jit import compiled
from controller.optics.calibrate.correspondence.captures import Captures, grey
from controller.optics.capture.patterns import CELL_PX, PatternPlan

WEAK_BIT = 0.25
"""Of half the white's light: nearer to the threshold, a bit is not reliable."""


@dataclass(frozen=True, slots=True)
class Cells:
    """One coordinate of the cells.

    ``cell`` (rows, columns) int32 from 0; ``weak`` (rows, columns) uint8: bits near the threshold, of which there is at
    most one where a single cell border is seen
    """

    cell: npt.NDArray[np.int32]
    weak: npt.NDArray[np.uint8]

    @property
    def sure(self) -> Mask:
        """Where the cell is right or one off."""
        return np.asarray(self.weak <= 1)

    def middle_px(self) -> FloatImage:
        """(rows, columns) float32: the middle of the cell, projector px."""
        middle = self.cell.astype(np.float32)
        middle *= CELL_PX
        middle += (CELL_PX - 1) / 2
        return middle


def known_cells(known_px: FloatImage) -> tuple[Cells, Cells]:
    """The cells of x and y of a map from before: (rows, columns, 2), NaN where it tells nothing."""
    weak = np.where(finite(known_px), 0, 2).astype(np.uint8)
    with np.errstate(invalid="ignore"):
        cell = np.floor((np.nan_to_num(known_px) + 0.5) / CELL_PX).astype(np.int32)
    return tuple(Cells(np.ascontiguousarray(cell[..., axis]), weak) for axis in range(2))  # type: ignore[return-value]


def decode_cells(captures: Captures, plan: PatternPlan, axis: int, threshold: FloatImage, half: FloatImage) -> Cells:
    """Decode the bits of one axis (0 x, 1 y).

    Parameters
    ----------
    captures : needs ``gray-*`` of the axis
    threshold : (rows, columns) light between a lit and an unlit cell's
    half : (rows, columns) half of the difference between those two

    Raises CalibrationError("capture-missing") or CalibrationError("capture-shape-wrong").
    """
    cell = np.zeros(threshold.shape, np.int32)
    bit = np.zeros(threshold.shape, np.bool_)
    weak = np.zeros(threshold.shape, np.uint8)
    for pattern in plan.gray(axis):
        _add_bit(grey(captures, pattern.name, threshold.shape), threshold, half, bit, cell, weak)
    return Cells(cell, weak)


@compiled(parallel=True)
def _add_bit(
    image: FloatImage,
    threshold: FloatImage,
    half: FloatImage,
    bit: Mask,
    cell: npt.NDArray[np.int32],
    weak: npt.NDArray[np.uint8],
) -> None:
    for row in numba.prange(image.shape[0]):
        for column in range(image.shape[1]):
            above = image[row, column] - threshold[row, column]
            bit[row, column] ^= above > 0
            cell[row, column] = 2 * cell[row, column] + bit[row, column]
            if not abs(above) >= WEAK_BIT * abs(half[row, column]):  # not a number is weak
                weak[row, column] += 1
