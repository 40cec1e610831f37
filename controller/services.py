"""What the command line and the kiosk ask for, each a run on a stage: calibrate, make appearances, play."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from controller.app import Checked, check_stage, marker, run_on_stage, unfinished_run
from controller.session.calibrating import calibration_steps
from controller.session.machine import Event
from controller.session.progress import Reporter
from controller.session.rig import Rig
from controller.session.runner import Step


def calibrate(*, stage: Path, reporter: Reporter, cancel: threading.Event) -> Mapping[str, Any]:
    """Calibrate the stage, going on with an unfinished calibration; returns where the results lie."""
    checked = check_stage(stage)
    run = unfinished_run(checked.stage.folder, "calibrate")
    run_on_stage(
        checked,
        lambda rig: calibrating(rig, checked),
        name="calibrate", run=run, reporter=reporter, cancel=cancel,
    )  # fmt: skip
    return {"run": str(run)}


def calibrating(rig: Rig, checked: Checked) -> Sequence[Step]:
    """The calibration's steps between their state markers."""
    longest_s = checked.stage.tables.capture.longest_exposure_s
    return [
        marker("calibrating", "Calibrating", enter=Event.RECALIBRATE),
        *calibration_steps(rig, checked.prior, longest_exposure_s=longest_s),
        marker("calibrated", "Calibrated", leave=Event.CALIBRATED),
    ]
