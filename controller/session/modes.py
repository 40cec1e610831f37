"""How a calibration measured its metapixels, and which of a run's metapixels count."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal, get_args

from controller.arrays import load_arrays
from controller.calibrate.values import Metapixels
from controller.capture.dots import LEAST_SPACING_PX, PAPER_SPACING_PX
from controller.errors import UsageError
from controller.session.runner import Context, Step
from controller.storage import write_atomically

CalibrationMode = Literal["fast", "paper", "auto"]
MODES: Final[tuple[CalibrationMode, ...]] = get_args(CalibrationMode)
FILE: Final = "mode.json"
AUTO: Final = "auto"


@dataclass(frozen=True, slots=True)
class DotOptions:
    """``mode``; ``spacing_px``: the dots' spacing r in projector pixels, None: from the measured blur."""

    mode: CalibrationMode = "fast"
    spacing_px: int | None = PAPER_SPACING_PX

    def inputs(self) -> dict[str, str]:
        """What the steps depend on."""
        return {"mode": self.mode, "spacing_px": AUTO if self.spacing_px is None else str(self.spacing_px)}


def dot_options(mode: str, spacing: str | None) -> DotOptions:
    """Options from what a person typed; ``spacing`` is a number, "auto", or None for the mode's own.

    Raises UsageError("calibration-mode-unknown") or UsageError("dot-spacing-wrong").
    """
    known = next((name for name in MODES if name == mode), None)
    if known is None:
        raise UsageError(
            "calibration-mode-unknown",
            what=f"There is no way to calibrate called {mode}.",
            remedy=f"Choose one of {', '.join(MODES)}.",
        )
    if spacing is None:
        return DotOptions(known, PAPER_SPACING_PX if known == "paper" else None)
    if spacing == AUTO:
        return DotOptions(known, None)
    if not (spacing.isascii() and spacing.isdigit() and LEAST_SPACING_PX <= int(spacing) <= 64):
        raise UsageError(
            "dot-spacing-wrong",
            what=f"Dots can't be {spacing} pixels apart.",
            remedy=f'Give a whole number from {LEAST_SPACING_PX} to 64, or "{AUTO}" to choose it by the blur.',
        )
    return DotOptions(known, int(spacing))


def mode_step(options: DotOptions, after: Sequence[str]) -> Step:
    """The step that says in ``mode.json`` which metapixels count; a run may hold those of several modes."""

    def write(context: Context) -> Sequence[Path]:
        path = context.folder / FILE
        write_atomically(path, json.dumps(options.inputs(), indent=1).encode())
        return [path]

    return Step(
        "mode", write, inputs=options.inputs(), after=tuple(after), title="Choosing the metapixels", weight=0.01
    )


def mode_of(folder: Path) -> str:
    """The mode of a run; "fast" for one that does not tell."""
    path = folder / FILE
    return str(json.loads(path.read_text())["mode"]) if path.exists() else "fast"


def read_metapixels(folder: Path, projector: str) -> Metapixels:
    """The metapixels that count in a run: from dots in the paper's mode, else from the sinusoids."""
    name = "dots" if mode_of(folder) == "paper" else "pixels"
    arrays = load_arrays(folder / f"{name}-{projector}.npz")
    return Metapixels(arrays["centre_px"], arrays["covariance_px2"], arrays["valid"])
