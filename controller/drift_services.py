"""What keeps a calibration true: the drift check, and the recalibration that repeats only what has changed."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from controller.app import marker, run_on_stage
from controller.calibrations import finished_calibration, worst_grade
from controller.checking import Checked, check_stage
from controller.errors import UsageError
from controller.session.calibrating import calibration_steps
from controller.session.darkness import dark_after
from controller.session.dotting import dot_steps
from controller.session.drifting import FILE, drift_steps
from controller.session.grading import accept, below_grade, compare_with_last, grade_figures, passes
from controller.session.journal import Journal
from controller.session.machine import Event
from controller.session.modes import MODES, CalibrationMode, DotOptions, mode_of
from controller.session.one_projector import one_projector_steps
from controller.session.progress import Level, Reporter
from controller.session.quick import quick_steps
from controller.session.rig import Rig
from controller.session.runner import Context, Step
from controller.session.solving import Calibrated


def check_drift(*, stage: Path, details: bool, reporter: Reporter, cancel: threading.Event) -> Mapping[str, Any]:
    """Photograph the stage N + 2 times and tell what has changed since its calibration; ``details``: every figure.

    Raises UsageError("not-calibrated"), and what the devices raise.
    """
    checked = check_stage(stage)
    calibrated = Calibrated(finished_calibration(checked.stage.folder), checked.names)

    def steps(rig: Rig, _: Path) -> Sequence[Step]:
        return drift_steps(rig, calibrated, longest_exposure_s=_longest_s(checked))

    run = run_on_stage(checked, steps, name="drift", reporter=reporter, cancel=cancel)
    content: dict[str, Any] = json.loads((run / FILE).read_text())
    for sentence in content["sentences"]:
        reporter.say(sentence, Level.INFO if content["advice"] == "nothing" else Level.WARNING)
    with Journal(run) as journal:
        content["seconds"] = journal.steps()["drift-photographs"]
    return {"run": str(run), **(content if details else {"advice": content["advice"]})}


def recalibrate(
    *,
    stage: Path,
    reporter: Reporter,
    cancel: threading.Event,
    accept_grade: bool = False,
    projector: str | None = None,
) -> Mapping[str, Any]:
    """Bring the last calibration up to date, repeating only what has changed; goes on with an unfinished one.

    ``projector``: all of that one is measured anew, whatever has changed, and nothing of the others but one photograph
    each for the grade.
    Raises UsageError("not-calibrated", "projector-unknown"), CalibrationError("projector-dark"),
    CalibrationError("calibration-below-grade") for a result that may not replace the last calibration, and what the
    devices raise.
    """
    checked = check_stage(stage)
    check_name(checked, projector)
    last = finished_calibration(checked.stage.folder)
    calibrated = Calibrated(last, checked.names)

    def steps(rig: Rig, run: Path) -> Sequence[Step]:
        longest_s = _longest_s(checked)
        mode: CalibrationMode = next((one for one in MODES if one == mode_of(last)), "fast")
        full = [*calibration_steps(rig, checked.prior, longest_exposure_s=longest_s),
                *dot_steps(rig, DotOptions(mode, None), longest_exposure_s=longest_s)]  # fmt: skip
        repeated = (
            quick_steps(rig, run, calibrated, full, longest_exposure_s=longest_s)
            if projector is None
            else one_projector_steps(rig, run, calibrated, full, projector, longest_exposure_s=longest_s)
        )
        return [
            marker("calibrating", "Calibrating", enter=Event.RECALIBRATE),
            *repeated,
            *dark_after(rig.darkness, rig.display),
            _take_over_step(worst_grade(checked), reporter, accept_grade=accept_grade),
            marker("recalibrated", "Recalibrated", leave=Event.CALIBRATED),
        ]

    name = "recalibrate" if projector is None else "projector"
    run = run_on_stage(checked, steps, name=name, reporter=reporter, cancel=cancel, dark=True)
    compare_with_last(run, last, reporter)
    if not passes(run, worst_grade(checked)):
        raise below_grade(run, worst_grade(checked))
    with Journal(run) as journal:
        seconds = sum(value for name, value in journal.steps().items() if name.endswith("photographs"))
        shots = journal.shot_count()
    advice = "projector" if projector is not None else json.loads((run / FILE).read_text())["advice"]
    return {"run": str(run), **grade_figures(run), "advice": advice, "photographs": shots,
            "check_and_grade_seconds": seconds}  # fmt: skip


def check_name(checked: Checked, projector: str | None) -> None:
    """Raises UsageError("projector-unknown"), before a lamp is struck."""
    if projector is not None and projector not in checked.names:
        raise UsageError("projector-unknown", what=f"There is no projector {projector[:64]!r}.",
                         remedy=f"It is one of {', '.join(checked.names)}.")  # fmt: skip


def _take_over_step(worst: float, reporter: Reporter, *, accept_grade: bool) -> Step:
    """Only a result that passes the gate counts as a finished calibration, and takes the last one's place."""

    def run(context: Context) -> Sequence[Path]:
        if accept_grade:
            accept(context.folder, reporter, worst)
        if passes(context.folder, worst):
            context.journal.complete("calibrated", {}, (), began_at_s=time.time())
        return ()

    return Step("take-over", run, title="Comparing the grade with what is asked", weight=0.01, always=True)


def _longest_s(checked: Checked) -> float:
    return checked.stage.tables.capture.longest_exposure_s
