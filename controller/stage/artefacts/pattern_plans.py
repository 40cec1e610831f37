"""Which patterns a projector is photographed with: the choice of the person, and the plan that was used."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final, Literal, Self, get_args

from controller.core.arrays import FloatImage
from controller.core.errors import CalibrationError, UsageError
from controller.optics.capture.patterns import Code, PatternPlan, plan_patterns
from controller.stage.artefacts.names import json_path, read_json, write_json
from controller.stage.artefacts.photographs import captured, codes_of, light_of
from controller.stage.artefacts.projectors import Pixels

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
    known = next((plan for plan in PHOTOGRAPHS if plan == name), None)
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


def photographs_sentence(run: Path, projectors: Sequence[str]) -> str:
    """For people: which plan each projector had, and how many photographs were kept of it."""
    parts = []
    for name in projectors:
        used, number = PlanUsed.read(run, name), patterns_figures(run, name)["photographs"]
        parts.append(f"{name} {number} ({_CODE_NAMES[used.code] if used.few else 'full'})")
    return ", ".join(parts)


_CODE_NAMES: Final = {Code.GRAY: "few, grey code", Code.COLOURS: "few", Code.KNOWN: "fewest"}


def known_map(run: Path, projector: str) -> FloatImage:
    """Where each camera pixel looked in a calibration's map, continued over small gaps; NaN where not known."""
    pixels = Pixels.read(run, projector)
    return pixels.projector_px if pixels.shown_px is None else pixels.shown_px
