"""Relays that follow the lamps, on boards and with projectors that vanish at the wrong moment."""

from __future__ import annotations

import contextlib
import itertools
import threading
from dataclasses import dataclass, field

import pytest

from controller.kiosk import world as kiosk_world
from controller.kiosk.state import DeviceRow, LiveValue
from controller.kiosk.supervisors.device_supervisor import DeviceSupervisor
from controller.kiosk.supervisors.mains_supervisor import Boards, MainsSupervisor
from controller.kiosk.supervisors.projector_supervisor import Mains as ProjectorsMains
from controller.kiosk.supervisors.projector_supervisor import ProjectorSupervisor
from controller.stage.rig.lamp_guard import LampGuard
from controller.stage.rig.power import Circuit
from hal.deadline import Deadline, in_seconds
from hal.errors import DeviceGone
from hal.interfaces import Device
from hal.notices import Notice
from hal.values import DeviceIdentity
from tests.controller.stage.rig.lamp_model import Lamp, Shelf, World


class KioskWorld(kiosk_world.World):
    """Time as the lamps have it; deadlines in real time."""

    def __init__(self, lamps: World) -> None:
        self._lamps = lamps

    def monotonic(self) -> float:
        return self._lamps.now_s()

    def deadline(self, seconds: float, cancel: threading.Event | None = None) -> Deadline:
        return in_seconds(seconds, cancel)


BOOT_S = 3.0


@dataclass
class Board:
    """One relay; ``gone`` while its cable is away."""

    closed: bool = False
    gone: bool = False

    def identity(self, *, deadline: Deadline) -> DeviceIdentity:
        return DeviceIdentity("Model", "Board")

    def close(self) -> None:
        """Nothing to release."""

    def channels(self, *, deadline: Deadline) -> int:
        return 1

    def state(self, channel: int, *, deadline: Deadline) -> bool:
        self._reached()
        return self.closed

    def switch(self, channel: int, closed: bool, *, deadline: Deadline) -> None:
        self._reached()
        self.closed = closed

    def _reached(self) -> None:
        if self.gone:
            raise DeviceGone("hid-unplugged", what="No board.", remedy="Plug it in.")


@dataclass
class Mains:
    """Two projectors, each on the relay of a board of its own, in virtual time."""

    world: World = field(default_factory=World)
    told: list[Notice] = field(default_factory=list)
    shelf: Shelf = field(default_factory=Shelf)

    def __post_init__(self) -> None:
        self.lamps = {name: Lamp(self.world) for name in ("left", "right")}
        self.boards = {name: Board() for name in self.lamps}
        self.begin()

    def begin(self) -> None:
        """The service begins."""
        self.supervisors = {name: self._supervisor(name) for name in self.lamps}
        self.relays = MainsSupervisor("model", self._open, self.told.append, KioskWorld(self.world))
        self.relays.supervisors = tuple(self.supervisors.values())

    def _open(self, deadline: Deadline) -> Device:
        return Boards(tuple(Circuit(name, 1, (name,), BOOT_S, board) for name, board in self.boards.items()),
                      contextlib.ExitStack())  # fmt: skip

    def _supervisor(self, name: str) -> ProjectorSupervisor:
        def open_guard(deadline: Deadline) -> LampGuard:
            return LampGuard(name, self.lamps[name], self.shelf, clock=self.world)

        return ProjectorSupervisor(name, open_guard, self.told.append, clock=self.world,
                               mains=ProjectorsMains(asleep=lambda: self.relays.silences(name)))  # fmt: skip

    def run(self, seconds: float) -> None:
        for _ in range(int(seconds)):
            self.relays.step()
            for supervisor in self.supervisors.values():
                supervisor.step()
            self.world.time_s += 1.0

    def want(self, light: bool) -> None:
        self.relays.want_on = light
        for supervisor in self.supervisors.values():
            supervisor.want_lit = light

    @property
    def values(self) -> dict[str, str]:
        return {value.label: value.text for value in self.relays.row.values}

    @property
    def closed(self) -> list[str]:
        return [name for name, board in self.boards.items() if board.closed]


