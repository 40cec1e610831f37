"""Whether a projector's red, green and blue pictures lie on each other: by the phases of the fine sinusoids.

The camera's channels see mixtures of the three, so they are separated first. Distortion and colour fringes of the
camera move all three alike, or outwards in all directions, and do not change a median.
"""

from __future__ import annotations

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


def colour_shifts(captures: Captures, plan: PatternPlan, white: FloatImage, mixing: Float64) -> Float64:
    """(3, 2): by how many projector pixels red, green and blue lie to the right of green, and below it.

    Parameters
    ----------
    captures : linear photographs in one unit; needs ``black``, ``blur-x-*`` and ``blur-y-*``
    white : (rows, columns, 3) less the black image, NaN where not known
    mixing : (3, 3) camera channel by projector channel, rows adding up to 1

    Returns NaN where too little is seen. Raises CalibrationError as ``coloured``.
    """
    black = coloured(captures, "black", white.shape[:2])
    bright = np.nanpercentile(smallest(white), 99)
    found = np.full((3, 2), np.nan)
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
            turned = np.angle(own * np.conj(own[:, 1:2]))
            found[:, axis] = np.median(turned, axis=0) * FRINGE_PX / (2 * np.pi)
    return found


def misaligned(name: str, shifts: Float64) -> str | None:
    """What a technician should know of ``colour_shifts``; None where the colours lie on each other."""
    parts = [
        f"{colour} by {x:+.1f} pixels across and {y:+.1f} down"
        for colour, (x, y) in zip(COLOURS, np.nan_to_num(shifts), strict=True)
        if np.hypot(x, y) > NAMED_PX
    ]
    if not parts:
        return None
    return (
        f"The colours of projector {name} do not lie on each other: {' and '.join(parts)} from green. Align its panels "
        "in its menu (often called panel alignment, convergence or registration). Then calibrate again. If they can't "
        "be aligned, fine detail gets coloured edges."
    )
