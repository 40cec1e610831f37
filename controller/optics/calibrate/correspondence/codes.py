"""The cells of a projector's frame, by whichever code its plan has."""

from __future__ import annotations

from controller.core.arrays import FloatImage
from controller.core.errors import CalibrationError
from controller.optics.calibrate.correspondence.captures import Captures
from controller.optics.calibrate.correspondence.coloured_code import decode_colours
from controller.optics.calibrate.correspondence.gray_code import Cells, decode_cells, known_cells
from controller.optics.capture.patterns import Code, PatternPlan
from controller.optics.capture.profile import CameraNoise


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