@pytest.fixture
def mains() -> Mains:
    """Lit for a minute."""
    found = Mains()
    found.want(True)
    found.run(60)
    assert found.closed == ["left", "right"]
    assert [name for name, lamp in found.lamps.items() if lamp.lit_at_s is not None] == ["left", "right"]
    return found


def test_mains_are_cut_when_the_lamps_have_cooled_and_the_projectors_are_left_in_peace(mains: Mains) -> None:
    mains.want(False)
    mains.run(2)
    assert mains.closed == ["left", "right"]
    assert set(mains.values.values()) == {"on until the lamps have cooled"}
    mains.run(20)
    assert mains.closed == []
    assert mains.values == {"left": "off", "right": "off"}
    mains.lamps["left"].trouble = "silent"
    mains.run(60)
    assert mains.supervisors["left"].view.problem is None, "it has no mains"
    assert [one.code for one in mains.told].count("mains-off") == 2


def test_a_service_that_begins_gives_mains_so_that_it_can_ask_what_the_lamps_do() -> None:
    mains = Mains()
    mains.relays.step()
    assert mains.closed == ["left", "right"]
    assert [one.code for one in mains.told] == ["mains-on", "mains-on"]
    mains.world.time_s += 2.0
    mains.relays.step()
    assert len(mains.told) == 2, "once"


def test_projectors_that_boot_are_asked_nothing(mains: Mains) -> None:
    mains.want(False)
    mains.run(30)
    mains.want(True)
    mains.relays.step()
    mains.world.time_s += 1.0
    mains.relays.step()
    assert mains.closed == ["left", "right"]
    assert mains.relays.silences("left")
    mains.world.time_s += BOOT_S
    assert not mains.relays.silences("left")


def test_a_silent_projector_keeps_its_own_mains_and_those_of_no_other(mains: Mains) -> None:
    mains.want(False)
    mains.run(2)
    mains.lamps["left"].trouble = "silent"
    mains.run(30)
    assert mains.closed == ["left"], "nobody knows whether its lamp has cooled"
    assert "device-back" not in [one.code for one in mains.told], "the relays were well all the time"
    mains.lamps["left"].trouble = ""
    mains.run(60)
    assert mains.closed == []


def test_a_relay_that_is_gone_is_told_and_keeps_no_other_lamp_lit_or_dark(mains: Mains) -> None:
    mains.want(False)
    mains.run(2)
    mains.boards["left"].gone = True
    mains.run(30)
    assert mains.closed == ["left"]
    assert mains.relays.problem is not None
    assert mains.relays.problem.code == "hid-unplugged"
    assert mains.values == {}, "nobody knows"
    mains.want(True)
    mains.run(60)
    assert mains.closed == ["left", "right"]
    assert mains.lamps["right"].lit_at_s is not None
    mains.boards["left"].gone = False
    mains.run(90)
    assert mains.relays.problem is None
    assert mains.values == {"left": "on", "right": "on"}


def test_a_projector_whose_mains_can_not_be_given_is_told_of_as_lost(mains: Mains) -> None:
    mains.want(False)
    mains.run(30)
    assert mains.closed == []
    mains.boards["left"].gone, mains.lamps["left"].trouble = True, "silent"
    mains.want(True)
    mains.run(60)
    assert mains.supervisors["left"].view.problem is not None
    assert mains.lamps["right"].lit_at_s is not None


def test_a_board_that_leaves_while_its_mains_are_cut_is_told_of_before_the_next_opening(mains: Mains) -> None:
    mains.want(False)
    mains.run(30)
    mains.boards["left"].gone = True
    mains.run(10)
    assert mains.relays.problem is not None
    assert mains.supervisors["left"].view.problem is None
    mains.boards["left"].gone = False
    mains.run(20)
    assert mains.values == {"left": "off", "right": "off"}


