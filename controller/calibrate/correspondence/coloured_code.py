"""Gray code with a bit in each colour: three bits in one photograph, where the paint is bright in all three colours.

The camera's channels see mixtures of the projector's colours. Which ones is not known yet when the code is read, but
the code tells it: nearly all bits are right by the strongest colour alone, and all bits together tell the mixture.
"""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
import numpy.typing as npt

from controller.calibrate.correspondence.captures import Captures, coloured, lit_pixels
from controller.calibrate.correspondence.gray_code import WEAK_BIT, Cells
from controller.capture.patterns import PatternKind, PatternPlan
from controller.capture.profile import CameraNoise
from controller.core.arrays import Float64, FloatImage

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
    with np.errstate(invalid="ignore", divide="ignore"):
        # where hardly anything comes back, one pixel's white may look like light by its noise, but not those around
        light = np.minimum(white, cv2.blur(np.nan_to_num(white), AROUND_PX))
        sigma = np.sqrt(np.float32(noise.shot) * np.maximum(white / 2, 0) + np.float32(noise.read**2)) / light
        # noise of the separated colours
        sigma[light <= 0] = np.inf
        spread = np.sqrt(np.square(sigma) @ np.square(separate).astype(np.float32).T)
    unsure = ~(spread < MOST_NOISE)
    del sigma, spread, light
    cell = [np.zeros(shape, np.int32) for _ in range(2)]
    weak = [np.zeros(shape, np.uint8) for _ in range(2)]
    bit = [np.zeros(shape, np.bool_) for _ in range(2)]
    for pattern in patterns:
        with np.errstate(invalid="ignore", divide="ignore"):
            seen = (coloured(captures, pattern.name, shape) - black) / white
            own = seen @ separate.astype(np.float32).T
        for channel, place in enumerate(pattern.coloured_bits):
            if place is None:
                continue
            axis = place[0]
            above = own[..., channel] - np.float32(0.5)
            bit[axis] ^= above > 0
            cell[axis] = 2 * cell[axis] + bit[axis]
            weak[axis] += ~(np.abs(above) >= WEAK_BIT / 2)
            # a bit near its threshold is a border of cells, of which there may be one; a dark colour tells nothing
            weak[axis] += np.uint8(2) * unsure[..., channel]
    return Cells(cell[0], weak[0]), Cells(cell[1], weak[1])


def _separation(captures: Captures, plan: PatternPlan, black: FloatImage, white: FloatImage) -> Float64:
    """(3, 3): from the camera's channels, of white, to the projector's own colours."""
    at = _some_lit(white)
    seen, shown = [], []
    for pattern in plan.of_kind(PatternKind.COLOUR_GRAY):
        image = coloured(captures, pattern.name, black.shape[:2]) - black
        seen.append(image.reshape(-1, 3)[at] / white.reshape(-1, 3)[at])
        shown.append(np.broadcast_to([place is not None for place in pattern.coloured_bits], (len(at), 3)))
    light, possible = np.concatenate(seen).astype(np.float64), np.concatenate(shown)
    usable = np.isfinite(light).all(axis=1)
    light, possible = light[usable], possible[usable]
    separate = np.eye(3)
    if len(light) < 10:
        return separate
    for _ in range(ROUNDS):
        bits = (light @ separate.T > 0.5) & possible
        mixing = np.linalg.lstsq(bits.astype(np.float64), light, rcond=None)[0].T
        if not np.isfinite(mixing).all() or abs(np.linalg.det(mixing)) < LEAST_INDEPENDENCE:
            return np.eye(3)
        separate = np.linalg.inv(mixing)
    return separate


def _some_lit(white: FloatImage) -> npt.NDArray[np.int64]:
    at = np.flatnonzero(lit_pixels(white))
    return np.asarray(at[:: max(1, at.size // SOME_PIXELS)], np.int64)
