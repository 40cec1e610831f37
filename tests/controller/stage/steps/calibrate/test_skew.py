"""How far apart outputs change, measured on a stage of our own whose truth is known."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from controller.optics.capture.acquire import Acquirer
from controller.run.journal import Journal
from controller.run.progress import Silent
from controller.run.runner import Context
from controller.stage.artefacts.calibrated import Calibrated
from controller.stage.artefacts.projectors import Light
from controller.stage.rig.lamp_guard import LampGuard
from controller.stage.rig.rig import Rig, RigProjector
from controller.stage.steps.calibrate import drift
from controller.stage.steps.calibrate.drift import skew_step
from hal.deadline import Deadline, in_seconds
from hal.notices import Level
from hal.values import (
    CameraCapabilities,
    CapturedFile,
    DeviceIdentity,
    ExposureSettings,
    FileKind,
    OutputInfo,
    Presented,
)
from tests.controller.stage.rig.lamp_model import Lamp, Shelf, World, soon

NAMES, SIZE_PX = ("P1", "P2"), (8, 6)
ROWS, COLUMNS = 64, 128
LEAD_S = 0.1
"""From asking for a picture to its presentation."""
WHITES = [
    6.0 * np.clip(1.4 - 2 * np.abs(np.linspace(0, 1, COLUMNS) - at), 0, 1)[None, :, None] * np.ones((ROWS, 1, 3))
    for at in (0.2, 0.75)
]
"""Full scales per second; they overlap in the middle, and are clipped at the exposure that is wanted."""


@dataclass
class Stage:
    """A display and a camera. Each output shows a picture ``late_s`` after its presentation; the camera opens
    ``opens_s`` after it is asked to, by up to 0.02 s more, and its rows open one after the other in ``readout_s``.
    """

    late_s: tuple[float, float]
    opens_s: float = 0.05
    readout_s: float = 0.0
    noise: float = 1e-3
    exposure_s: float = 0.1
    shown: list[tuple[float, tuple[float, ...]]] = field(default_factory=lambda: [(0.0, (0.0, 0.0))])
    taken: int = 0

    @property
    def capabilities(self) -> CameraCapabilities:
        return CameraCapabilities((0.02, 0.08, 0.16, 0.5), (100,), (), raw=False, jpeg=True)

    def identity(self, *, deadline: Deadline) -> DeviceIdentity:
        return DeviceIdentity("Own", "Stage")

    def close(self) -> None:
        """Nothing to release."""

    def outputs(self, *, deadline: Deadline) -> tuple[OutputInfo, ...]:
        return tuple(OutputInfo(name, *SIZE_PX) for name in NAMES)

    def play(self, appearance: str, *, deadline: Deadline) -> Presented:
        return Presented(0, 0.0)

    def show(self, frames: Mapping[str, npt.NDArray[np.uint8]], *, deadline: Deadline) -> Presented:
        time.sleep(LEAD_S)
        self.shown.append((time.monotonic(), tuple(float(frames[name].mean()) / 255 for name in NAMES)))
        return Presented(len(self.shown), self.shown[-1][0])

    def configure(self, settings: ExposureSettings, *, deadline: Deadline) -> ExposureSettings:
        self.exposure_s = settings.exposure_s
        return settings

    def capture(self, destination: Path, *, deadline: Deadline) -> list[CapturedFile]:
        random = np.random.default_rng(self.taken)
        self.taken += 1
        opened_s = time.monotonic() + self.opens_s + 0.02 * random.random()
        time.sleep(opened_s - time.monotonic() + self.exposure_s + max(0.0, self.readout_s) + 0.02)
        starts_s = opened_s + np.linspace(0, self.readout_s, ROWS)
        light = np.zeros((ROWS, COLUMNS, 3))
        for number, white in enumerate(WHITES):
            begins = [at_s + self.late_s[number] for at_s, _ in self.shown]
            for begin_s, end_s, (_, levels) in zip(begins, [*begins[1:], 1e99], self.shown, strict=True):
                open_s = np.minimum(starts_s + self.exposure_s, end_s) - np.maximum(starts_s, begin_s)
                light += np.maximum(open_s, 0)[:, None, None] * levels[number] * white
        light += 0.004 + self.noise * random.standard_normal(light.shape)
        path = destination.with_suffix(".tiff")
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), np.clip(light * 65535, 0, 65535).astype(np.uint16))
        data = path.read_bytes()
        return [CapturedFile(path, FileKind.RAW, len(data), hashlib.sha256(data).hexdigest())]


class Heard(Silent):
    def __init__(self) -> None:
        self.said: list[tuple[str, Level]] = []

    def say(self, text: str, level: Level = Level.INFO) -> None:
        self.said.append((text, level))


def measured(stage: Stage, folder: Path, first: str = "P1") -> tuple[dict[str, Any], str, Level]:
    world = World()
    guard = LampGuard("left", Lamp(world), Shelf(), clock=world)
    guard.switch_on(deadline=soon())
    world.time_s += 20.0
    projectors = tuple(RigProjector(f"of {name}", name, SIZE_PX, guard) for name in NAMES)
    rig = Rig(folder, projectors, stage, stage, Acquirer(stage, stage, iso=100, aperture_f=None, settle_s=0.06))
    (folder / "calibration").mkdir()
    even = np.tile(np.linspace(0, 1, 256), (3, 1))
    for projector, white in zip(projectors, WHITES, strict=True):
        light = Light(even, np.eye(3), white.astype(np.float32), np.zeros((ROWS, COLUMNS, 3), np.float32), np.eye(3))
        light.write(folder / "calibration", projector.name)
    calibrated = Calibrated(folder / "calibration", [projector.name for projector in projectors])
    heard = Heard()
    with Journal(folder / "run") as journal:
        context = Context(journal.folder, journal, in_seconds(300), heard, {}, lambda fraction, note: None)
        path, *_ = skew_step(rig, calibrated, first, 0.3).run(context)
    return json.loads(path.read_text()), *heard.said[-1]


@pytest.mark.parametrize(
    "stage",
    [
        Stage((0.0, 0.0)),
        Stage((0.0, 0.008)),
        Stage((0.0, 0.021), readout_s=0.03),
        Stage((0.021, 0.0), opens_s=0.4),
    ],
    ids=["together", "8 ms", "21 ms, by rows", "a camera that opens after the picture could be asked for"],
)
def test_it_is_found_how_far_apart_outputs_change(stage: Stage, tmp_path: Path) -> None:
    found, sentence, level = measured(stage, tmp_path)
    other = found["outputs"]["P2"]
    assert found["outputs"]["P1"] == {"late_s": 0.0, "uncertain_s": 0.0}
    assert other["late_s"] == pytest.approx(stage.late_s[1] - stage.late_s[0], abs=max(other["uncertain_s"], 4e-4))
    assert 0 < other["uncertain_s"] < 1e-3
    assert found["apart_s"] == abs(other["late_s"])
    assert f"{1e3 * found['apart_s']:.1f} ± {1e3 * found['uncertain_s']:.1f} ms" in sentence
    assert level is Level.INFO


def test_a_camera_with_much_noise_says_that_it_is_not_sure(tmp_path: Path) -> None:
    found, _, level = measured(Stage((0.008, 0.0), noise=0.3), tmp_path, first="P2")
    assert found["uncertain_s"] > drift.SURE_S
    assert level is Level.WARNING
    assert abs(found["outputs"]["P1"]["late_s"] - 0.008) < 2 * found["uncertain_s"]


def test_outputs_further_apart_than_the_exposure_give_no_number(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(drift, "MOST_CHANGES", 4)
    found, sentence, level = measured(Stage((0.0, 0.2)), tmp_path)
    assert (found["apart_s"], found["outputs"]) == (None, {})
    assert sentence.startswith("Only 0 of 4 photographs of 0.16 s")
    assert level is Level.WARNING
