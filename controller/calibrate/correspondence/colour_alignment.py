"""Whether a projector's red, green and blue pictures lie on each other: by the phases of the fine sinusoids.

The camera's channels see mixtures of the three, so they are separated first. Distortion and colour fringes of the
camera move all three alike, or outwards in all directions, and do not change a median. How far medians of parts of the
picture differ says how sure the whole picture's is.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from controller.calibrate.correspondence.captures import Captures, coloured
from controller.calibrate.correspondence.phase_shift import FRINGE_PX
from controller.capture.patterns import PatternPlan
from controller.core.arrays import Float64, FloatImage
from controller.core.channels import smallest

FINE: Final = ("blur-x", "blur-y")
LEAST_CONTRAST: Final = 0.25
FAINTEST: Final = 0.02
"""Of the 99th percentile of white."""
FEWEST_PIXELS: Final = 500
SOME_PIXELS: Final = 200_000
NAMED_PX: Final = 0.1
"""A colour that lies so many pixels beside green is named; it is measured to a hundredth."""
COLOURS: Final = ("red", "green", "blue")
PARTS: Final = 16
LEAST_PX: Final = 0.02
"""Smaller shifts are not corrected: a place is not known better."""
MOST_PX: Final = 1.5
"""Phases repeat after 5 px: a larger shift might as well be one of 3.5 px the other way."""
SURE: Final = 4.0
"""Standard errors that a shift needs to be corrected."""


@dataclass(frozen=True, slots=True, eq=False)
class ColourShifts:
    """``px`` (3, 2): by how many projector pixels red, green and blue lie to the right of green, and below it.

    ``error_px`` (3, 2): the standard error of each; both NaN where too little was seen
    """

    px: Float64
    error_px: Float64

    @property
    def sure_px(self) -> Float64 | None:
        """(3, 2): what to correct, 0 where nothing was seen; None where nothing is beyond doubt, or too much."""
        if np.nanmax(np.abs(self.px), initial=0) > MOST_PX:
            return None
        sure = np.abs(self.px) > np.maximum(SURE * self.error_px, LEAST_PX)
        return np.nan_to_num(self.px) if sure.any() else None


def colour_shifts(captures: Captures, plan: PatternPlan, white: FloatImage, mixing: Float64) -> ColourShifts:
    """How far the colours of a projector lie apart.

    Parameters
    ----------
    captures : linear photographs in one unit; needs ``black``, ``blur-x-*`` and ``blur-y-*``
    white : (rows, columns, 3) less the black image, NaN where not known
    mixing : (3, 3) camera channel by projector channel, rows adding up to 1

    Raises CalibrationError as ``coloured``.
    """
    black = coloured(captures, "black", white.shape[:2])
    bright = np.nanpercentile(smallest(white), 99)
    found, errors = np.full((3, 2), np.nan), np.full((3, 2), np.nan)
    for axis, prefix in enumerate(FINE):
        steps = plan.sinusoids(prefix)
        at = np.flatnonzero(smallest(white) > FAINTEST * bright)
        at = at[:: max(1, at.size // SOME_PIXELS)]
        seen = np.zeros((at.size, 3), np.complex128)
        for step in steps:
            image = (coloured(captures, step.name, white.shape[:2]) - black).reshape(-1, 3)[at]
            seen += (2 / len(steps)) * np.exp(-1j * step.phase_rad) * image
        own = np.linalg.solve(mixing, (2 * seen / white.reshape(-1, 3)[at]).T).T
        # what is not a number in one of the steps is left out, too
        own = own[(np.abs(own) > LEAST_CONTRAST).all(axis=1)]
        if len(own) >= FEWEST_PIXELS:
            apart = np.angle(own * np.conj(own[:, 1:2])) * FRINGE_PX / (2 * np.pi)
            found[:, axis] = np.median(apart, axis=0)
            parts = [np.median(part, axis=0) for part in np.array_split(apart, PARTS)]
            errors[:, axis] = np.std(parts, axis=0, ddof=1) / np.sqrt(PARTS)
    return ColourShifts(found, errors)


def misaligned(name: str, shifts: ColourShifts) -> str | None:
    """What a technician should know; None where the colours lie on each other."""
    parts = [
        f"{colour} by {x:+.1f} pixels across and {y:+.1f} down"
        for colour, (x, y) in zip(COLOURS, np.nan_to_num(shifts.px), strict=True)
        if np.hypot(x, y) > NAMED_PX
    ]
    if not parts:
        return None
    return (
        f"The colours of projector {name} do not lie on each other: {' and '.join(parts)} from green. What is solved "
        "takes that into account, but detail of single pixels keeps coloured edges. To avoid them, align its panels in "
        "its menu (often called panel alignment, convergence or registration), and calibrate again."
    )
