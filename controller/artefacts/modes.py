"""Calibration modes: which photographs are taken, how metapixels are measured, and which of a run's are used."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final, Literal, Self, get_args

from controller.artefacts.kinds import StepKind
from controller.artefacts.names import json_path, read_json, write_json
from controller.artefacts.photographs import captured, codes_of, light_of
from controller.artefacts.projectors import DotMetapixels, Pixels
from controller.calibrate.values import Metapixels
from controller.capture.dots import LEAST_SPACING_PX, PAPER_SPACING_PX
from controller.capture.patterns import Code, PatternPlan, plan_patterns
from controller.core.arrays import FloatImage
from controller.core.errors import CalibrationError, UsageError
from controller.run.runner import Context, Step
from controller.run.step_id import StepId

CalibrationMode = Literal["fast", "paper", "auto"]
MODES: Final[tuple[CalibrationMode, ...]] = get_args(CalibrationMode)
AUTO: Final = "auto"

Photographs = Literal["full", "few", "fewest"]
PHOTOGRAPHS: Final[tuple[Photographs, ...]] = get_args(Photographs)
PATTERNS: Final = "patterns"
"""Kind of the file that says which patterns a projector was shown."""


@dataclass(frozen=True, slots=True)
class PhotographOptions:
    """``photographs``: which plan; ``last``: the run of the last calibration, from which ``fewest`` starts."""

    photographs: Photographs = "full"
    last: Path | None = None

    def inputs(self) -> dict[str, str]:
        """Inputs of the steps; none where all photographs are taken, as in runs from before there was a choice."""
        if self.photographs == "full":
            return {}
        last = self.last.name if self.photographs == "fewest" and self.last is not None else ""
        return {"photographs": self.photographs, "last": last}


def photographs_named(name: str) -> Photographs:
    """The choice of this name. Raises UsageError("photographs-unknown")."""
    known = next((one for one in PHOTOGRAPHS if one == name), None)
    if known is None:
        raise UsageError(
            "photographs-unknown",
            what=f"There is no set of photographs called {name[:64]!r}.",
            remedy=f"Choose one of {', '.join(PHOTOGRAPHS)}.",
        )
    return known


@dataclass(frozen=True, slots=True)
class PlanUsed:
    """``patterns-PROJECTOR.json``: which plan of patterns a projector was shown.

    ``known_from``: the run whose map stands for the code, "" for none; ``because``: why no fewer photographs were
    taken, one sentence, "" where none was needed
    """

    few: bool = False
    code: Code = Code.GRAY
    known_from: str = ""
    because: str = ""

    def plan(self, size_px: tuple[int, int]) -> PatternPlan:
        return plan_patterns(size_px, few=self.few, code=self.code)

    def known_px(self, run: Path, projector: str) -> FloatImage | None:
        """The earlier map, (rows, columns, 2) projector px; None where the plan has a code.

        Raises CalibrationError("map-missing") if the run that it is from was deleted meanwhile.
        """
        if self.code is not Code.KNOWN:
            return None
        try:
            return known_map(run.parent / self.known_from, projector)
        except UsageError as error:
            raise CalibrationError(
                "map-missing",
                what=f"The calibration {self.known_from}, from which that of {projector} started, can't be read.",
                remedy="Calibrate the projector again with --photographs few.",
            ) from error

    def write(self, run: Path, projector: str) -> Path:
        return write_json(json_path(run, PATTERNS, projector), asdict(self))

    @classmethod
    def read(cls, run: Path, projector: str) -> Self:
        """All photographs where a run does not say: it is from before there was a choice."""
        path = json_path(run, PATTERNS, projector)
        if not path.exists():
            return cls()
        row = read_json(path)
        return cls(bool(row["few"]), Code(row["code"]), str(row["known_from"]), str(row["because"]))


def patterns_figures(run: Path, projector: str) -> dict[str, Any]:
    """For report.json: the plan, and how many photographs of the projector alone are in use."""
    used = PlanUsed.read(run, projector)
    number = captured(run, light_of(projector)) + captured(run, codes_of(projector))
    return {"photographs": number, "few": used.few, "code": str(used.code), "because": used.because}


def told(run: Path, projectors: Sequence[str]) -> str:
    """For people: which plan each projector had, and how many photographs were kept of it."""
    parts = []
    for name in projectors:
        used, number = PlanUsed.read(run, name), patterns_figures(run, name)["photographs"]
        parts.append(f"{name} {number} ({CODES_TOLD[used.code] if used.few else 'full'})")
    return ", ".join(parts)


CODES_TOLD: Final = {Code.GRAY: "few, grey code", Code.COLOURS: "few", Code.KNOWN: "fewest"}


def known_map(run: Path, projector: str) -> FloatImage:
    """Where each camera pixel looked in a calibration's map, continued over small gaps; NaN where not known."""
    pixels = Pixels.read(run, projector)
    return pixels.projector_px if pixels.shown_px is None else pixels.shown_px


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
