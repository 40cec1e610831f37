"""Grades, pictures and figures of past runs, for the panel."""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from typing import Final

from controller.core.errors import UsageError, VelaturaError
from controller.kiosk.state import DriftCheck, Grade
from controller.kiosk.values import Achieved, Comparison, Results
from controller.stage.artefacts.comparison import Compared, all_compared, history_of, pictures_of
from controller.stage.artefacts.grade import (
    BEFORE,
    PICTURE,
    RESOLUTION,
    errors_by_view,
    graded,
    passes,
    worst_letter,
    worst_of,
    worst_view,
)
from controller.stage.artefacts.kinds import StepKind
from controller.stage.artefacts.names import REPORT_PAGE, json_path, read_json, run_kind
from controller.stage.artefacts.views import view_folders
from controller.stage.sessions.calibrations import finished_calibrations
from controller.stage.sessions.check import Checked

MOST: Final = 50
_NAME: Final = re.compile(r"[0-9]{8}-[0-9]{6}-[a-z]+")
_PICTURES: Final = {"before": BEFORE, "resolution": RESOLUTION}
_UNREADABLE: Final = (OSError, ValueError, KeyError, TypeError, AttributeError)
"""Errors of reading a figures file that is damaged or just being removed."""


def grades(stage: Path, worst_grade: float) -> tuple[Grade, ...]:
    """The grades of all graded runs that can be read, newest first."""
    try:
        finished = {run.name for run in finished_calibrations(stage)}
    except (VelaturaError, OSError):
        finished = set()
    errors = _errors(stage)
    result = []
    candidates = (run for run in (stage / "runs").glob("*") if _NAME.fullmatch(run.name))
    for run in sorted(candidates, reverse=True)[:MOST]:
        try:
            grade = _grade(run, run.name in finished, worst_grade, errors.get(run.name))
        except _UNREADABLE:
            continue
        result += [] if grade is None else [grade]
    return tuple(result)


def _grade(run: Path, finished: bool, worst_grade: float, delta_e: float | None) -> Grade | None:
    if (worst := worst_of(run)) is None:
        return None
    note = f"Largest predicted error: {worst[1]:.1f} % in {worst[0]}"
    kept = finished and passes(run, worst_grade)
    return Grade(run.name, began_s(run.name), run_kind(run), worst_letter(run), kept, delta_e, note, worst[1])


def drifts(stage: Path) -> tuple[DriftCheck, ...]:
    """The drift checks that can be read, newest first."""
    result = []
    for run in sorted((stage / "runs").glob("*-drift"), reverse=True)[:MOST]:
        try:
            found = read_json(json_path(run, StepKind.DRIFT))
            camera = found["camera"]
            moved = float(camera["rms_px"]) if camera["found"] else None
            skew = read_json(path) if (path := json_path(run, StepKind.SKEW)).exists() else {}
            apart = skew.get("apart_s"), skew.get("uncertain_s")
            result.append(DriftCheck(run.name, began_s(run.name), str(found["advice"]), moved, *apart))
        except _UNREADABLE:
            continue
    return tuple(result)


def began_s(run: str) -> float:
    """Unix seconds of the run's beginning, from the local time in the folder's name; 0 for another name."""
    try:
        return datetime.strptime(run[:15], "%Y%m%d-%H%M%S").astimezone().timestamp()
    except (ValueError, OverflowError):
        return 0.0


def names(stage: Path) -> tuple[str, ...]:
    """Runs with results, newest first."""
    graded_runs = [run.name for run in (stage / "runs").glob("*") if _NAME.fullmatch(run.name) and _is_graded(run)]
    return tuple(sorted(graded_runs, reverse=True)[:MOST])


def _is_graded(run: Path) -> bool:
    try:
        return graded(run) is not None
    except _UNREADABLE:
        return False


def report(stage: Path, run: str, checked: Checked) -> Path:
    """The run's report.html. Seconds if it must be made first. Raises UsageError("run-unknown")."""
    if run in [folder.name for folder in all_compared(stage)]:
        return _comparison_report(stage / "runs" / run, checked)
    folder = _folder(stage, run)
    page = folder / REPORT_PAGE
    if not page.exists():
        from controller.stage.services.report import calibration_report

        calibration_report(folder, checked)
    return page


def _comparison_report(folder: Path, checked: Checked) -> Path:
    page = folder / REPORT_PAGE
    if page.exists():
        return page
    from controller.stage.services.compare import comparison_report

    return comparison_report(folder, checked)


def comparisons(stage: Path, appearances: Sequence[str]) -> tuple[Comparison, ...]:
    """The comparisons of the photographed ones of these appearances, in their order."""
    result = []
    for name, history in history_of(stage, appearances).items():
        rows = [_achieved(row) for row in reversed(history)]
        result.append(Comparison(name, tuple(rows), pictures_of(stage, history[-1])))
    return tuple(result)


def _achieved(row: Compared) -> Achieved:
    """The whole visible object first: an appearance of which little is in reach must not look well."""
    median, p95 = row.headline
    inside, share = None, None
    if row.whole is not None:
        found = row.pixels.get("in_reach", {})
        inside, share = found.get("delta_e00_median"), 1 - found.get("left_out_share", 1.0)
    aimed = None if row.adapted is None else row.adapted.get("delta_e00_median")
    return Achieved(
        row.run, row.photographed_unix_s, median, p95, row.rmse, row.sharpness_lambda, inside, share, aimed,
        row.held_back,
    )  # fmt: skip


def _errors(stage: Path) -> dict[str, float]:
    """For each calibration, the largest of the newest median colour differences of its appearances."""
    newest: dict[str, dict[str, float]] = {}
    try:
        compared = all_compared(stage)
    except OSError:
        # A run was removed in the meantime.
        return {}
    for rows in compared.values():
        for row in rows:
            newest.setdefault(row.calibration, {})[row.name] = row.headline[0]
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
    views = view_folders(folder)
    worst = worst_view(folder)[1] / PICTURE
    pictures = {"error": worst} if worst.exists() else {}
    for name, file in _PICTURES.items():
        if (folder / file).exists():
            pictures[name] = folder / file
    figures = [
        (f"Error of {name}" + (f" in view {view}" if len(views) > 1 else ""), f"{percent:.2f} %")
        for view, errors in errors_by_view(folder).items()
        for name, percent in errors.items()
    ]
    grade = next((grade for grade in grades(stage, worst_grade) if grade.run == run), None)
    return Results(run, grade, pictures, tuple(figures))
