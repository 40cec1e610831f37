"""Mains relays and hot lamps: the one is never opened before the other has cooled."""

from __future__ import annotations

import contextlib
import threading
from dataclasses import dataclass, field

import pytest

from controller.stage.rig.lamp_guard import LampGuard
from controller.stage.rig.power import Circuit, close_circuits, open_circuits, power_down
from hal.deadline import Deadline
from hal.errors import DeviceError, DeviceGone, DeviceRefused
from hal.values import DeviceIdentity
from tests.controller.stage.rig.lamp_model import RULES, Lamp, Shelf, World, soon


@dataclass
class Board:
    """Relays that write down when they moved."""

    world: World
    closed: dict[int, bool] = field(default_factory=lambda: {1: False, 2: False})
    moved: list[tuple[float, int, bool]] = field(default_factory=list)
    gone: bool = False

    def identity(self, *, deadline: Deadline) -> DeviceIdentity:
        return DeviceIdentity("Model", "Board")

    def close(self) -> None:
        """Nothing to release."""

    def channels(self, *, deadline: Deadline) -> int:
        return len(self.closed)

    def state(self, channel: int, *, deadline: Deadline) -> bool:
        return self.closed[channel]

    def switch(self, channel: int, closed: bool, *, deadline: Deadline) -> None:
        if self.gone:
            raise DeviceGone("hid-unplugged", what="No board.", remedy="Plug it in.")
        self.closed[channel] = closed
        self.moved.append((self.world.time_s, channel, closed))


class Hall:
    """Two projectors, each on its own relay of one board."""

    def __init__(self) -> None:
        self.world = World()
        self.board = Board(self.world)
        self.lamps = {name: Lamp(self.world) for name in ("left", "right")}
        shelf = Shelf()
        self.guards = [LampGuard(name, lamp, shelf, clock=self.world) for name, lamp in self.lamps.items()]
        self.circuits = [
            Circuit(f"board {channel}", channel, (name,), 3.0, self.board)
            for channel, name in enumerate(self.lamps, start=1)
        ]

    def close(self) -> None:
        close_circuits(self.circuits, deadline=soon(), clock=self.world)

    def light(self) -> None:
        self.world.time_s += 20
        for guard in self.guards:
            guard.switch_on(deadline=soon())
        self.world.time_s += 20

    def open(self, within_s: float | None = None) -> list[tuple[str, str]]:
        failures = open_circuits(self.circuits, self.guards, within_s=within_s, clock=self.world)
        return [(failure.circuit, getattr(failure.error, "code", "")) for failure in failures]


@pytest.fixture
def hall() -> Hall:
    return Hall()


def test_projectors_get_their_mains_and_time_to_boot_just_once(hall: Hall) -> None:
    began_s = hall.world.time_s
    hall.close()
    assert hall.board.closed == {1: True, 2: True}
    assert hall.world.time_s == began_s + 3.0
    hall.close()
    assert hall.world.time_s == began_s + 3.0
    assert len(hall.board.moved) == 2


def test_a_relay_opens_only_when_its_lamp_has_cooled(hall: Hall) -> None:
    hall.close()
    hall.light()
    assert not power_down(hall.guards, clock=hall.world)
    off_s = hall.world.time_s
    assert hall.open() == []
    assert hall.board.closed == {1: False, 2: False}
    opened_s = [time_s for time_s, _, closed in hall.board.moved if not closed]
    assert min(opened_s) >= off_s + RULES.cool_down_s


def test_a_lit_lamp_keeps_its_mains_and_the_other_does_not_wait_for_it(hall: Hall) -> None:
    hall.close()
    hall.light()
    hall.guards[0].switch_off(deadline=soon())
    assert hall.open(within_s=10) == [("board 2", "mains-lamp-hot")]
    assert hall.board.closed == {1: False, 2: True}


