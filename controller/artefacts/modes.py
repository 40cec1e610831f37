"""Calibration modes: how metapixels are measured, and which of a run's metapixels are used."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal, get_args

from controller.artefacts.kinds import StepKind
from controller.artefacts.names import json_path, read_json, write_json
from controller.artefacts.projectors import DotMetapixels, Pixels
from controller.calibrate.values import Metapixels
from controller.capture.dots import LEAST_SPACING_PX, PAPER_SPACING_PX
from controller.core.errors import UsageError
from controller.run.runner import Context, Step
from controller.run.step_id import StepId

CalibrationMode = Literal["fast", "paper", "auto"]
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
            what=f"There is no way to calibrate called {mode}.",
            remedy=f"Choose one of {', '.join(MODES)}.",
        )
    if spacing is not None and known == "fast":
        raise UsageError(
            "dot-spacing-unused",
            what="The mode fast shows no dots, so --dot-spacing has no effect.",
            remedy="Remove it, or add --mode auto or --mode paper.",
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
        return [write_json(json_path(context.folder, StepKind.MODE), options.inputs())]

    return Step(
        StepId(StepKind.MODE),
        write,
        inputs=options.inputs(),
        after=tuple(after),
        title="Choosing the metapixels",
        weight=0.01,
    )


def mode_of(folder: Path) -> str:
    """The mode of a run; "fast" if it is not stored."""
    path = json_path(folder, StepKind.MODE)
    return str(read_json(path)["mode"]) if path.exists() else "fast"


def read_metapixels(folder: Path, projector: str) -> Metapixels:
    """The metapixels that a run uses: from dots in the paper's mode, else from the sinusoids."""
    if mode_of(folder) == "paper":
        return DotMetapixels.read(folder, projector).metapixels
    return Pixels.read(folder, projector).metapixels
