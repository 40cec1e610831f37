"""Reports of finished runs: of a demo, of a calibration, or of photographs of appearances."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from controller.core.errors import UsageError
from controller.stage.artefacts.comparison import COMPARE
from controller.stage.artefacts.grade import read_grade_figures
from controller.stage.artefacts.names import REPORT_FIGURES, run_kind
from controller.stage.report.calibration import StageDescription, graded_runs, write_calibration_report
from controller.stage.sessions.calibrations import worst_grade
from controller.stage.sessions.check import Checked, check_stage, time_zone


def report_of(where: Path, out: Path | None) -> Mapping[str, str]:
    """Write the report of a run's folder, or of a stage's newest graded calibration, into ``out`` or the run's folder.

    Raises UsageError("run-not-graded", "nothing-graded", "run-not-compared") and as ``check_stage`` and
    ``report.demo.report_again``.
    """
    run = newest_graded(where) if (where / "stage.toml").exists() else where
    if run_kind(run) == "demo":
        from controller.stage.report.demo import report_again

        return report_again(run, run if out is None else out)
    if run_kind(run) == COMPARE:
        from controller.stage.services.compare import comparison_report

        compared = comparison_report(run, check_stage(run.resolve().parent.parent), out)
        return {"report": str(compared), "figures": str(compared.with_name(REPORT_FIGURES))}
    html = calibration_report(run, check_stage(run.resolve().parent.parent), out)
    return {"report": str(html), "figures": str(html.with_name(REPORT_FIGURES))}


def calibration_report(run: Path, checked: Checked, out: Path | None = None) -> Path:
    """As ``write_calibration_report``, for a run of this stage, with the projectors that the run had."""
    names = tuple(read_grade_figures(run)) or checked.names
    asked = StageDescription(checked.stage.tables.stage.name, names, worst_grade(checked), time_zone(checked))
    return write_calibration_report(run, asked, out)


def newest_graded(stage: Path) -> Path:
    """Raises UsageError("nothing-graded")."""
    found = graded_runs(stage / "runs")
    if not found:
        raise UsageError("nothing-graded", what="This stage has no graded calibration yet.",
                         remedy="Run `velatura calibrate` first.")  # fmt: skip
    return found[-1]