@pytest.mark.parametrize("trouble", ["silent", "gone"])
def test_a_projector_that_does_not_answer_keeps_its_mains(hall: Hall, trouble: str) -> None:
    hall.close()
    hall.light()
    power_down(hall.guards, clock=hall.world)
    hall.lamps["left"].trouble = trouble
    (failure,) = hall.open(within_s=20)
    assert failure[0] == "board 1"
    assert hall.board.closed == {1: True, 2: False}


def test_no_caller_opens_a_circuit_with_a_hot_lamp(hall: Hall) -> None:
    hall.close()
    hall.light()
    guards = {guard.name: guard for guard in hall.guards}
    with pytest.raises(DeviceRefused) as caught:
        hall.circuits[0].open(guards, deadline=soon())
    assert caught.value.code == "mains-lamp-hot"
    assert hall.board.closed[1]


def test_no_lamp_is_struck_between_the_look_at_it_and_the_cut(hall: Hall, monkeypatch: pytest.MonkeyPatch) -> None:
    hall.close()
    hall.world.time_s += 100
    both = Circuit("board 1", 1, ("left", "right"), 3.0, hall.board)
    switch, lamp = hall.board.switch, hall.lamps["left"]
    lit_at_the_cut: list[bool] = []

    def strike() -> None:
        with contextlib.suppress(DeviceError):
            hall.guards[0].switch_on(deadline=soon())

    striking = threading.Thread(target=strike)

    def switch_while_somebody_strikes(channel: int, closed: bool, *, deadline: Deadline) -> None:
        striking.start()
        striking.join(0.3)
        lit_at_the_cut.append(lamp.lit_at_s is not None)
        switch(channel, closed, deadline=deadline)
        lamp.trouble = "gone"

    monkeypatch.setattr(hall.board, "switch", switch_while_somebody_strikes)
    both.open({guard.name: guard for guard in hall.guards}, deadline=soon())
    striking.join()
    assert lit_at_the_cut == [False]
    assert lamp.strikes == 0


def test_a_lamp_that_is_struck_while_another_on_its_relay_is_looked_at_keeps_its_mains(
    hall: Hall, monkeypatch: pytest.MonkeyPatch
) -> None:
    hall.close()
    hall.world.time_s += 100
    both = Circuit("board 1", 1, ("left", "right"), 3.0, hall.board)
    look = hall.guards[1].may_open_mains

    def look_while_the_other_is_struck(*, deadline: Deadline) -> bool:
        striking = threading.Thread(target=hall.guards[0].switch_on, kwargs={"deadline": soon()})
        striking.start()
        striking.join()
        return look(deadline=deadline)

    monkeypatch.setattr(hall.guards[1], "may_open_mains", look_while_the_other_is_struck)
    with pytest.raises(DeviceRefused) as caught:
        both.open({guard.name: guard for guard in hall.guards}, deadline=soon())
    assert caught.value.code == "mains-lamp-hot"
    assert hall.board.closed[1]
    assert hall.lamps["left"].lit_at_s is not None


def test_after_a_power_cut_lamps_count_as_hot_before_their_mains_are_cut(hall: Hall) -> None:
    hall.close()
    hall.light()
    hall.world.reboot()
    shelf = Shelf()
    reborn = [LampGuard(name, lamp, shelf, clock=hall.world) for name, lamp in hall.lamps.items()]
    for lamp in hall.lamps.values():
        lamp.lit_at_s, lamp.off_at_s = None, hall.world.time_s
    began_s = hall.world.time_s
    assert open_circuits(hall.circuits, reborn, clock=hall.world) == ()
    opened_s = [time_s for time_s, _, closed in hall.board.moved if not closed]
    assert min(opened_s) >= began_s + RULES.cool_down_s


def test_a_board_that_is_gone_is_told_and_not_waited_for_without_end(hall: Hall) -> None:
    hall.close()
    hall.world.time_s += 100
    hall.board.gone = True
    assert hall.open(within_s=5) == [("board 1", "hid-unplugged"), ("board 2", "hid-unplugged")]
