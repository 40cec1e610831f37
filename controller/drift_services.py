"""What keeps a calibration true: the drift check, and the recalibration that repeats only what has changed."""

from __future__ import annotations

import json
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from controller.app import Checked, check_stage, run_on_stage
from controller.services import finished_calibration
from controller.session.drifting import FILE, drift_steps
from controller.session.journal import Journal
from controller.session.progress import Level, Reporter
from controller.session.rig import Rig
from controller.session.runner import Step
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


def _longest_s(checked: Checked) -> float:
    return checked.stage.tables.capture.longest_exposure_s
