"""Calibration modes: how metapixels are measured, by sinusoids or by dots, and which of a run's are used."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal, get_args

from controller.core.errors import UsageError
from controller.optics.capture.patterns import LEAST_SPACING_PX, PAPER_SPACING_PX
from controller.run.runner import Context, Step
from controller.run.step_id import StepId
from controller.stage.artefacts.kinds import StepKind
from controller.stage.artefacts.projectors import write_mode

CalibrationMode = Literal["fast", "paper"]
MODES: Final[tuple[CalibrationMode, ...]] = get_args(CalibrationMode)
AUTO: Final = "auto"


@dataclass(frozen=True, slots=True)
class DotOptions:
    """``mode``; ``spacing_px``: the dots' spacing r in projector pixels, None: from the measured blur."""

    mode: CalibrationMode = "fast"
    spacing_px: int | None = PAPER_SPACING_PX

    def inputs(self) -> dict[str, str]:
        """Inputs of the steps."""
        return {"mode": self.mode, "spacing_px": AUTO if self.spacing_px is None else str(self.spacing_px)}


def dot_options(mode: str, spacing: str | None) -> DotOptions:
    """Options from the command line; ``spacing`` is a number, "auto", or None for the mode's default.

    Raises UsageError("calibration-mode-unknown", "dot-spacing-wrong" or "dot-spacing-unused").
    """
    known = next((name for name in MODES if name == mode), None)
    if known is None:
        raise UsageError(
            "calibration-mode-unknown",
            what=f"There is no calibration mode called {mode}.",
            remedy=f"Choose one of {', '.join(MODES)}.",
        )
    if spacing is not None and known == "fast":
        raise UsageError(
            "dot-spacing-unused",
            what="The mode fast shows no dots, so --dot-spacing has no effect.",
            remedy="Remove it, or add --mode paper.",
        )
    if spacing is None:
        return DotOptions(known, PAPER_SPACING_PX if known == "paper" else None)
    if spacing == AUTO:
        return DotOptions(known, None)
    if not (spacing.isascii() and spacing.isdigit() and LEAST_SPACING_PX <= int(spacing) <= 64):
        raise UsageError(
            "dot-spacing-wrong",
            what=f"Dots can't be {spacing} pixels apart.",
            remedy=f'Give a whole number from {LEAST_SPACING_PX} to 64, or "{AUTO}" to choose it from the blur.',
        )
    return DotOptions(known, int(spacing))


def mode_step(options: DotOptions, after: Sequence[StepId]) -> Step:
    """The step that writes to ``mode.json`` which metapixels are used; a run may hold those of several modes."""

    def write(context: Context) -> Sequence[Path]:
        return [write_mode(context.folder, options.inputs())]

    return Step(
        StepId(StepKind.MODE),
        write,
        inputs=options.inputs(),
        after=tuple(after),
        title="Choosing the metapixels",
        weight=0.01,
    )
