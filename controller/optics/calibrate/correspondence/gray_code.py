"""Codes to cells: which cell of the projector's frame each camera pixel looks at, by whichever code its plan has.

Few photographs are enough with a bit in each colour: three bits at once, where the paint is bright in all three
colours. The camera's channels see mixtures of the projector's colours. Which ones is not known yet when the code is
read, but the code tells it: nearly all bits are right by the strongest colour alone, and all bits together tell the
mixture.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import cv2
import numba
import numpy as np
import numpy.typing as npt

from controller.core.arrays import FloatImage, Mask
from controller.core.channels import finite
from controller.core.errors import CalibrationError
from controller.core.jit import compiled
from controller.optics.calibrate.correspondence.captures import Captures, coloured, grey, lit_pixels
from controller.optics.capture.patterns import CELL_PX, Code, PatternKind, PatternPlan
from controller.optics.capture.profile import CameraNoise

MOST_OUTSIDE = 0.02
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


def check_size(position_px: FloatImage, size_px: tuple[int, int]) -> None:
    """Refuse places (..., 2) in px of which many lie a cell or more outside of the projector's picture.

    Raises CalibrationError("projector-size-wrong").
    """
    if position_px.size and np.mean((position_px > np.array(size_px) + CELL_PX).any(axis=-1)) > MOST_OUTSIDE:
        x, y = np.percentile(position_px.reshape(-1, 2), 99, axis=0)
        raise CalibrationError(
            "projector-size-wrong",
            what=f"The code reaches to {x:.0f} and {y:.0f} px, but the projector has {size_px[0]}x{size_px[1]}.",
            remedy="Correct the projector's size: width first, then height, as its own picture has them.",
        )


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


SOME_PIXELS: Final = 20_000
ROUNDS: Final = 4
AROUND_PX: Final = (5, 5)
MOST_NOISE: Final = 0.12
"""Standard deviation of a bit, of the colour's own light: four of them lie between dark and the threshold."""
LEAST_INDEPENDENCE: Final = 0.02


def decode_colours(captures: Captures, plan: PatternPlan, noise: CameraNoise) -> tuple[Cells, Cells]:
    """The cells of x and y.

    Parameters
    ----------
    captures : needs ``black``, ``white`` and ``gray-rgb-*``, (rows, columns, 3)
    noise : of one sample, in the captures' unit

    Raises CalibrationError("capture-missing") or CalibrationError("capture-shape-wrong").
    """
    black = coloured(captures, "black")
    shape = black.shape[:2]
    white = coloured(captures, "white", shape) - black
    patterns = plan.of_kind(PatternKind.COLOUR_GRAY)
    separate = _separation(captures, plan, black, white)
    around = cv2.blur(np.nan_to_num(white), AROUND_PX)
    unsure = _unsure(white, around, np.float32(noise.shot), np.float32(noise.read**2), separate)
    del around
    cell, weak = np.zeros((2, *shape), np.int32), np.zeros((2, *shape), np.uint8)
    bit = np.zeros((2, *shape), np.bool_)
    for pattern in patterns:
        axes = np.array([-1 if place is None else place[0] for place in pattern.coloured_bits])
        _read_bits(coloured(captures, pattern.name, shape), black, white, separate, unsure, axes, bit, cell, weak)
    return Cells(cell[0], weak[0]), Cells(cell[1], weak[1])


@compiled(parallel=True)
def _unsure(
    white: FloatImage, around: FloatImage, shot: np.float32, read: np.float32, separate: FloatImage
) -> npt.NDArray[np.bool_]:
    """Where noise hides a colour's bits. ``around``: mean of white around each pixel; ``read``: noise squared.

    Where hardly anything comes back, one pixel's white may look like light by its noise, but not those around.
    """
    unsure = np.empty(white.shape, np.bool_)
    squares = separate * separate
    for row in numba.prange(white.shape[0]):
        variance = np.empty(3, np.float32)
        for column in range(white.shape[1]):
            for c in range(3):
                own = white[row, column, c]
                light = min(own, around[row, column, c])
                noise = shot * max(own / np.float32(2), np.float32(0)) + read
                variance[c] = noise / (light * light) if light > 0 else np.float32(np.inf)
            for c in range(3):
                spread = squares[c, 0] * variance[0] + squares[c, 1] * variance[1] + squares[c, 2] * variance[2]
                unsure[row, column, c] = not np.sqrt(spread) < np.float32(MOST_NOISE)
    return unsure


