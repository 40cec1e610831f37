"""Devices that a kiosk lends to work, and what is said when one leaves meanwhile."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from controller.kiosk.service import Service
from controller.kiosk.state import DeviceRow
from controller.kiosk.store.event_log import EventLog
from controller.kiosk.supervisors import projector_supervisor
from controller.kiosk.supervisors.device_supervisor import DeviceSupervisor
from controller.kiosk.supervisors.devices import Devices
from controller.kiosk.supervisors.projector_supervisor import MOST_STRIKES, Pace
from controller.kiosk.world import World
from controller.stage.rig.lamp_ledger import LampFile, LampRecord
from controller.stage.sessions.check import check_stage
from hal.deadline import Deadline
from hal.errors import DeviceGone
from hal.notices import Notice
from hal.registry import Driver, Drivers
from hal.values import ProjectorCapabilities, ProjectorStatus
from tests.controller.stage.sessions.run_models import Models, QuickLamp


@pytest.fixture
def models(tmp_path: Path) -> Models:
    return Models(tmp_path)


@pytest.fixture
def devices(models: Models, tmp_path: Path) -> Iterator[Devices]:
    told: list[Notice] = []
    found = Devices(check_stage(models.folder, drivers=models.drivers), tmp_path, told.append)
    found.camera.step()
    for supervisor in found.projectors:
        supervisor.step()
    with contextlib.closing(found):
        yield found


def test_work_whose_projector_is_lost_meanwhile_says_which_and_not_that_somebody_closed_it(
    devices: Devices, models: Models, monkeypatch: pytest.MonkeyPatch
) -> None:
    def silent(lamp: QuickLamp, *, deadline: Deadline) -> ProjectorStatus:
        raise DeviceGone("port-gone", what="The port went away.", remedy="Plug it in.")

    def closed() -> DeviceGone:
        return DeviceGone("projector-closed", what="The projector at A is no longer open.", remedy="Open the stage.")

    monkeypatch.setattr(projector_supervisor, "PATIENCE_S", 0.0)
    with pytest.raises(DeviceGone, match="no longer open"), devices.lent():
        raise closed()
    with pytest.raises(DeviceGone) as caught, devices.lent():  # noqa: PT012 - the supervisor works meanwhile
        monkeypatch.setattr(QuickLamp, "status", silent)
        devices.projectors[0].pace = Pace(0.0, 0.0)
        devices.projectors[0].step()
        assert not models.lamps["A"].open
        raise closed()
    assert caught.value.code == "device-missing"
    assert "without projector left" in caught.value.what
    assert "Repair it first." in caught.value.remedy


class LosesItMeanwhile:
    """A supervisor's lock that somebody waits for while the supervisor's look finds the device gone."""

    def __init__(self, supervisor: DeviceSupervisor) -> None:
        self._supervisor = supervisor

    def __enter__(self) -> None:
        self._supervisor.close()

    def __exit__(self, *_: object) -> None:
        """Free again."""


def test_a_camera_that_its_keeper_loses_while_work_waits_for_it_is_not_lent(
    devices: Devices, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(devices.camera, "lent", LosesItMeanwhile(devices.camera))
    with pytest.raises(DeviceGone) as caught, devices.lent():
        pytest.fail("a closed camera was lent")
    assert caught.value.code == "device-missing"


def test_a_device_that_opens_after_its_keeper_was_closed_is_let_go_of() -> None:
    opened: list[QuickLamp] = []

    def open_slowly(deadline: Deadline) -> QuickLamp:
        supervisor.close()  # the service ends while the device is still being opened
        opened.append(QuickLamp())
        return opened[0]

    supervisor = DeviceSupervisor(DeviceRow("camera", "camera", "model"), open_slowly, lambda *_: (), lambda _: None)
    supervisor.step()
    assert [one.open for one in opened] == [False]
    assert supervisor.device is None


def test_devices_that_fail_to_close_or_raise_anything_are_told_and_the_others_go_on(
    models: Models, tmp_path: Path
) -> None:
    told: list[Notice] = []
    models.unclosable = {"A"}
    models.odd_in = "The lamp hours of projector left stay unknown."
    found = Devices(check_stage(models.folder, drivers=models.drivers), tmp_path, told.append)
    for supervisor in found.projectors:
        supervisor.step()
    models.lamps["A"].odd = ZeroDivisionError("a mistake")
    for supervisor in found.projectors:
        supervisor.step()
    right = found.projectors[1].view
    assert right.problem is None
    assert right.looked
    found.close()
    assert not models.lamps["B"].open
    assert [one.what for one in told if one.code == "projector-answer-odd"] == [models.odd_in]
    faults = [decision for decision in told if decision.code == "driver-fault"]
    assert any("projector left raised OSError" in fault.what for fault in faults)


def test_an_opening_before_a_projector_was_reached_counts_on_from_the_file_of_the_lamps(
    models: Models, tmp_path: Path
) -> None:
    file = models.folder / LampFile.NAME
    given_up = LampRecord(since_s=0.0, boot=World().boot(), strikes=7, failed=MOST_STRIKES)
    LampFile(file).write("left", given_up)
    found = Devices(check_stage(models.folder, drivers=models.drivers), tmp_path, lambda _: None)
    with contextlib.closing(found):
        left = found.projectors[0]
        left.want_lit = False
        left.want_lit = True
        assert LampFile(file).read("left") == replace(given_up, failed=MOST_STRIKES - 1), "before it is reached"
        left.step()
    record = LampFile(file).read("left")
    assert record is not None
    assert (record.strikes, record.failed) == (8, MOST_STRIKES)


class SlowLamp(QuickLamp):
    """Takes its time for a strike, as projectors do that answer nothing while they start."""

    def __init__(self) -> None:
        super().__init__()
        self.asked, self.answered = threading.Event(), threading.Event()

    @property
    def capabilities(self) -> ProjectorCapabilities:
        return replace(super().capabilities, power=True)

    def switch_on(self, *, deadline: Deadline) -> None:
        self.asked.set()
        self.answered.wait(5)
        super().switch_on(deadline=deadline)

    def switch_off(self, *, deadline: Deadline) -> None:
        if not self.open:
            raise DeviceGone("port-closed", what="The port is closed.", remedy="Open it.")
        super().switch_off(deadline=deadline)


def test_a_service_that_ends_in_the_middle_of_a_strike_waits_for_the_lamp_to_go_off(models: Models) -> None:
    text = (models.folder / "stage.toml").read_text()
    (models.folder / "stage.toml").write_text(text.replace("power_down_s = 0.3", "power_down_s = 60"))
    lamp, log = SlowLamp(), EventLog(models.folder / EventLog.FILE, durable=False)
    projectors = Driver("projector", "model", "A lamp.", lambda *_: lamp, {"port": "the port"}, ("port",))
    drivers = Drivers((projectors, models.drivers.get("camera", "model"), models.drivers.get("display", "model")))

    class Answering(World):
        def sleep(self, seconds: float, deadline: Deadline | None = None) -> None:
            lamp.answered.set()
            super().sleep(seconds, deadline)

    found = Service(check_stage(models.folder, drivers=drivers), log, world=Answering())
    supervisor, over = found.devices.projectors[0], threading.Event()
    supervisor.want_lit = True

    def looking() -> None:
        while not over.wait(0.1):
            supervisor.step()

    thread = threading.Thread(target=looking)
    thread.start()
    assert lamp.asked.wait(20)
    found.end(leave_lit=False)
    over.set()
    thread.join(20)
    log.close()
    assert not lamp.lit
