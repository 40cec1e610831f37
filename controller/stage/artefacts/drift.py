"""The result of a drift check, ``drift.json`` in its run's folder (docs/explanation/drift.md)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from controller.optics.calibrate.verify.drift import Drift
from controller.optics.calibrate.verify.drift_report import drift_from_json, drift_to_json
from controller.stage.artefacts.kinds import StepKind
from controller.stage.artefacts.names import json_path, read_json, write_json


def write_drift(run: Path, drift: Drift, *, calibration: str, photographs: int) -> Path:
    """``calibration``: the name of the run to compare with; lengths are in camera pixels, light in shares."""
    content = drift_to_json(drift, calibration=calibration, photographs=photographs)
    return write_json(json_path(run, StepKind.DRIFT), content)


def read_drift(run: Path) -> Drift:
    """The result of the check."""
    return drift_from_json(read_drift_figures(run))


def read_drift_figures(run: Path) -> dict[str, Any]:
    """The content of the file, with advice and sentences."""
    content: dict[str, Any] = read_json(json_path(run, StepKind.DRIFT))
    return content
