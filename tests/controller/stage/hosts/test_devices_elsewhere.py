"""A projector on another computer: asked over its agent, and kept by the lamps' rules without the stage."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Iterator
from dataclasses import replace
from typing import cast

import pytest
from pymodbus.client import ModbusTcpClient

from controller.core.errors import UsageError
from controller.stage.rig.lamp_guard import LampGuard
from controller.stage.rig.lamp_ledger import LampFile
from controller.stage.sessions.check import Checked, check_stage
from controller.stage.sessions.open import mains_circuits, open_device, open_projector
from hal.conformance import PowerSwitchConformance
from hal.deadline import in_seconds
from hal.errors import DeviceGone, DeviceRefused, PluginError
from hal.interfaces import PowerSwitch
from hal.registry import OpenContext
from hal.values import Power
from plugins.emulated.projectors.lamp import EmulatedLamp, LampPhase, LampTiming, quick_profile
from plugins.emulated.projectors.serial import EmulatedSerialProjector
from tests.controller.stage.hosts.computers import Computers, running
from tests.plugins.mains.test_network_mains import ModbusServer
from tests.waiting import wait_for

TIMING = LampTiming(warm_up_s=0.5, cool_down_s=1.0)
STAGE = """\
[stage]
name = "two"
[[projectors]]
name = "P"
output = "left"
driver = "serial"
host = "left.local"
port = "{port}"
profile = "quick.toml"
[camera]
driver = "ptp"
iso = 100
address = "ptpip:127.0.0.1"
[display]
driver = "player"
alone_s = 2.0
alone = "{alone}"
[[display.outputs]]
name = "left"
width_px = 40
height_px = 30
host = "left"
"""

RELAYS = """
[[relays]]
name = "cupboard"
driver = "modbus-relays"
host = "left.local"
address = "127.0.0.1:{port}"
channels = 3
boot_s = 0
[[relays.mains]]
channel = 1
feeds = ["P"]
"""


@pytest.fixture(scope="module")
def computers(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Computers]:
    computers = Computers(tmp_path_factory.mktemp("two"), ["left"], None)
    computers.place("left").mkdir()
    for folder in (computers.folder, computers.place("left")):
        (folder / "quick.toml").write_text(quick_profile(TIMING))
    with running(computers):
        yield computers


@pytest.fixture
def lamp(computers: Computers) -> Iterator[EmulatedLamp]:
    lamp = EmulatedLamp(TIMING)
    with EmulatedSerialProjector(computers.folder / "tty", lamp):
        yield lamp


@pytest.fixture(scope="module")
def relays() -> Iterator[ModbusServer]:
    server = ModbusServer()
    yield server
    server.close()


def checked(computers: Computers, alone: str = "black", relays: int | None = None, **changes: str) -> Checked:
    """``relays``: the port of a board."""
    text = STAGE.format(port=computers.folder / "tty", alone=alone)
    text += "" if relays is None else RELAYS.format(port=relays)
    for old, new in changes.items():
        text = text.replace(f'{old} = "', f'{old} = "{new}', 1)
    (computers.folder / "stage.toml").write_text(text)
    return check_stage(computers.folder)


def opened(computers: Computers, stage: Checked) -> LampGuard:
    context = OpenContext(computers.folder, runtime=computers.folder)
    projector = open_projector(stage, 0, context, in_seconds(20))
    return LampGuard("P", projector, LampFile(computers.folder / "lamps.json"))


def lit(computers: Computers, lamp: EmulatedLamp, alone: str = "black") -> LampGuard:
    guard = opened(computers, checked(computers, alone))

    def shines() -> bool:
        with contextlib.suppress(DeviceRefused):
            guard.switch_on(deadline=in_seconds(10))
        return guard.status(deadline=in_seconds(5)).power is Power.ON

    wait_for(shines)
    assert lamp.phase is LampPhase.LIT
    return guard


def test_a_projector_elsewhere_is_one_of_the_stage(computers: Computers, lamp: EmulatedLamp) -> None:
    guard = lit(computers, lamp)
    here = open_projector(checked(computers), 0, OpenContext(computers.folder, runtime=computers.folder), in_seconds(9))
    assert guard.capabilities == LampGuard("P", here, LampFile(computers.folder / "other.json")).capabilities
    assert guard.identity(deadline=in_seconds(5)).maker
    # A computer that is gone is said at once, and its lamp can be switched off as soon as it is back.
    computers.processes["left"].send_signal(signal.SIGSTOP)
    wait_for(lambda: computers.status()["lost_hosts"] == ["left"])
    with pytest.raises(DeviceGone, match="left"):
        guard.status(deadline=in_seconds(5))
    computers.processes["left"].send_signal(signal.SIGCONT)
    wait_for(lambda: computers.status()["lost_hosts"] == [])
    guard.switch_off(deadline=in_seconds(10))
    # The computer keeps the rules by itself, whatever the stage remembers.
    forgetful = LampGuard("P", here, LampFile(computers.folder / "new.json"))
    with pytest.raises(DeviceRefused) as caught:
        forgetful.switch_on(deadline=in_seconds(5))
    assert caught.value.code in ("lamp-cooling", "lamp-resting")
    assert lamp.strikes == 1
    here.close()


def test_a_lamp_without_the_stage_goes_off_after_the_stated_time(computers: Computers, lamp: EmulatedLamp) -> None:
    guard = lit(computers, lamp)
    computers.processes["here"].send_signal(signal.SIGSTOP)
    try:
        wait_for(lambda: lamp.phase is not LampPhase.LIT)
        assert lamp.damages == 0
    finally:
        computers.processes["here"].send_signal(signal.SIGCONT)
    wait_for(lambda: computers.status()["lost_hosts"] == [])
    assert guard.status(deadline=in_seconds(10)).power in (Power.OFF, Power.COOLING)
    guard.close()


def test_an_agent_that_starts_again_alone_knows_what_burns(computers: Computers, lamp: EmulatedLamp) -> None:
    lit(computers, lamp)
    computers.processes["here"].send_signal(signal.SIGSTOP)
    try:
        computers.kill("left")
        computers.follow("left")
        wait_for(lambda: lamp.phase is not LampPhase.LIT)
    finally:
        computers.processes["here"].send_signal(signal.SIGCONT)
    wait_for(lambda: computers.status()["lost_hosts"] == [])


def test_an_agent_that_ends_leaves_no_lamp_lit(computers: Computers, lamp: EmulatedLamp) -> None:
    lit(computers, lamp, "on")
    computers.processes["left"].terminate()
    computers.processes["left"].wait(30)
    assert lamp.phase is not LampPhase.LIT
    wait_for(lambda: computers.status()["lost_hosts"] == ["left"])
    computers.follow("left")
    wait_for(lambda: computers.status()["lost_hosts"] == [])


def test_what_can_not_be_is_refused_before_anything_is_opened(computers: Computers, lamp: EmulatedLamp) -> None:
    with pytest.raises(UsageError, match=r"line 7: in .* 'host' = 'unleft' has no output of the display"):
        checked(computers, host="un")
    stage = checked(computers)
    context = OpenContext(computers.folder, runtime=computers.folder)
    (there,) = stage.elsewhere
    there.ask(context, "check", deadline=in_seconds(10))
    (computers.place("left") / "quick.toml").rename(computers.folder / "away")
    try:
        with pytest.raises(PluginError, match=r"The computer left: .*quick\.toml does not exist"):
            there.ask(context, "check", deadline=in_seconds(10))
    finally:
        (computers.folder / "away").rename(computers.place("left") / "quick.toml")
    # Its version has no such driver.
    older = replace(there, driver="acme")
    with pytest.raises(PluginError, match="The computer left: There is no projector driver 'acme'"):
        older.ask(context, "check", deadline=in_seconds(10))
    assert lamp.strikes == 0


class TestRelaysElsewhere(PowerSwitchConformance):
    """A board on the other computer keeps what every board has to."""

    @pytest.fixture
    def power_switch(self, computers: Computers, relays: ModbusServer) -> Iterator[PowerSwitch]:
        stage, context = checked(computers, relays=relays.port), OpenContext(computers.folder, runtime=computers.folder)
        table, (driver, settings) = stage.stage.tables.relays[0], stage.relays[0]
        board = cast("PowerSwitch", open_device(table, driver, settings, context, in_seconds(20)))
        yield board
        board.close()


def test_a_relay_elsewhere_keeps_the_mains_of_a_lamp_that_burns(
    computers: Computers, lamp: EmulatedLamp, relays: ModbusServer
) -> None:
    guard, context = lit(computers, lamp), OpenContext(computers.folder, runtime=computers.folder)
    with contextlib.ExitStack() as stack, ModbusTcpClient("127.0.0.1", port=relays.port) as client:
        stage = checked(computers, relays=relays.port)
        (circuit,) = mains_circuits(stage, context, stack, in_seconds(20))
        circuit.close(deadline=in_seconds(10))
        assert client.read_coils(0, count=3).bits[:3] == [True, False, False], "another program sees it at the board"
        with pytest.raises(DeviceRefused) as caught:
            circuit.open({"P": guard}, deadline=in_seconds(10))
        assert caught.value.code == "mains-lamp-hot"
        guard.switch_off(deadline=in_seconds(10))
        wait_for(lambda: guard.may_open_mains(deadline=in_seconds(5)))
        circuit.open({"P": guard}, deadline=in_seconds(10))
        assert not client.read_coils(0, count=1).bits[0]
        # What is at a computer that is lost is not known.
        computers.processes["left"].send_signal(signal.SIGSTOP)
        wait_for(lambda: computers.status()["lost_hosts"] == ["left"])
        with pytest.raises(DeviceGone, match="left"):
            circuit.on(deadline=in_seconds(5))
        computers.processes["left"].send_signal(signal.SIGCONT)
        wait_for(lambda: computers.status()["lost_hosts"] == [])
    guard.close()
