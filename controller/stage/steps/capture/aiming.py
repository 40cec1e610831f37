"""Test shots for aiming projectors and camera, taken in seconds and evaluated by ``calibrate.verify.aim``."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np

from controller.bundle.describe import png
from controller.core import channels
from controller.core.arrays import ByteImage, FloatImage
from controller.core.storage import write_atomically
from controller.optics.calibrate.verify.aim import aim_overview, assess_aim, checkerboard, levels
from controller.optics.capture.acquire import Shot
from controller.optics.capture.brackets import choose_exposure
from controller.optics.capture.jpeg_response import nominal_response
from controller.optics.capture.raw import read_photograph
from controller.stage.rig.rig import Rig
from controller.stage.steps.capture.exposure import FIRST_EXPOSURE_S, bracket
from hal.deadline import Deadline

FOLDER: Final = "kiosk/aiming"
FIGURES: Final = "aiming.json"
PICTURE: Final = "overview.png"
TRIES: Final = 5
LONGEST_PX: Final = 960
KEPT: Final = 40
"""Test shots whose sharpness is remembered."""


def take_test_shots(
    rig: Rig, *, longest_exposure_s: float, deadline: Deadline, advance: Callable[[float, str], None]
) -> Path:
    """Photograph 2 N + 2 pictures or a few more, evaluate them, and write figures and picture to ``FOLDER``.

    Returns that folder. Raises what the devices raise.
    """
    folder = rig.stage / FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    available = [value for value in rig.acquirer.exposures_s() if value <= longest_exposure_s]
    take = partial(_take, rig, folder, deadline)
    white = {projector.name: projector.white() for projector in rig.projectors}
    exposure_s = bracket(FIRST_EXPOSURE_S, (1.0,), available, longest_exposure_s)[0]
    for number in range(TRIES):
        advance(0.04 * number, "exposure")
        picture = take(f"white-{number}", white, exposure_s)
        choice = choose_exposure(picture, exposure_s, available)
        if choice.settled and choice.exposure_s == exposure_s:
            break
        exposure_s = choice.exposure_s
    black = take("black", {}, exposure_s)
    boards = []
    for number, projector in enumerate(rig.projectors):
        advance(0.2 + 0.7 * number / len(rig.projectors), projector.name)
        first, second = (
            take(
                f"projector-{number}-{inverse}",
                {projector.name: checkerboard(projector.size_px, inverse=inverse)},
                exposure_s,
            )
            for inverse in (False, True)
        )
        boards.append((first, second))
    advance(0.9, "evaluating the pictures")
    aim = assess_aim(black, boards)
    _keep_picture(folder, aim_overview(picture, aim))
    projectors = [{"projector": one.name, **asdict(found)}
                  for one, found in zip(rig.projectors, aim.projectors, strict=True)]  # fmt: skip
    shares, clipped = levels(picture, aim)
    level = float(np.nanquantile(np.nan_to_num(channels.largest(picture), nan=1.0), 0.99))
    figures: dict[str, Any] = {
        "projectors": projectors, "overlap": aim.overlap, "too_dark": aim.too_dark, "too_soft": aim.too_soft,
        "camera_focus": aim.camera_focus, "exposure": level, "exposure_s": exposure_s, "measured_unix_s": time.time(),
        "histogram": shares, "clipped": clipped,
    }  # fmt: skip
    figures["history"] = [*_earlier(folder), _sharpness(figures)][-KEPT:]
    write_atomically(folder / FIGURES, json.dumps(figures, indent=1).encode())
    return folder


def _sharpness(figures: dict[str, Any]) -> dict[str, Any]:
    focus = {row["projector"]: row["focus"] for row in figures["projectors"]}
    return {"unix_s": figures["measured_unix_s"], "camera_focus": figures["camera_focus"], "projectors": focus}


def _earlier(folder: Path) -> list[dict[str, Any]]:
    """How sharp the test shots before these were; none if their file is damaged."""
    try:
        return list(json.loads((folder / FIGURES).read_text())["history"])
    except (OSError, ValueError, KeyError, TypeError):
        return []


def _take(rig: Rig, folder: Path, deadline: Deadline, name: str, frames: dict[str, ByteImage],
          exposure_s: float) -> FloatImage:  # fmt: skip
    file, _ = rig.acquirer.take(Shot(name, rig.on_outputs(frames), exposure_s), folder, deadline=deadline)
    try:
        return read_photograph(file.path, response=nominal_response()).measured()
    finally:
        file.path.unlink()


def _keep_picture(folder: Path, picture: ByteImage) -> None:
    factor = LONGEST_PX / max(picture.shape)
    if factor < 1:
        size = (round(picture.shape[1] * factor), round(picture.shape[0] * factor))
        picture = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)
    write_atomically(folder / PICTURE, png(picture))


__all__ = ["FIGURES", "FOLDER", "PICTURE", "take_test_shots"]
