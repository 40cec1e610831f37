"""Each lamp rule by itself."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from controller.core.errors import WorkError
from controller.stage.rig.lamp_guard import LampGuard
from controller.stage.rig.lamp_ledger import LampFile, LampRecord
from hal.deadline import Deadline
from hal.errors import DeviceRefused
from hal.interfaces import Projector
from hal.values import LampRules, Power, ProjectorStatus
from tests.controller.stage.rig.lamp_model import RULES, Lamp, Shelf, World, refusal, soon


def a_guard(world: World, **more: object) -> tuple[LampGuard, Lamp]:
    lamp = Lamp(world)
    ledger = more.get("ledger", Shelf())
    assert isinstance(ledger, Shelf | LampFile)
    return LampGuard("left", lamp, ledger, clock=world), lamp


def test_the_guard_is_a_projector() -> None:
    assert isinstance(a_guard(World())[0], Projector)


def test_a_cooling_lamp_and_a_resting_lamp_are_not_struck() -> None:
    world = World()
    guard, lamp = a_guard(world)
    guard.switch_on(deadline=soon())
    world.time_s += 3
    guard.switch_off(deadline=soon())
    assert refusal(lambda: guard.switch_on(deadline=soon())) == "lamp-cooling"
    world.time_s += RULES.cool_down_s
    assert refusal(lambda: guard.switch_on(deadline=soon())) == "lamp-resting"
    world.time_s += RULES.minimum_off_s - RULES.cool_down_s
    guard.switch_on(deadline=soon())
    assert lamp.strikes == 2


@pytest.mark.parametrize(("power", "code"), [(Power.UNKNOWN, "lamp-state-unknown"), (Power.FAULT, "projector-fault")])
def test_a_lamp_of_which_nothing_good_is_known_is_not_struck(power: Power, code: str) -> None:
    guard, lamp = a_guard(World())
    lamp.reports = ProjectorStatus(power, ("lamp-failed",))
    assert refusal(lambda: guard.switch_on(deadline=soon())) == code
    assert lamp.strikes == 0


def test_without_room_to_count_the_strike_there_is_none_but_off_goes_out() -> None:
    world, shelf = World(), Shelf()
    guard, lamp = a_guard(world, ledger=shelf)
    shelf.full = True
    with pytest.raises(WorkError):
        guard.switch_on(deadline=soon())
    assert lamp.strikes == 0
    shelf.full = False
    guard.switch_on(deadline=soon())
    shelf.full = True
    guard.switch_off(deadline=soon())
    assert lamp.lit_at_s is None
    assert guard.rest_left_s() == RULES.minimum_off_s


class FullDisk:
    """A stage folder in which the lamps' file can't be written for a while."""

    def __init__(self, folder: Path) -> None:
        self.file = folder / LampFile.NAME
        self._obstacle = folder / LampFile.COPY

    def fill(self) -> None:
        self._obstacle.unlink(missing_ok=True)
        (self._obstacle / "in the way").mkdir(parents=True)

    def free(self) -> None:
        shutil.rmtree(self._obstacle)


def test_what_a_full_disk_did_not_take_is_written_as_soon_as_there_is_room(tmp_path: Path) -> None:
    world, disk = World(), FullDisk(tmp_path)
    guard, lamp = a_guard(world, ledger=LampFile(disk.file))
    guard.switch_on(deadline=soon())
    guard.switch_off(deadline=soon())
    world.time_s += 1000
    disk.fill()
    lamp.lit_at_s = world.time_s  # by its own remote control
    guard.status(deadline=soon())
    guard.switch_off(deadline=soon())
    assert not LampFile(disk.file).damaged
    disk.free()
    world.time_s += RULES.cool_down_s
    guard.status(deadline=soon())
    after_a_restart = LampGuard("left", lamp, LampFile(disk.file), clock=world)
    assert after_a_restart.rest_left_s() == RULES.minimum_off_s - RULES.cool_down_s
    assert refusal(lambda: after_a_restart.switch_on(deadline=soon())) == "lamp-resting"


def test_a_projector_connected_again_on_a_full_disk_is_as_hot_as_before(tmp_path: Path) -> None:
    world, disk = World(), FullDisk(tmp_path)
    ledger = LampFile(disk.file)
    guard, lamp = a_guard(world, ledger=ledger)
    guard.switch_on(deadline=soon())
    disk.fill()
    world.time_s += 3600
    guard.switch_off(deadline=soon())
    guard.close()
    again = LampGuard("left", lamp, ledger, clock=world)
    assert again.rest_left_s() == RULES.minimum_off_s
    assert again.use().hours == pytest.approx(1)
    with pytest.raises(WorkError):
        LampFile(disk.file).write("left", LampRecord())


def test_a_look_that_fails_does_not_keep_off_from_going_out() -> None:
    guard, lamp = a_guard(World())
    guard.switch_on(deadline=soon())
    lamp.trouble = "silent"
    guard.switch_off(deadline=soon())
    assert lamp.lit_at_s is None


def test_strikes_and_hours_survive_restarts(tmp_path: Path) -> None:
    world = World()
    guard, lamp = a_guard(world, ledger=LampFile(tmp_path / LampFile.NAME))
    for _ in range(3):
        guard.switch_on(deadline=soon())
        world.time_s += 1800
        guard.switch_off(deadline=soon())
        world.time_s += 100
    guard = LampGuard("left", lamp, LampFile(tmp_path / LampFile.NAME), clock=world)
    assert guard.use().strikes == 3
    assert guard.use().hours == pytest.approx(1.5)


def test_hours_are_saved_while_the_lamp_burns() -> None:
    world, shelf = World(), Shelf()
    guard, _ = a_guard(world, ledger=shelf)
    guard.switch_on(deadline=soon())
    for _ in range(100):
        world.time_s += 36
        guard.status(deadline=soon())
    assert shelf.records["left"].lit_s == pytest.approx(3600, abs=120)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"{",
        b"[]",
        b'{"left": 3}',
        b'{"left": {"lit": "no"}}',
        b"\xff",
        b"[" * 100_000,
        b'{"left": {"lit": false, "since_s": NaN, "boot": "", "strikes": 0, "lit_s": 0}}',
    ],
    ids=range(8),
)
def test_a_damaged_ledger_makes_the_lamps_hot(tmp_path: Path, content: bytes) -> None:
    (tmp_path / LampFile.NAME).write_bytes(content)
    ledger = LampFile(tmp_path / LampFile.NAME)
    guard, lamp = a_guard(World(), ledger=ledger)
    assert ledger.damaged
    assert refusal(lambda: guard.switch_on(deadline=soon())) == "lamp-resting"
    assert lamp.strikes == 0


@pytest.mark.parametrize("content", [None, b"", b"{"], ids=["gone", "empty", "cut"])
def test_a_lost_ledger_makes_the_lamps_hot_and_keeps_their_counts(tmp_path: Path, content: bytes | None) -> None:
    file, world = tmp_path / LampFile.NAME, World()
    guard, lamp = a_guard(world, ledger=LampFile(file))
    guard.switch_on(deadline=soon())
    lamp.go_dark()
    world.time_s += 1.0
    if content is None:
        file.unlink()
    else:
        file.write_bytes(content)
    guard = LampGuard("left", lamp, LampFile(file), clock=world)
    assert refusal(lambda: guard.switch_on(deadline=soon())) in {"lamp-resting", "lamp-cooling"}
    world.time_s += RULES.minimum_off_s
    guard.switch_on(deadline=soon())
    assert guard.use().strikes == 2
    assert not lamp.sins


@pytest.mark.parametrize("content", [b"", b"{"], ids=["empty", "cut"])
def test_lamps_are_hot_when_the_ledger_is_gone_and_its_copy_damaged(tmp_path: Path, content: bytes) -> None:
    (tmp_path / LampFile.COPY).write_bytes(content)
    guard, lamp = a_guard(World(), ledger=LampFile(tmp_path / LampFile.NAME))
    assert guard.may_be_lit
    assert refusal(lambda: guard.switch_on(deadline=soon())) == "lamp-resting"
    assert lamp.strikes == 0


def test_a_damaged_ledger_keeps_a_lamp_hot_of_which_nothing_was_written_before_a_kill(tmp_path: Path) -> None:
    (tmp_path / LampFile.NAME).write_bytes(b"{")
    ledger, world = LampFile(tmp_path / LampFile.NAME), World()
    right = LampGuard("right", Lamp(world), ledger, clock=world)
    a_guard(world, ledger=ledger)
    right.status(deadline=soon())
    # killed here, before the left lamp was looked at
    guard, lamp = a_guard(world, ledger=LampFile(tmp_path / LampFile.NAME))
    assert refusal(lambda: guard.switch_on(deadline=soon())) == "lamp-resting"
    assert lamp.strikes == 0
    world.time_s += RULES.minimum_off_s
    guard.switch_on(deadline=soon())
    assert LampFile(tmp_path / LampFile.NAME).read("right") == ledger.read("right")


@pytest.mark.parametrize("rule", ["warm_up_s", "stable_s", "cool_down_s", "minimum_off_s"])
def test_the_stage_can_make_each_rule_stricter_but_not_laxer(rule: str) -> None:
    at_least = replace(LampRules(0, 0, 0, 0), **{rule: 900.0})
    guard = LampGuard("left", Lamp(World()), Shelf(), at_least=at_least, clock=World())
    assert guard.capabilities.lamp_rules == replace(RULES, **{rule: 900.0})


def test_a_lamp_rests_at_least_until_it_is_cool() -> None:
    world = World()
    lamp = Lamp(world)
    cool_down_s = RULES.minimum_off_s + 50
    guard = LampGuard("left", lamp, Shelf(), at_least=replace(RULES, cool_down_s=cool_down_s), clock=world)
    guard.switch_on(deadline=soon())
    guard.switch_off(deadline=soon())
    world.time_s += RULES.minimum_off_s + 1
    assert refusal(lambda: guard.switch_on(deadline=soon())) == "lamp-resting"
    world.time_s += 49
    guard.switch_on(deadline=soon())


def test_mains_stay_on_until_a_lamp_could_have_cooled_that_was_never_seen() -> None:
    world = World()
    world.time_s += 10 * RULES.cool_down_s
    guard, _ = a_guard(world)
    assert not guard.may_open_mains(deadline=soon())
    world.time_s += RULES.cool_down_s
    assert guard.may_open_mains(deadline=soon())


def test_a_strike_that_the_projector_refuses_does_not_count() -> None:
    class Refusing(Lamp):
        def switch_on(self, *, deadline: Deadline) -> None:
            raise DeviceRefused("lamp-locked", what="It is locked.", remedy="Unlock it.")

    world, shelf = World(), Shelf()
    guard = LampGuard("left", Refusing(world), shelf, clock=world)
    assert refusal(lambda: guard.switch_on(deadline=soon())) == "lamp-locked"
    assert not guard.may_be_lit
    assert guard.use().strikes == 0
    assert not LampGuard("left", Lamp(world), shelf, clock=world).may_be_lit


def test_a_lamp_of_unknown_state_rests_from_when_it_was_switched_off() -> None:
    world = World()
    guard, lamp = a_guard(world)
    lamp.reports = ProjectorStatus(Power.UNKNOWN)
    guard.switch_off(deadline=soon())
    assert guard.rest_left_s() == RULES.minimum_off_s
