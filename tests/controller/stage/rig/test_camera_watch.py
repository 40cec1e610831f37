"""What a camera tells beside its pictures ends in the journal, and never in a failed run."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from controller.run.journal import Journal
from controller.run.progress import Progress
from controller.run.runner import Context
from controller.stage.steps.capture.photographs import EVERY_S, CameraWatch
from hal.deadline import Cancelled, Deadline, in_seconds
from hal.errors import DeviceError, DeviceTimeout
from hal.notices import Level, Notice
from hal.values import CameraStatus
from tests.controller.stage.rig.rig_model import ModelCamera


@dataclass
class TellingCamera(ModelCamera):
    """A camera with a list of repaired faults, and a state."""

    mended: list[Notice] = field(default_factory=list)
    state: CameraStatus = field(default_factory=CameraStatus)
    silent: DeviceError | None = None
    asked: int = 0

    def notices(self) -> list[Notice]:
        told, self.mended = self.mended, []
        return told

    def status(self, *, deadline: Deadline) -> CameraStatus:
        self.asked += 1
        if self.silent is not None:
            raise self.silent
        return self.state


@dataclass
class Heard:
    said: list[tuple[str, Level]] = field(default_factory=list)

    def progress(self, now: Progress) -> None: ...

    def say(self, text: str, level: Level = Level.INFO) -> None:
        self.said.append((text, level))


@pytest.fixture
def heard() -> Heard:
    return Heard()


@pytest.fixture
def context(tmp_path: Path, heard: Heard) -> Iterator[Context]:
    with Journal(tmp_path / "run") as journal:
        yield Context(journal.folder, journal, in_seconds(60), heard, {}, lambda fraction, note: None)


def codes(context: Context) -> list[str]:
    return [event.code for event in context.journal.events()]


def test_every_mended_fault_is_journalled_once(context: Context) -> None:
    camera = TellingCamera(
        mended=[Notice.warning("camera-busy", "It was busy."), Notice.warning("camera-usb-back", "It came back.")]
    )
    watch = CameraWatch(camera)
    watch.check(context)
    camera.mended.append(Notice.warning("camera-busy", "It was busy again."))
    watch.check(context)
    assert codes(context) == ["camera-busy", "camera-usb-back", "camera-busy"]
    assert context.journal.events()[-1].text == "It was busy again."
    assert {event.level for event in context.journal.events()} == {"warning"}


def test_a_low_battery_is_told_to_the_technician_once_a_run(context: Context, heard: Heard) -> None:
    camera = TellingCamera(state=CameraStatus(battery_percent=8, warnings=("battery-low",)))
    for _ in range(3):
        moments = iter((0.0, 0.0, 0.0, 2 * EVERY_S, 2 * EVERY_S))
        watch = CameraWatch(camera, clock=lambda moments=moments: next(moments))  # type: ignore[misc]
        watch.check(context)
        watch.check(context)
    assert camera.asked == 6
    assert codes(context) == ["camera-battery-low"]
    assert [level for _, level in heard.said] == [Level.WARNING]
    assert "battery is low" in heard.said[0][0]


def test_the_state_is_asked_for_once_a_minute_not_after_each_photograph(context: Context) -> None:
    now = 0.0
    camera = TellingCamera()
    watch = CameraWatch(camera, clock=lambda: now)
    for _ in range(100):
        watch.check(context)
        now += EVERY_S / 10
    assert camera.asked == 10


def test_a_camera_that_does_not_tell_its_state_stops_nothing(context: Context) -> None:
    camera = TellingCamera(silent=DeviceTimeout("camera-silent", what="It said nothing.", remedy="Wait."))
    CameraWatch(camera).check(context)
    assert codes(context) == ["camera-silent"]


def test_a_stop_takes_hold_while_the_camera_is_asked(context: Context) -> None:
    with pytest.raises(Cancelled):
        CameraWatch(TellingCamera(silent=Cancelled())).check(context)


def test_a_camera_whose_driver_tells_nothing_is_left_alone(context: Context) -> None:
    CameraWatch(ModelCamera()).check(context)
    assert codes(context) == []
