"""Drivers that never return: the call is left behind, the device is named, and the other devices continue."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from controller.run.signals import cancelled_by_signals
from controller.stage.rig.lamp_guard import LampGuard
from controller.stage.rig.lamp_ledger import LampFile
from controller.stage.rig.power import power_down
from hal.deadline import Deadline, Stop, in_seconds
from hal.driver_calls import Caller
from hal.errors import DriverFault
from hal.registry import Driver, OpenContext, open_device
from hal.values import DeviceIdentity, LampRules, Power, ProjectorCapabilities, ProjectorStatus
from tests.waiting import wait_for

CAN = ProjectorCapabilities(False, False, (), False, LampRules(0, 0, 0, 0))


class Hanging:
    """A projector whose calls in ``hangs`` end only when ``freed`` is set."""

    def __init__(self, *hangs: str) -> None:
        self.hangs = hangs
        self.freed = threading.Event()
        self.called: list[str] = []
        self.threads: list[int] = []

    def did(self, name: str, result: Any = None) -> Any:
        self.called.append(name)
        self.threads.append(threading.get_ident())
        if name in self.hangs:
            self.freed.wait(60)
        return result

    @property
    def capabilities(self) -> ProjectorCapabilities:
        return CAN

    def identity(self, *, deadline: Deadline) -> Any:
        return self.did("identity", DeviceIdentity("Acme", "A1"))

    def status(self, *, deadline: Deadline) -> Any:
        return self.did("status", ProjectorStatus(Power.ON))

    def switch_on(self, *, deadline: Deadline) -> Any:
        return self.did("switch_on")

    def switch_off(self, *, deadline: Deadline) -> Any:
        return self.did("switch_off")

    def set_shutter(self, closed: bool, *, deadline: Deadline) -> Any:
        return self.did("set_shutter")

    def close(self) -> Any:
        return self.did("close")


@pytest.fixture
def made() -> Iterator[list[Hanging]]:
    """What the tests made; nothing of it hangs afterwards."""
    devices: list[Hanging] = []
    yield devices
    for device in devices:
        device.freed.set()


def checked(made: list[Hanging], *hangs: str, grace_s: float = 0.1) -> tuple[Any, Hanging]:
    made.append(Hanging(*hangs))
    who = "The driver 'acme' of projector left"
    return Caller(who, grace_s=grace_s).device("projector", made[-1]), made[-1]


def test_a_call_past_its_deadline_is_left_behind_and_named(made: list[Hanging]) -> None:
    device, hanging = checked(made, "status")
    began_s = time.monotonic()
    with pytest.raises(DriverFault) as caught:
        device.status(deadline=in_seconds(0.1))
    assert time.monotonic() - began_s < 5
    assert caught.value.code == "driver-stuck"
    for word in ("'acme'", "projector left", "status"):
        assert word in caught.value.what
    # While it hangs, the device is still switched off and closed.
    device.switch_off(deadline=in_seconds(1))
    device.close()
    assert hanging.called == ["status", "switch_off", "close"]


def test_calls_that_all_hang_are_bounded_and_accepted_again_once_they_end(made: list[Hanging]) -> None:
    device, hanging = checked(made, "status", grace_s=0.0)
    for _ in range(6):
        with pytest.raises(DriverFault):
            device.status(deadline=in_seconds(0))
    assert hanging.called == ["status"] * 4
    hanging.freed.set()
    wait_for(lambda: _answers(device))


def _answers(device: Any) -> bool:
    try:
        return bool(device.status(deadline=in_seconds(5)).power is Power.ON)
    except DriverFault:
        return False


def test_one_call_after_the_other_has_the_same_thread(made: list[Hanging]) -> None:
    device, hanging = checked(made)
    for _ in range(20):
        device.identity(deadline=in_seconds(5))
    assert len(set(hanging.threads)) == 1
    assert threading.get_ident() not in hanging.threads


def test_a_closed_or_forgotten_device_leaves_no_thread(made: list[Hanging]) -> None:
    before = threading.active_count()
    for number in range(5):
        device, _ = checked(made)
        device.identity(deadline=in_seconds(5))
        if number % 2:
            device.close()
        del device
    wait_for(lambda: threading.active_count() <= before)


def test_a_cancelled_call_that_goes_on_is_left_behind_at_once_when_it_is_urgent(made: list[Hanging]) -> None:
    device, _ = checked(made, "status", grace_s=60.0)
    stop = Stop()
    threading.Timer(0.1, stop.again).start()
    threading.Timer(0.2, stop.again).start()
    began_s = time.monotonic()
    with pytest.raises(DriverFault):
        device.status(deadline=in_seconds(60, stop))
    assert time.monotonic() - began_s < 20


def test_what_opens_too_late_is_closed(made: list[Hanging]) -> None:
    made.append(Hanging())
    began, freed, stop = threading.Event(), threading.Event(), Stop()

    def open_late(*_: object) -> Hanging:
        began.set()
        freed.wait(60)
        return made[-1]

    def stop_it() -> None:
        began.wait(60)
        stop.again()
        stop.again()

    threading.Thread(target=stop_it, daemon=True).start()
    with pytest.raises(DriverFault) as caught:
        open_device(Driver("projector", "acme", "a test", open_late), {}, OpenContext(Path()), in_seconds(60, stop))
    assert "did not return from open" in caught.value.what
    freed.set()
    wait_for(lambda: made[-1].called == ["close"])


def test_ctrl_c_twice_ends_a_call_that_hangs_and_the_lamp_gets_its_off_command(
    made: list[Hanging], tmp_path: Path
) -> None:
    """As a run does: the work ends by its error, then ``power_down`` switches every lamp off."""
    device, hanging = checked(made, "status", grace_s=1.0)
    other, calm = checked(made)
    guards = [LampGuard(name, it, LampFile(tmp_path / "lamps")) for name, it in (("left", device), ("right", other))]

    def press() -> None:
        wait_for(lambda: "status" in hanging.called)
        for _ in range(2):
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(0.1)

    with cancelled_by_signals() as cancel:
        threading.Thread(target=press, daemon=True).start()
        with pytest.raises(DriverFault, match="projector left"):
            device.status(deadline=in_seconds(3600, cancel))
        calm.called.clear()
        failures = power_down(guards, within_s=0.5)
    assert [failure.projector for failure in failures if failure.projector == "left"] == ["left"]
    assert "switch_off" in hanging.called
    assert "switch_off" in calm.called
