"""Gray code to cells: which cell of the projector's frame each camera pixel looks at."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from controller.arrays import FloatImage, Mask
from controller.calibrate.captures import Captures, grey
from controller.capture.patterns import PatternPlan

WEAK_BIT = 0.25
"""Of half the white's light: nearer to the threshold, a bit is not to be relied on."""


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
    limit = np.float32(WEAK_BIT) * np.abs(half)
    for pattern in plan.gray(axis):
        above = grey(captures, pattern.name, threshold.shape)
        above = above - threshold
        bit ^= above > 0
        cell = (cell << 1) | bit
        weak += ~(np.abs(above) >= limit)  # not a number is weak
    return Cells(cell, weak)
