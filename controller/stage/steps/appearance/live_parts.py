"""Reads the data for live mode from a calibration run (docs/reference/bundle-format.md, "Live section")."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from controller.bundle.live_maps import LiveMaps
from controller.bundle.writer import NewLive
from controller.core.errors import WorkError
from controller.optics.solve.appearance import StageLight
from controller.optics.solve.scaling.stage_maps import reduction, scaling_maps
from controller.stage.artefacts.calibrated import Calibrated
from controller.stage.artefacts.solved import has_base


def live_arrays(run: Path, outputs: Mapping[str, tuple[str, tuple[int, int]]]) -> NewLive:
    """The live section for the calibration and base image in the folder ``run``; ``outputs``: by projector, its output.

    Raises WorkError("base-not-solved").
    """
    names = {projector: output for projector, (output, _) in outputs.items()}
    maps = live_maps(Calibrated(run, tuple(outputs)), names)
    return NewLive(maps.target_px, maps.arrays())


def target_px(calibrated: Calibrated) -> tuple[int, int]:
    """(width, height) of the targets, from the camera's picture; builds nothing."""
    width, height = calibrated.camera_px or calibrated.calibration.black.shape[1::-1]
    factor = reduction((height, width))
    return -(-width // factor), -(-height // factor)


def live_maps(calibrated: Calibrated, outputs: Mapping[str, str]) -> LiveMaps:
    """The maps of a calibration; ``outputs``: by projector, its output's name. Raises WorkError("base-not-solved")."""
    if not has_base(calibrated.base_folder):
        raise WorkError(
            "base-not-solved",
            what=f"{calibrated.folder.name} has no base image. Live targets need one.",
            remedy="Run `velatura appearance` on the stage first.",
        )
    calibration = calibrated.calibration
    light = StageLight(calibrated.transport, calibration.black, calibrated.indirect)
    return scaling_maps(
        light,
        calibrated.base,
        [part.radiometry for part in calibration.projectors],
        [outputs[part.name] for part in calibration.projectors],
    )
