"""A stage's settings as `velatura init` writes them, and a run that was graded; for tests of the kiosk's files."""

from __future__ import annotations

import json
from pathlib import Path

from controller.optics.calibrate.verify.grade import grade_of
from controller.run.journal import Journal
from controller.stage.artefacts.kinds import CALIBRATED

TEXT = """
[stage]
name = "The vase"

[[projectors]]
name = "left"
output = "P1"
driver = "serial"
port = "/dev/ttyUSB0"
profile = "optoma-later"

[camera]
driver = "ptp"
iso = 100
address = "ptpip:127.0.0.1"
focal_length_px = 4100.0

[display]
driver = "player"

[[display.outputs]]
name = "P1"
width_px = 1400
height_px = 1050

[[appearances]]
name = "marble"
kind = "pattern"

[[appearances]]
name = "glass"
kind = "picture"
file = "appearances/glass.png"
"""


def vase(folder: Path) -> Path:
    """The folder with stage.toml and what must never leave the machine."""
    for name, content in {
        "stage.toml": TEXT, "keys/stage.key": "SECRET", "kiosk/panel/accounts.json": "SECRET",
        "appearances/glass.png": "a picture", "appearances/.part": "unfinished",
    }.items():  # fmt: skip
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(content)
    return folder


def graded_run(stage: Path, name: str, errors: dict[str, float], *, finished: bool = True) -> Path:
    """A calibration's folder: its journal, and its grade."""
    run = stage / "runs" / name
    run.mkdir(parents=True)
    with Journal(run) as journal, journal.run("calibrate"):
        if finished:
            journal.complete(CALIBRATED, {}, (), began_at_s=0.0)
    letters = {key: {"relative_rms": value, "grade": grade_of(value).value} for key, value in errors.items()}
    (run / "verification.json").write_text(json.dumps(letters))
    return run
