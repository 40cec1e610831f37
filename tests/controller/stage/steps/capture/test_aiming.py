"""Test shots of a stage of models, whose camera sees what the display shows."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from controller.stage.steps.capture.aiming import FIGURES, take_test_shots
from hal.deadline import in_seconds
from hal.values import CapturedFile, FileKind
from tests.controller.stage.rig.rig_model import ModelCamera, ModelDisplay, ModelRig


@dataclass
class SeeingCamera(ModelCamera):
    """Writes the display's frames, each projector pixel 20 of its own wide."""

    display: ModelDisplay = field(default_factory=ModelDisplay)

    def _file(self, path: Path, kind: FileKind) -> CapturedFile:
        light = sum(frame.astype(int) for frame in self.display.shown[-1].values()) // 4
        data = cv2.imencode(".png", np.kron(light, np.ones((20, 20, 1))).astype(np.uint8))[1].tobytes()
        path.write_bytes(data)
        return CapturedFile(path, kind, len(data), hashlib.sha256(data).hexdigest())


def test_progress_rises_to_the_last_picture_and_the_pictures_go(tmp_path: Path) -> None:
    display, told = ModelDisplay(), list[tuple[float, str]]()
    stage = ModelRig(tmp_path, display=display, camera=SeeingCamera((FileKind.JPEG,), display=display))
    folder = take_test_shots(stage.rig, longest_exposure_s=2.0, deadline=in_seconds(60),
                             advance=lambda share, note: told.append((share, note)))  # fmt: skip
    shares = [share for share, _ in told]
    assert shares == sorted(shares)
    assert (shares[0] >= 0, shares[-1] <= 1, [note for _, note in told][-3:-1]) == (True, True, ["left", "right"])
    figures = json.loads((folder / FIGURES).read_text())
    assert [row["projector"] for row in figures["projectors"]] == ["left", "right"]
    assert sorted(path.suffix for path in folder.iterdir()) == [".json", ".png"]
