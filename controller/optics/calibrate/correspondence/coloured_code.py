"""Gray code with a bit in each colour: three bits in one photograph, where the paint is bright in all three colours.

The camera's channels see mixtures of the projector's colours. Which ones is not known yet when the code is read, but
the code tells it: nearly all bits are right by the strongest colour alone, and all bits together tell the mixture.
"""

from __future__ import annotations

from typing import Final

import cv2
import numba
import numpy as np
import numpy.typing as npt

from controller.core.arrays import FloatImage
from controller.core.jit import compiled
from controller.optics.calibrate.correspondence.captures import Captures, coloured, lit_pixels
from controller.optics.calibrate.correspondence.gray_code import WEAK_BIT, Cells
from controller.optics.capture.patterns import PatternKind, PatternPlan
from controller.optics.capture.profile import CameraNoise

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
    found = np.empty(white.shape, np.bool_)
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
                found[row, column, c] = not np.sqrt(spread) < np.float32(MOST_NOISE)
    return found


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
                own = separate[c, 0] * seen[0] + separate[c, 1] * seen[1] + separate[c, 2] * seen[2]
                above = own - np.float32(0.5)
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
