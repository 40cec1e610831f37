"""Relays that feed projectors: bytes to a board through real hidapi, and what then happens on the serial lines."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import serial

from controller.stage.rig.lamp_guard import LampGuard
from controller.stage.rig.power import Circuit, close_circuits, light, open_circuits, power_down
from hal.deadline import in_seconds
from hal.errors import DeviceError, DeviceRefused
from hal.registry import OpenContext
from lab.emulated.usb.mains import Mains
from lab.emulated.usb.process import UsbBusProcess
from plugins.emulated.core.truth import MainsTruth
from plugins.emulated.projectors.lamp import EmulatedLamp, LampTiming, quick_profile
from plugins.emulated.projectors.serial import EmulatedSerialProjector
from plugins.hid.relay import RelayBoard
from plugins.projectors.serial import open_serial_projector
from tests.controller.stage.rig.lamp_model import Shelf
from tests.waiting import eventually

LAMP = LampTiming(warm_up_s=0.2, cool_down_s=600.0)
QUICK = LampTiming(warm_up_s=0.2, cool_down_s=0.8)
BOOT_S = 0.5
SOON_S = 20.0


class Hall:
    """Two projectors, each behind a relay of one board, and the board's driver."""

    def __init__(self, bus: UsbBusProcess, folder: Path, lamp: LampTiming) -> None:
        bus.add("relay", "relay", channels=2, serial="MAINS")
        self.bus = bus
        self.folder = folder
        self.wires = {
            name: EmulatedSerialProjector(folder / name, EmulatedLamp(lamp), boot_s=BOOT_S)
            for name in ("left", "right")
        }
        for wire in self.wires.values():
            wire.start()
        circuits = [MainsTruth("relay", channel, (name,)) for channel, name in enumerate(self.wires, start=1)]
        self.told: list[tuple[str, bool, int]] = []
        self.mains = Mains(
            circuits,
            self.wires,
            lambda relay, count: [(channel, closed) for channel, closed in bus.call(relay, "moves_since", count)],
            lambda *told: self.told.append(told),
        )
        self.mains.start()
        self.board = RelayBoard(serial="MAINS", deadline=in_seconds(SOON_S))

    def end(self) -> None:
        self.board.close()
        self.mains.stop()
        for wire in self.wires.values():
            wire.stop()

    def lamp(self, name: str) -> EmulatedLamp:
        return self.wires[name].lamp

    def say(self, name: str, data: bytes, *, wait_s: float = SOON_S) -> bytes:
        """What comes back until a line ends."""
        with serial.Serial(str(self.wires[name].port), 9600, timeout=wait_s) as line:
            line.write(data)
            return bytes(line.read_until(b"\r"))

    def answers(self, name: str, answer: bytes) -> bool:
        """Whether it gives this answer about its power before long."""
        return eventually(lambda: self.say(name, b"~00124 1\r", wait_s=0.3) == answer)


@pytest.fixture(params=[LAMP])
def hall(bus: UsbBusProcess, tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Hall]:
    made = Hall(bus, tmp_path, request.param)
    yield made
    made.end()


def test_a_projector_without_mains_is_silent_and_boots_into_standby_when_it_has_them(hall: Hall) -> None:
    assert hall.say("left", b"~00124 1\r", wait_s=0.3) == b""
    given_s = time.monotonic()
    hall.board.switch(1, True, deadline=in_seconds(SOON_S))
    assert hall.answers("left", b"OK0\r")
    assert time.monotonic() - given_s >= BOOT_S
    assert hall.say("right", b"~00124 1\r", wait_s=0.3) == b"", "its relay is open"
    assert hall.told == [("left", False, 0), ("right", False, 0), ("left", True, 0)]


def test_mains_cut_from_a_burning_lamp_are_damage_and_from_a_cold_one_are_none(hall: Hall) -> None:
    subprocess.run(["usbrelay", "MAINS_1=1", "MAINS_2=1"], timeout=SOON_S, check=True, capture_output=True)
    assert hall.answers("left", b"OK0\r")
    assert hall.say("left", b"~0000 1\r") == b"P\r"
    assert hall.lamp("left").light_level() > 0
    subprocess.run(["usbrelay", "MAINS_1=0", "MAINS_2=0"], timeout=SOON_S, check=True, capture_output=True)
    assert eventually(lambda: hall.lamp("left").light_level() == 0)
    assert eventually(lambda: ("right", False, 0) in hall.told[2:])
    assert (hall.lamp("left").damages, hall.lamp("right").damages) == (1, 0)
    hall.board.switch(1, True, deadline=in_seconds(SOON_S))
    assert hall.answers("left", b"OK0\r")
    assert hall.say("left", b"~0000 1\r") == b"F\r", "as hot as it was cut, it must cool first"


def test_a_pulse_shorter_than_any_look_counts(hall: Hall) -> None:
    hall.board.switch(1, True, deadline=in_seconds(SOON_S))
    assert hall.answers("left", b"OK0\r")
    assert hall.say("left", b"~0000 1\r") == b"P\r"
    hall.bus.call("relay", "set_report", 3, 0, [0xFD, 1])
    hall.bus.call("relay", "set_report", 3, 0, [0xFF, 1])
    assert eventually(lambda: hall.lamp("left").damages == 1)


def test_a_board_that_is_unplugged_lets_go_of_its_relays(hall: Hall) -> None:
    hall.board.switch(1, True, deadline=in_seconds(SOON_S))
    assert hall.answers("left", b"OK0\r")
    hall.bus.unplug("relay")
    assert eventually(lambda: not hall.wires["left"].awake)
    hall.bus.plug("relay")
    assert hall.board.state(1, deadline=in_seconds(SOON_S)) is False
    assert not hall.wires["left"].awake


@pytest.mark.parametrize("hall", [QUICK], indirect=True)
def test_the_session_gives_mains_lights_and_cuts_them_without_damage(hall: Hall) -> None:
    """The code that a run uses, on the board's bytes and the projectors' bytes."""
    circuits = [
        Circuit(f"board {channel}", channel, (name,), BOOT_S, hall.board)
        for channel, name in enumerate(hall.wires, start=1)
    ]
    (hall.folder / "quick.toml").write_text(quick_profile(QUICK))
    close_circuits(circuits, deadline=in_seconds(60))
    guards = [
        LampGuard(name, open_serial_projector({"profile": "quick.toml", "port": name}, OpenContext(hall.folder),
                                              in_seconds(SOON_S)), Shelf())
        for name in hall.wires
    ]  # fmt: skip
    try:
        assert eventually(lambda: _answers(guards))
        light(guards, deadline=in_seconds(60), advance=lambda fraction, note: None)
        named = {guard.name: guard for guard in guards}
        with pytest.raises(DeviceRefused) as caught:
            circuits[0].open(named, deadline=in_seconds(SOON_S))
        assert caught.value.code == "mains-lamp-hot"
        assert power_down(guards) == ()
        assert open_circuits(circuits, guards) == ()
    finally:
        for guard in guards:
            guard.close()
    assert eventually(lambda: not any(wire.awake for wire in hall.wires.values()))
    assert [hall.lamp(name).strikes for name in hall.wires] == [1, 1]
    assert [hall.lamp(name).damages for name in hall.wires] == [0, 0]


def _answers(guards: list[LampGuard]) -> bool:
    """Whether all have booted; under load that may be later than ``boot_s`` after the relay."""
    try:
        return all(guard.status(deadline=in_seconds(SOON_S)) for guard in guards)
    except DeviceError:
        return False
