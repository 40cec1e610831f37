"""``velatura drift``."""

from __future__ import annotations

from controller.commands.running import Json, StageFolder, work


def drift(stage: StageFolder, as_json: Json = False) -> None:
    """Tell from a few photographs whether camera, object or a projector moved or dimmed since the calibration."""
    work("controller.drift_services:check_drift", as_json=as_json, stage=stage, details=as_json)
