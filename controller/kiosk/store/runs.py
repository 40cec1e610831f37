"""What past runs left for the panel: grades, pictures and figures."""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from typing import Final

from controller.artefacts.comparison import all_compared, history_of, pictures_of
from controller.artefacts.grade import BEFORE, PICTURE, RESOLUTION, graded, passes, worst_letter, worst_of
from controller.artefacts.names import REPORT_PAGE, run_kind
from controller.core.errors import UsageError, VelaturaError
from controller.kiosk.interface import Achieved, Comparison, Grade, Results
from controller.stage.calibrations import finished_calibrations
from controller.stage.check import Checked

MOST: Final = 50
_NAME: Final = re.compile(r"[0-9]{8}-[0-9]{6}-[a-z]+")
_PICTURES: Final = {"before": BEFORE, "resolution": RESOLUTION}
_UNREADABLE: Final = (OSError, ValueError, KeyError, TypeError, AttributeError)
"""What reading a file of figures raises that is damaged, or that is being removed."""


def grades(stage: Path, worst_grade: float) -> tuple[Grade, ...]:
    """Of every graded run, newest first. Without those that can't be read: the kiosk asks for this while it plays."""
    try:
        finished = {run.name for run in finished_calibrations(stage)}
    except (VelaturaError, OSError):
        finished = set()
    errors = _errors(stage)
    found = []
    ours = (run for run in (stage / "runs").glob("*") if _NAME.fullmatch(run.name))
    for run in sorted(ours, reverse=True)[:MOST]:
        try:
            grade = _grade(run, run.name in finished, worst_grade, errors.get(run.name))
        except _UNREADABLE:
            continue
        found += [] if grade is None else [grade]
    return tuple(found)


def _grade(run: Path, finished: bool, worst_grade: float, delta_e: float | None) -> Grade | None:
    if (worst := worst_of(run)) is None:
        return None
    note = f"{worst[0]} is predicted with {worst[1]:.1f} % error"
    kept = finished and passes(run, worst_grade)
    return Grade(run.name, began_s(run.name), run_kind(run), worst_letter(run), kept, delta_e, note)


def began_s(run: str) -> float:
    """Unix seconds of the beginning, as the folder's name tells in local time; 0 for another name."""
    try:
        return datetime.strptime(run[:15], "%Y%m%d-%H%M%S").astimezone().timestamp()
    except (ValueError, OverflowError):
        return 0.0


def names(stage: Path) -> tuple[str, ...]:
    """Runs that have something to show, newest first."""
    found = [run.name for run in (stage / "runs").glob("*") if _NAME.fullmatch(run.name) and _is_graded(run)]
    return tuple(sorted(found, reverse=True)[:MOST])


def _is_graded(run: Path) -> bool:
    try:
        return graded(run) is not None
    except _UNREADABLE:
        return False


def report(stage: Path, run: str, checked: Checked) -> Path:
    """The run's report.html, made if it is not there yet. Seconds. Raises UsageError("run-unknown")."""
    if run in [folder.name for folder in all_compared(stage)]:
        return _comparison_report(stage / "runs" / run, checked)
    folder = _folder(stage, run)
    page = folder / REPORT_PAGE
    if not page.exists():
        from controller.services.report import calibration_report

        calibration_report(folder, checked)
    return page


def _comparison_report(folder: Path, checked: Checked) -> Path:
    page = folder / REPORT_PAGE
    if page.exists():
        return page
    from controller.services.compare import comparison_report

    return comparison_report(folder, checked)


def comparisons(stage: Path, appearances: Sequence[str]) -> tuple[Comparison, ...]:
    """What these appearances achieved, in their order; without those that nobody photographed."""
    found = []
    for name, known in history_of(stage, appearances).items():
        rows = [
            Achieved(
                one.run, one.photographed_unix_s, one.delta_e00_median, one.delta_e00_p95, one.rmse,
                one.sharpness_lambda,
            )
            for one in reversed(known)
        ]  # fmt: skip
        found.append(Comparison(name, tuple(rows), pictures_of(stage, known[-1])))
    return tuple(found)


def _errors(stage: Path) -> dict[str, float]:
    """By calibration, the largest of the newest median colour differences of its appearances."""
    newest: dict[str, dict[str, float]] = {}
    try:
        compared = all_compared(stage)
    except OSError:
        # A run was removed between two looks.
        return {}
    for known in compared.values():
        for one in known:
            newest.setdefault(one.calibration, {})[one.name] = one.delta_e00_median
    return {calibration: max(medians.values()) for calibration, medians in newest.items()}


def _folder(stage: Path, run: str) -> Path:
    if run not in names(stage):
        raise UsageError(
            "run-unknown", what=f"There is no run {run[:80]!r} with results.", remedy="Choose another one."
        )
    return stage / "runs" / run


def results(stage: Path, run: str, worst_grade: float) -> Results:
    """Raises UsageError("run-unknown")."""
    folder = _folder(stage, run)
    pictures = {"error": folder / PICTURE} if (folder / PICTURE).exists() else {}
    for name, file in _PICTURES.items():
        if (folder / file).exists():
            pictures[name] = folder / file
    figures = [(f"Error of {name}", f"{percent:.2f} %") for name, percent in (graded(folder) or {}).items()]
    grade = next((one for one in grades(stage, worst_grade) if one.run == run), None)
    return Results(run, grade, pictures, tuple(figures))
