"""A stage whose projectors show everything late: the delay is measured, waited for, and noticed when it grows."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from controller.core.arrays import ByteImage
from controller.optics.capture import latency
from controller.optics.capture.acquire import Acquirer
from controller.optics.capture.profile import CameraNoise, CameraProfile
from controller.optics.capture.raw import read_jpeg_values
from controller.run.journal import Journal
from controller.run.progress import Silent
from controller.run.runner import Context
from controller.stage.artefacts.camera import inherit_camera
from controller.stage.artefacts.photographs import PhotographSet
from controller.stage.rig.lamp_guard import LampGuard
from controller.stage.rig.rig import Rig, RigProjector
from controller.stage.steps.capture import camera as camera_steps
from controller.stage.steps.capture import exposure as exposure_steps
from controller.stage.steps.capture import photographs as shots
from controller.stage.steps.capture.camera import delay_step
from controller.stage.steps.capture.photographs import Planned, take_all
from hal.deadline import Deadline, in_seconds
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

SIZE_PX = (48, 32)
LATE_S = 0.12
LONGEST_S = 0.3


class LateStage:
    """A display and a camera in one: a photograph is the frame that was presented ``late_s`` before, eight times as
    wide and high, as a JPEG."""

    def __init__(self) -> None:
        self.late_s = LATE_S
        self._shown: list[tuple[float, npt.NDArray[np.uint8]]] = [
            (0.0, np.zeros((SIZE_PX[1], SIZE_PX[0], 3), np.uint8))
        ]
        self.grows_after: int | None = None
        self._visible = 0
        self.taken = 0
        self.blind = False

    @property
    def capabilities(self) -> CameraCapabilities:
        return CameraCapabilities((0.01, 0.02, 0.04), (100,), (), raw=False, jpeg=True)

    def identity(self, *, deadline: Deadline) -> DeviceIdentity:
        return DeviceIdentity("Late", "Stage")

    def close(self) -> None:
        """Nothing to release."""

    def outputs(self, *, deadline: Deadline) -> tuple[OutputInfo, ...]:
        return (OutputInfo("P1", *SIZE_PX),)

    def show(self, frames: Mapping[str, npt.NDArray[np.uint8]], *, deadline: Deadline) -> Presented:
        now_s = time.monotonic()
        self._shown.append((now_s, frames["P1"].copy()))
        return Presented(len(self._shown), now_s)

    def play(self, appearance: str, *, deadline: Deadline) -> Presented:
        return Presented(0, 0.0)

    def configure(self, settings: ExposureSettings, *, deadline: Deadline) -> ExposureSettings:
        return settings

    def capture(self, destination: Path, *, deadline: Deadline) -> list[CapturedFile]:
        if self.grows_after is not None and self.taken >= self.grows_after:
            self.late_s = LATE_S
        now_s = time.monotonic()
        there = [number for number, (at_s, _) in enumerate(self._shown) if at_s + self.late_s <= now_s]
        # A display that becomes late stands still; it does not go back.
        self._visible = max(self._visible, there[-1])
        frame = self._shown[self._visible][1]
        self.taken += 1
        frame = frame // 255 if self.blind else frame
        large = np.kron(frame, np.ones((8, 8, 1), np.uint8)) // 2 + 10
        done, data = cv2.imencode(".jpg", large, [cv2.IMWRITE_JPEG_QUALITY, 95])
        assert done
        path = destination.with_suffix(".jpg")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data.tobytes())
        return [CapturedFile(path, FileKind.JPEG, data.size, hashlib.sha256(data.tobytes()).hexdigest())]


@pytest.fixture(autouse=True)
def short_waits(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (latency, camera_steps, exposure_steps, shots):
        monkeypatch.setattr(module, "LONGEST_S", LONGEST_S)


@pytest.fixture
def stage() -> LateStage:
    return LateStage()


@pytest.fixture
def rig(stage: LateStage, tmp_path: Path) -> Rig:
    world = World()
    guard = LampGuard("left", Lamp(world), Shelf(), clock=world)
    guard.switch_on(deadline=soon())
    world.time_s += 20.0
    acquirer = Acquirer(stage, stage, iso=100, aperture_f=None, settle_s=0.01)
    return Rig(tmp_path, (RigProjector("left", "P1", SIZE_PX, guard),), stage, stage, acquirer)


@pytest.fixture
def context(tmp_path: Path) -> Iterator[Context]:
    with Journal(tmp_path / "run") as journal:
        (journal.folder / "exposure.json").write_text(json.dumps({"left": {"base_s": 0.02, "white_s": [0.02]}}))
        yield Context(journal.folder, journal, in_seconds(60), Silent(), {}, lambda fraction, note: None)


def stripes(number: int) -> dict[str, ByteImage]:
    image = np.zeros((SIZE_PX[1], SIZE_PX[0], 3), np.uint8)
    image[:, (np.arange(SIZE_PX[0]) >> number) % 2 == 1] = 255
    return {"left": image}


def plan(count: int = 4) -> list[Planned]:
    return [Planned(f"stripes-{number}", partial(stripes, number), 0.02) for number in range(count)]


def shows_its_own(path: Path, number: int) -> bool:
    seen = read_jpeg_values(path)[4::8, 4::8, 1] > 70
    return bool(np.mean(seen == (stripes(number)["left"][:, :, 1] > 0)) > 0.97)


def photographs(paths: list[Path]) -> list[bool]:
    return [shows_its_own(path, number) for number, path in enumerate(paths[1:])]


def test_the_delay_is_measured_and_then_every_photograph_shows_its_own_frames(rig: Rig, context: Context) -> None:
    (path,) = delay_step(rig, 4.0).run(context)
    wait_s = json.loads(path.read_text())["wait_s"]
    assert LATE_S <= wait_s < LATE_S + 0.2
    assert rig.acquirer.wait_s == pytest.approx(wait_s)
    assert all(photographs(take_all(rig, context, plan(), into=PhotographSet("stripes"))))
    assert not list((context.folder / "captures").glob("delay-*"))


def test_with_the_fixed_wait_alone_photographs_would_show_the_frames_before(rig: Rig, context: Context) -> None:
    assert not rig.acquirer.protected
    assert not any(photographs(take_all(rig, context, plan(), into=PhotographSet("stripes"))))


def test_a_run_that_goes_on_waits_as_long_as_was_measured(rig: Rig, context: Context, stage: LateStage) -> None:
    delay_step(rig, 4.0).run(context)
    fresh = Acquirer(stage, stage, iso=100, aperture_f=None, settle_s=0.01)
    again = Rig(rig.stage, rig.projectors, stage, stage, fresh)
    assert all(photographs(take_all(again, context, plan(), into=PhotographSet("stripes"))))


def test_a_display_that_grows_later_is_noticed_and_its_photographs_are_taken_again(
    rig: Rig, context: Context, stage: LateStage
) -> None:
    rig.acquirer.set_delay(0.03)
    stage.late_s, stage.grows_after = 0.02, 2
    assert all(photographs(take_all(rig, context, plan(), into=PhotographSet("stripes"))))
    assert stage.taken == 5, "the third photograph was taken twice"
    assert rig.acquirer.wait_s >= LATE_S
    assert json.loads((context.folder / "delay-raised.json").read_text())["wait_s"] == rig.acquirer.wait_s


def test_pictures_that_look_alike_to_the_camera_cost_one_photograph_more_and_no_wait(
    rig: Rig, context: Context, stage: LateStage
) -> None:
    stage.late_s = 0.0
    rig.acquirer.set_delay(0.02)
    same = [Planned("dim-0", partial(_flat, 0), 0.02), Planned("dim-1", partial(_flat, 0), 0.04)]
    take_all(rig, context, same, into=PhotographSet("same"))
    assert stage.taken == 2, "frames that do not change are not compared"
    stage.blind = True
    alike = [Planned("grey-0", partial(_flat, 0), 0.02), Planned("grey-1", partial(_flat, 255), 0.02)]
    take_all(rig, context, alike, into=PhotographSet("alike"))
    assert stage.taken == 5
    assert rig.acquirer.wait_s == pytest.approx(0.02)


def _flat(value: int) -> dict[str, ByteImage]:
    return {"left": np.full((SIZE_PX[1], SIZE_PX[0], 3), value, np.uint8)}


def test_a_later_run_takes_over_the_camera_and_the_delay_but_not_over_its_own(
    rig: Rig, context: Context, tmp_path: Path
) -> None:
    calibrated = tmp_path / "calibrated"
    calibrated.mkdir()
    response = np.tile(np.linspace(0, 1, 256), (3, 1))
    CameraProfile(CameraNoise(0.1, 0.2), exposures=np.array([[0.02, 0.021]]), response=response).save(calibrated)
    (calibrated / "delay.json").write_text(json.dumps({"wait_s": 0.4}))
    inherit_camera(calibrated, context.folder)
    take_all(rig, context, plan(1), into=PhotographSet("stripes"))
    assert rig.acquirer.wait_s == pytest.approx(0.4)
    (taken,) = PhotographSet("stripes").read(context.folder)
    assert taken.exposure_s == pytest.approx(0.021)
    assert taken.profile is not None
    assert taken.profile.noise == CameraNoise(0.1, 0.2)
    assert np.max(taken.per_second()) == pytest.approx((255 // 2 + 10) / 255 / 0.021, rel=0.1)
    (context.folder / "delay.json").write_text(json.dumps({"wait_s": 0.2}))
    inherit_camera(calibrated, context.folder)
    assert json.loads((context.folder / "delay.json").read_text())["wait_s"] == 0.2
