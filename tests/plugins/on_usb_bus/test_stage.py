"""A run on a stage whose relays and light sensor are real drivers on the emulated bus."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pytest

from controller.run.runner import Context, Step
from controller.run.step_id import StepId
from controller.stage.rig.rig import Rig
from controller.stage.sessions.check import check_stage
from controller.stage.sessions.session import OwnSession, StageWork
from hal.errors import DeviceRefused
from hal.registry import Drivers, load_drivers
from lab.emulated.usb.process import UsbBusProcess
from tests.controller.stage.sessions.run_models import STAGE, Models

TABLES = """
[[relays]]
name = "board"
driver = "usb-relay"
serial = "STAGE"
boot_s = 0
[[relays.mains]]
channel = 2
feeds = ["left", "right"]
[light_sensor]
driver = "colorhug-als"
most_lux = 2.0
"""


def run(models: Models, bus: UsbBusProcess) -> list[list[bool]]:
    """Run a step in the dark; the relays as they were during it."""
    found = load_drivers()
    assert not found.broken
    real = [driver for driver in found.list if driver.kind in ("power_switch", "light_sensor")]
    (models.folder / "stage.toml").write_text(STAGE + TABLES)
    checked = check_stage(models.folder, drivers=Drivers((*models.drivers.list, *real)))
    seen: list[list[bool]] = []

    def steps(rig: Rig, _: Path) -> Sequence[Step]:
        def look(context: Context) -> Sequence[Path]:
            assert all(lamp.lit for lamp in models.lamps.values())
            seen.append(bus.get("relay", "state"))
            return ()

        return [Step(StepId("look"), look)]

    OwnSession(checked.stage.folder).run(
        checked, StageWork("trial", steps, dark=True), reporter=models.told, cancel=models.cancel
    )
    return seen


def test_mains_are_on_for_the_run_and_cut_after_it(bus: UsbBusProcess, tmp_path: Path) -> None:
    bus.add("relay", "relay", channels=2, serial="STAGE")
    bus.add("light", "light", lux=0.5)
    assert run(Models(tmp_path), bus) == [[False, True]]
    assert bus.get("relay", "state") == [False, False]
    assert bus.get("relay", "switched") == [0, 2]


def test_a_bright_room_is_refused_and_the_mains_are_cut(bus: UsbBusProcess, tmp_path: Path) -> None:
    bus.add("relay", "relay", channels=2, serial="STAGE")
    bus.add("light", "light", lux=300.0)
    models = Models(tmp_path)
    with pytest.raises(DeviceRefused) as caught:
        run(models, bus)
    assert caught.value.code == "room-not-dark"
    assert not any(lamp.lit for lamp in models.lamps.values())
    assert bus.get("relay", "state") == [False, False]
