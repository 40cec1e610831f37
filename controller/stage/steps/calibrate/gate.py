"""Whether a calibration's grade is good enough to publish; what its grade says, in words.

It imports little: what checks a stage needs this, but not the code that calibrates.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

from controller.core.errors import CalibrationError
from controller.run.progress import Reporter
from controller.run.runner import Context, Step
from controller.run.step_id import StepId
from controller.stage.artefacts.grade import (
    PICTURE,
    errors_by_view,
    passes,
    read_grade_figures,
    worst_letter,
    worst_of,
    worst_view,
    write_accepted,
)
from controller.stage.artefacts.views import view_folders
from hal.notices import Level

WORSE: Final = 1.25
"""Warn about a calibration this many times worse than the previous one, even if its grade is sufficient."""


def grade_figures(folder: Path) -> dict[str, str]:
    """For a command's result: the grade, each projector's error, and the error map."""
    texts = {
        name: ", ".join(f"{projector} {percent:.2f} %" for projector, percent in errors.items())
        for name, errors in errors_by_view(folder).items()
    }
    text = "; ".join(texts.values() if len(texts) == 1 else [f"view {name}: {one}" for name, one in texts.items()])
    return {"grade": worst_letter(folder), "error": text, "map": str(worst_view(folder)[1] / PICTURE)} if texts else {}


def accept(folder: Path, reporter: Reporter, worst_grade: float) -> None:
    """Accept a calibration below the limit, with a warning; no effect on one that passes."""
    worst = worst_of(folder)
    if worst is None or passes(folder, worst_grade):
        return
    write_accepted(folder, *worst)
    reporter.say(
        f"ACCEPTED ON REQUEST although it is below the set grade: {worst[0]} is predicted with {worst[1]:.1f} % error, "
        f"and {worst_grade:g} % is the limit. What is made from it will look wrong where {PICTURE} shows colour.",
        Level.WARNING,
    )


def below_grade(folder: Path, worst_grade: float) -> CalibrationError:
    """The error for a calibration below the limit."""
    name, percent = worst_of(folder) or ("", float("nan"))
    view, of_view = worst_view(folder)
    reasons = read_grade_figures(of_view)[name].get("reasons", [])
    seen = f" in view {view}" if len(view_folders(folder)) > 1 else ""
    because = f" {reasons[0]['sentence']}" if reasons else ""
    return CalibrationError(
        "calibration-below-grade",
        what=f"The calibration {folder.name} is not good enough to be published: projector {name} is predicted with "
        f"{percent:.1f} % error{seen}, and {worst_grade:g} % is the limit (worst_grade under [calibration]).{because}",
        remedy=f"Check {of_view / PICTURE}, correct the cause and calibrate again. To publish it anyway, use "
        "--accept-grade.",
    )


def gate_step(worst_grade: float, *, accepted: bool, reporter: Reporter | None = None) -> Step:
    """Refuse a calibration below the limit. Raises CalibrationError("calibration-below-grade")."""

    def run(context: Context) -> Sequence[Path]:
        require(context.folder, worst_grade, accepted=accepted, reporter=reporter or context.reporter)
        return ()

    return Step(StepId("gate"), run, title="Comparing the grade with the limit", weight=0.01, always=True)


def require(folder: Path, worst_grade: float, *, accepted: bool, reporter: Reporter) -> None:
    """The check itself. Raises CalibrationError("calibration-below-grade")."""
    if accepted:
        accept(folder, reporter, worst_grade)
    if not passes(folder, worst_grade):
        raise below_grade(folder, worst_grade)


def compare_with_last(folder: Path, last: Path | None, reporter: Reporter) -> None:
    """Warn if a new calibration is worse than the one that it replaces."""
    now, then = worst_of(folder), None if last is None else worst_of(last)
    if last is not None and now is not None and then is not None and now[1] > WORSE * then[1]:
        reporter.say(
            f"This calibration is worse than the last: {now[1]:.1f} % error ({now[0]}) against {then[1]:.1f} % "
            f"({then[0]}) in {last.name}. {PICTURE} in {folder.name} shows where.",
            Level.WARNING,
        )
