"""Relays and a light sensor in stage.toml: what a run does with them, and which tables are refused."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from controller.core.errors import UsageError
from controller.run.runner import Context, Step
from controller.run.step_id import StepId
from controller.stage.rig.ambient_light import AmbientLightLimit, dark_after
from controller.stage.rig.rig import Rig
from controller.stage.sessions.check import check_stage
from controller.stage.sessions.session import OwnSession, StageWork
from hal.deadline import Deadline
from hal.errors import DeviceError, DeviceRefused
from hal.notices import Level
from hal.registry import Driver, Drivers
from hal.values import DeviceIdentity
from tests.controller.stage.rig.lamp_model import World, soon
from tests.controller.stage.rig.test_mains_relays import Board
from tests.controller.stage.sessions.run_models import STAGE, Models

RELAYS = """
[[relays]]
name = "board"
driver = "model"
boot_s = 0
[[relays.mains]]
channel = 1
feeds = ["left"]
[[relays.mains]]
channel = 2
feeds = ["right"]
"""
LIGHT = """
[light_sensor]
driver = "model"
most_lux = 2.0
"""


class Sensor:
    """It is as bright as it is asked to be."""

    def __init__(self) -> None:
        self.lux = 0.5

    def identity(self, *, deadline: Deadline) -> DeviceIdentity:
        return DeviceIdentity("Model", "Sensor")

    def illuminance_lux(self, *, deadline: Deadline) -> float:
        return self.lux

    def close(self) -> None:
        """Nothing to release."""


class Hall(Models):
    """The models of ``test_app`` with a relay board and a light sensor."""

    def __init__(self, folder: Path, tables: str) -> None:
        super().__init__(folder)
        (folder / "stage.toml").write_text(STAGE + tables)
        self.board, self.sensor = Board(World()), Sensor()
        self.drivers = Drivers(
            (
                *self.drivers.list,
                Driver("power_switch", "model", "Relays.", lambda *_: self.board),
                Driver("light_sensor", "model", "A sensor.", lambda *_: self.sensor),
            )
        )
        self.seen: list[Any] = []
        self.later_lux = self.sensor.lux

    def work(self, *, dark: bool = False) -> None:
        def steps(rig: Rig, _: Path) -> Sequence[Step]:
            def look(context: Context) -> Sequence[Path]:
                self.seen.append((dict(self.board.closed), [lamp.lit for lamp in self.lamps.values()]))
                self.sensor.lux = self.later_lux
                return ()

            return [Step(StepId("look"), look), *dark_after(rig.ambient_limit, rig.display)]

        checked = check_stage(self.folder, drivers=self.drivers)
        OwnSession(checked.stage.folder).run(
            checked, StageWork("trial", steps, dark=dark), reporter=self.told, cancel=self.cancel
        )


def test_mains_are_on_while_the_run_works_and_cut_after_the_lamps(tmp_path: Path) -> None:
    hall = Hall(tmp_path, RELAYS)
    hall.work()
    assert hall.seen == [({1: True, 2: True}, [True, True])]
    assert hall.board.closed == {1: False, 2: False}
    assert not any(lamp.lit for lamp in hall.lamps.values())


def test_a_lamp_that_does_not_go_out_keeps_its_mains(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("controller.stage.rig.power.MARGIN_S", 0.2)
    hall = Hall(tmp_path, RELAYS)
    hall.stuck.add("A")
    with pytest.raises(DeviceError) as caught:
        hall.work()
    assert caught.value.code == "lamp-still-lit"
    assert hall.board.closed == {1: True, 2: False}
    assert any("board 1" in text and "left" in text for level, text in hall.told.said if level is Level.WARNING)


def test_calibration_is_refused_in_a_bright_room_before_any_lamp_is_struck(tmp_path: Path) -> None:
    hall = Hall(tmp_path, LIGHT)
    hall.sensor.lux = 80.0
    with pytest.raises(DeviceRefused) as caught:
        hall.work(dark=True)
    assert caught.value.code == "room-not-dark"
    assert "80.00 lux" in caught.value.what
    assert "most_lux" in caught.value.remedy
    assert hall.seen == []


def test_other_work_does_not_need_darkness(tmp_path: Path) -> None:
    hall = Hall(tmp_path, LIGHT)
    hall.sensor.lux = 80.0
    hall.work()
    assert len(hall.seen) == 1


@pytest.mark.parametrize("later_lux", [1.0, 30.0])
def test_light_that_came_on_meanwhile_is_a_warning(tmp_path: Path, later_lux: float) -> None:
    hall = Hall(tmp_path, LIGHT)
    hall.later_lux = later_lux
    hall.work(dark=True)
    warnings = [text for level, text in hall.told.said if level is Level.WARNING]
    expected = AmbientLightLimit(hall.sensor, 2.0).warning(deadline=soon())
    assert warnings == ([] if later_lux < 2.0 else [expected])
    assert (expected is None) == (later_lux < 2.0)


@pytest.mark.parametrize(
    ("tables", "line", "word"),
    [
        (RELAYS.replace('"right"', '"nobody"'), 31, "not a projector"),
        (RELAYS.replace('"right"', '"left"'), 31, "another relay"),
        (RELAYS.replace("channel = 2", "channel = 1"), 30, "channel"),
        (RELAYS.replace("channel = 2", "channel = 0"), 30, "below 1"),
        (LIGHT.replace("2.0", "0.0"), 24, "not above 0"),
        (LIGHT.replace("most_lux", "most_luks"), 24, "most_luks"),
        (LIGHT.replace('"model"', '"colorhog"'), 23, "light_sensor driver"),
    ],
)
def test_wrong_tables_are_refused_with_their_line(tmp_path: Path, tables: str, line: int, word: str) -> None:
    hall = Hall(tmp_path, tables)
    with pytest.raises(UsageError) as caught:
        check_stage(tmp_path, drivers=hall.drivers)
    assert f"line {line}" in caught.value.what
    assert word in caught.value.what