@compiled(parallel=True)
def _read_bits(
    image: FloatImage,
    black: FloatImage,
    white: FloatImage,
    separate: FloatImage,
    unsure: npt.NDArray[np.bool_],
    axes: npt.NDArray[np.int64],
    bit: npt.NDArray[np.bool_],
    cell: npt.NDArray[np.int32],
    weak: npt.NDArray[np.uint8],
) -> None:
    """Add the bits of one photograph to ``cell`` and ``weak`` (2, rows, columns); ``axes``: of each colour, or -1."""
    for row in numba.prange(image.shape[0]):
        seen = np.empty(3, np.float32)
        for column in range(image.shape[1]):
            for c in range(3):
                seen[c] = (image[row, column, c] - black[row, column, c]) / white[row, column, c]
            for c in range(3):
                axis = axes[c]
                if axis < 0:
                    continue
                colour = separate[c, 0] * seen[0] + separate[c, 1] * seen[1] + separate[c, 2] * seen[2]
                above = colour - np.float32(0.5)
                bit[axis, row, column] ^= above > 0
                cell[axis, row, column] = 2 * cell[axis, row, column] + bit[axis, row, column]
                # a bit near its threshold is a border of cells, of which there may be one; a dark colour tells nothing
                near = not abs(above) >= np.float32(WEAK_BIT / 2)
                weak[axis, row, column] += near + 2 * unsure[row, column, c]


def _separation(captures: Captures, plan: PatternPlan, black: FloatImage, white: FloatImage) -> FloatImage:
    """(3, 3): from the camera's channels, of white, to the projector's own colours."""
    at = _some_lit(white)
    seen, shown = [], []
    for pattern in plan.of_kind(PatternKind.COLOUR_GRAY):
        image = coloured(captures, pattern.name, black.shape[:2])
        seen.append((image.reshape(-1, 3)[at] - black.reshape(-1, 3)[at]) / white.reshape(-1, 3)[at])
        shown.append(np.broadcast_to([place is not None for place in pattern.coloured_bits], (len(at), 3)))
    light, possible = np.concatenate(seen).astype(np.float64), np.concatenate(shown)
    usable = np.isfinite(light).all(axis=1)
    light, possible = light[usable], possible[usable]
    separate = np.eye(3)
    if len(light) < 10:
        return separate.astype(np.float32)
    for _ in range(ROUNDS):
        bits = (light @ separate.T > 0.5) & possible
        mixing = np.linalg.lstsq(bits.astype(np.float64), light, rcond=None)[0].T
        if not np.isfinite(mixing).all() or abs(np.linalg.det(mixing)) < LEAST_INDEPENDENCE:
            return np.eye(3, dtype=np.float32)
        separate = np.linalg.inv(mixing)
    return separate.astype(np.float32)


def _some_lit(white: FloatImage) -> npt.NDArray[np.int64]:
    at = np.flatnonzero(lit_pixels(white))
    return np.asarray(at[:: max(1, at.size // SOME_PIXELS)], np.int64)


def read_code(
    captures: Captures,
    plan: PatternPlan,
    threshold: FloatImage,
    half: FloatImage,
    known_px: FloatImage | None,
    noise: CameraNoise,
) -> tuple[Cells, Cells]:
    """The cells of x and y, by the code that the plan has; parameters as ``decode_cells`` and ``decode``."""
    if plan.code is Code.COLOURS:
        return decode_colours(captures, plan, noise)
    if plan.code is Code.KNOWN:
        if known_px is None:
            raise CalibrationError(
                "map-missing",
                what="The plan shows no code, and no earlier map of the projector's pixels is given.",
                remedy="Give the earlier map, or use a plan with a code.",
            )
        return known_cells(known_px)
    return decode_cells(captures, plan, 0, threshold, half), decode_cells(captures, plan, 1, threshold, half)