def test_a_board_that_takes_its_projectors_mains_with_it_is_told_of_and_not_their_silence(mains: Mains) -> None:
    mains.boards["left"].gone, mains.boards["left"].closed, mains.lamps["left"].trouble = True, False, "silent"
    mains.want(False)
    mains.run(30)
    assert mains.relays.problem is not None
    assert mains.relays.problem.code == "hid-unplugged"
    mains.boards["left"].gone = False
    mains.run(20)
    assert mains.values == {"left": "off", "right": "off"}
    assert mains.supervisors["left"].view.problem is None, "it has no mains"


def test_mains_that_somebody_else_gave_are_cut_again_once_the_lamps_are_known_to_be_cold(mains: Mains) -> None:
    mains.want(False)
    mains.run(30)
    mains.boards["left"].closed = True
    mains.lamps["left"].trouble = "silent"
    mains.run(10)
    assert mains.closed == ["left"]
    mains.lamps["left"].trouble = ""
    mains.run(10)
    assert mains.closed == []


def test_a_service_that_begins_while_the_mains_are_cut_asks_nobody_behind_them(mains: Mains) -> None:
    mains.want(False)
    mains.run(30)
    mains.told.clear()
    mains.begin()
    mains.want(False)
    for lamp in mains.lamps.values():
        lamp.trouble = "silent"
    mains.run(60)
    assert mains.closed == []
    assert mains.values == {"left": "off", "right": "off"}
    assert [one.code for one in mains.told if one.level == "error"] == []


@dataclass
class Sensor:
    """A device that is looked at; ``trouble`` is what the next look raises. Counts those that are open."""

    trouble: str = ""
    opens: bool = True
    open: int = 0
    looks: int = 0

    def identity(self, *, deadline: Deadline) -> DeviceIdentity:
        self.looks += 1
        if self.trouble:
            raise DeviceGone(self.trouble, what=f"It is {self.trouble}.", remedy="Mend it.")
        return DeviceIdentity("Model", "Sensor")

    def close(self) -> None:
        self.open -= 1

    def opened(self, deadline: Deadline) -> Device:
        if not self.opens:
            raise DeviceGone("missing", what="It is missing.", remedy="Plug it in.")
        self.open += 1
        return self


def test_a_device_is_opened_again_less_and_less_often_and_told_of_once_a_trouble() -> None:
    world, sensor, told = World(), Sensor(opens=False), list[Notice]()

    def look(device: Device, deadline: Deadline) -> tuple[LiveValue, ...]:
        return (LiveValue("Model", device.identity(deadline=deadline).model),)

    row = DeviceRow("sensor", "sensor", "model")
    supervisor = DeviceSupervisor(row, sensor.opened, look, told.append, every_s=10.0, world=KioskWorld(world))

    def run(seconds: int) -> None:
        for _ in range(seconds):
            supervisor.step()
            world.time_s += 1.0

    run(200)
    assert [one.code for one in told] == ["missing"]
    assert supervisor.device is None
    sensor.opens = True
    run(60)
    assert [one.code for one in told] == ["missing", "device-back"]
    assert [value.text for value in supervisor.row.values] == ["Sensor"]
    sensor.trouble, looked_s = "silent", list[int]()
    for second in range(200):
        before = sensor.looks
        run(1)
        looked_s += [second] * (sensor.looks - before)
    lost_s = looked_s[0]
    pauses = [(at_s - lost_s, after_s - at_s) for at_s, after_s in itertools.pairwise(looked_s)]
    assert all(2 <= pause_s <= 15 and pause_s <= max(2, missing_s / 3) for missing_s, pause_s in pauses), pauses
    assert pauses[-1][1] >= 14, "it is asked rarely in the end"
    assert sensor.open == 0, "what does not answer is let go of"
    assert (supervisor.row.problem, supervisor.row.remedy, supervisor.row.values) == ("It is silent.", "Mend it.", ())
    sensor.trouble = "burning"
    run(100)
    assert [one.code for one in told] == ["missing", "device-back", "silent", "burning"]
    sensor.trouble = ""
    run(70)
    with supervisor.lent:
        sensor.looks = 0
        run(50)
        assert sensor.looks == 0, "somebody works with it"
    run(1)
    assert sensor.looks == 1
