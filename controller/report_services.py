"""Reports of finished runs: of a demo, of a calibration, or of photographs of appearances."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from controller.calibrations import worst_grade
from controller.checking import Checked, check_stage
from controller.errors import UsageError
from controller.report.calibration import Asked, graded_runs, write_calibration_report
from controller.session.compared import SUFFIX


def report_of(where: Path, out: Path | None) -> Mapping[str, str]:
    """Write the report of a run's folder, or of a stage's newest graded calibration, into ``out`` or the run's folder.

    Raises UsageError("run-not-graded", "nothing-graded", "run-not-compared") and as ``check_stage`` and
    ``demo.report.report_again``.
    """
    run = newest_graded(where) if (where / "stage.toml").exists() else where
    if run.name.endswith("-demo"):
        from controller.demo.report import report_again

        return report_again(run, run if out is None else out)
    if run.name.endswith(SUFFIX):
        from controller.comparison_services import comparison_report

        compared = comparison_report(run, check_stage(run.resolve().parent.parent), out)
        return {"report": str(compared), "figures": str(compared.with_suffix(".json"))}
    html = calibration_report(run, check_stage(run.resolve().parent.parent), out)
    return {"report": str(html), "figures": str(html.with_suffix(".json"))}


def calibration_report(run: Path, checked: Checked, out: Path | None = None) -> Path:
    """As ``write_calibration_report``, for a run of this stage."""
    asked = Asked(checked.stage.tables.stage.name, checked.names, worst_grade(checked))
    return write_calibration_report(run, asked, out)


def newest_graded(stage: Path) -> Path:
    """Raises UsageError("nothing-graded")."""
    found = graded_runs(stage / "runs")
    if not found:
        raise UsageError("nothing-graded", what="This stage has no graded calibration yet.",
                         remedy="Run `velatura calibrate` first.")  # fmt: skip
    return found[-1]
