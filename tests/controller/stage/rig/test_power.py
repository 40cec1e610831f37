"""A room of three projectors, switched on and off together."""

from __future__ import annotations

from dataclasses import dataclass, field

import pytest

from controller.stage.rig.lamp_guard import LampGuard
from controller.stage.rig.power import BY_HAND_S, light, power_down, steady
from hal.deadline import Deadline, in_seconds
from hal.driver_calls import Caller
from hal.errors import DeviceGone, DeviceRefused, DeviceTimeout
from hal.values import Power, ProjectorStatus
from tests.controller.stage.rig.lamp_model import RULES, Lamp, Shelf, World, check_light, soon


@dataclass
class Room:
    """Three projectors, as a stage has; ``checked``: behind the calls that a stage puts around its drivers."""

    checked: bool = False
    world: World = field(default_factory=World)
    notes: list[tuple[float, str]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.lamps = [Lamp(self.world) for _ in range(3)]
        names = ("left", "middle", "right")
        shelf = Shelf()
        caller = Caller("The driver")
        made = [caller.device("projector", lamp) if self.checked else lamp for lamp in self.lamps]
        self.guards = [LampGuard(*pair, shelf, clock=self.world) for pair in zip(names, made, strict=True)]

    def advance(self, fraction: float, note: str) -> None:
        self.notes.append((fraction, note))


def test_all_lamps_are_struck_and_waited_for_until_their_light_is_steady() -> None:
    room = Room()
    for part in (light, steady):
        room.notes.clear()
        part(room.guards, deadline=soon(), advance=room.advance, clock=room.world)
        fractions = [fraction for fraction, _ in room.notes]
        assert fractions == sorted(fractions)
        assert fractions[-1] <= 1
    check_light(room.guards)
    assert RULES.stable_s <= room.world.time_s - 1000 <= RULES.stable_s + 2


@pytest.mark.parametrize("but_s", [0.0, 10.0, 1000.0])
def test_lamps_may_be_waited_for_until_they_are_nearly_steady(but_s: float) -> None:
    room = Room()
    light(room.guards, deadline=soon(), advance=room.advance, clock=room.world)
    lit_s = room.world.time_s
    steady(room.guards, deadline=soon(), advance=room.advance, clock=room.world, but_s=but_s)
    left_s = max(guard.stable_left_s() for guard in room.guards)
    assert left_s <= but_s
    assert room.world.time_s == lit_s or left_s > but_s - 2


def test_lamps_that_must_rest_are_waited_for() -> None:
    room = Room()
    light(room.guards, deadline=soon(), advance=room.advance, clock=room.world)
    assert power_down(room.guards, clock=room.world) == ()
    light(room.guards, deadline=soon(), advance=room.advance, clock=room.world)
    assert [lamp.sins for lamp in room.lamps] == [[], [], []]
    assert any("must stay off for" in note for _, note in room.notes)


def test_a_silent_projector_is_named_before_any_lamp_is_struck() -> None:
    room = Room()
    room.lamps[2].trouble = "silent"
    with pytest.raises(DeviceTimeout):
        light(room.guards, deadline=soon(), advance=room.advance, clock=room.world)
    assert [lamp.strikes for lamp in room.lamps] == [0, 0, 0]


def test_a_projector_may_be_silent_while_it_boots() -> None:
    room = Room()

    def hears_again(fraction: float, note: str) -> None:
        room.advance(fraction, note)
        room.lamps[1].trouble = "silent" if len(room.notes) < 4 else ""

    light(room.guards, deadline=soon(), advance=hears_again, clock=room.world)
    assert any("middle" in note for _, note in room.notes)


def test_a_fault_during_warm_up_ends_it_with_the_projectors_name() -> None:
    room = Room()
    light(room.guards, deadline=soon(), advance=room.advance, clock=room.world)
    room.lamps[0].reports = ProjectorStatus(Power.ON, ("over-temperature",))
    with pytest.raises(DeviceRefused, match="left reports over-temperature") as error:
        steady(room.guards, deadline=soon(), advance=room.advance, clock=room.world)
    assert "45 minutes" in error.value.remedy


def test_a_warning_keeps_nobody_from_work() -> None:
    room = Room()
    light(room.guards, deadline=soon(), advance=room.advance, clock=room.world)
    room.lamps[0].reports = ProjectorStatus(Power.ON, ("lamp-hours-warning",))
    steady(room.guards, deadline=soon(), advance=room.advance, clock=room.world)


def test_a_lamp_that_goes_out_during_warm_up_is_named() -> None:
    room = Room()
    light(room.guards, deadline=soon(), advance=room.advance, clock=room.world)
    room.lamps[1].go_dark()
    with pytest.raises(DeviceRefused) as refused:
        steady(room.guards, deadline=soon(), advance=room.advance, clock=room.world)
    assert refused.value.code == "lamp-went-off"
    assert "start the same command or job again: it continues" in refused.value.remedy


def test_a_lamp_that_never_lights_ends_at_the_deadline() -> None:
    room = Room()
    room.lamps[1].reports = ProjectorStatus(Power.WARMING)
    with pytest.raises(DeviceTimeout, match="middle") as error:
        light(room.guards, deadline=in_seconds(0.1), advance=room.advance, clock=room.world)
    assert error.value.code == "lamps-not-lit"


def test_power_down_reaches_every_projector_though_one_fails() -> None:
    room = Room()
    light(room.guards, deadline=soon(), advance=room.advance, clock=room.world)
    room.lamps[0].trouble = "gone"
    failures = power_down(room.guards, within_s=0.1, clock=room.world)
    assert [failure.projector for failure in failures] == ["left"]
    assert isinstance(failures[0].error, DeviceGone)
    assert [lamp.lit_at_s for lamp in room.lamps[1:]] == [None, None]


def test_a_failed_lamp_is_off_though_its_projector_reports_the_fault_for_ever() -> None:
    room = Room()
    light(room.guards, deadline=soon(), advance=room.advance, clock=room.world)
    room.lamps[0].reports = ProjectorStatus(Power.FAULT, ("lamp-failed",))
    asked_s = room.world.time_s
    assert power_down(room.guards, clock=room.world) == ()
    assert room.world.time_s == asked_s, "nobody waits for it"


def test_a_projector_that_stays_on_is_told_so_and_not_called_silent() -> None:
    class Stubborn(Lamp):
        def status(self, *, deadline: Deadline) -> ProjectorStatus:
            deadline.check("projector-no-answer", what="It did not answer.", remedy="Check its cable.")
            return ProjectorStatus(Power.ON)

    world = World()
    guard = LampGuard("left", Stubborn(world), Shelf(), clock=world)
    guard.status(deadline=soon())
    (failure,) = power_down([guard], within_s=0.1)
    assert isinstance(failure.error, DeviceTimeout)
    assert failure.error.code == "lamp-not-off"


def test_power_down_asks_again_until_it_is_heard() -> None:
    room = Room()
    light(room.guards, deadline=soon(), advance=room.advance, clock=room.world)
    room.lamps[0].trouble = "lost"
    slept = room.world.sleep

    def sleep(seconds: float, deadline: Deadline) -> None:
        slept(seconds, deadline)
        room.lamps[0].trouble = ""

    room.world.sleep = sleep  # type: ignore[method-assign]
    assert power_down(room.guards, clock=room.world) == ()
    assert room.lamps[0].lit_at_s is None


def test_a_projector_that_was_never_lit_and_does_not_answer_is_not_waited_for() -> None:
    room = Room()
    room.lamps[0].trouble = "gone"
    began_s = room.world.time_s
    assert len(power_down(room.guards, within_s=60, clock=room.world)) == 1
    assert room.world.time_s - began_s < 5


ODD = [ValueError("no number"), OSError(5, "Input/output error"), SystemExit(1), KeyError("power"), RecursionError()]


@pytest.mark.parametrize("odd", ODD, ids=lambda odd: type(odd).__name__)
@pytest.mark.parametrize("checked", [True, False], ids=["through checked calls", "bare"])
def test_whatever_a_driver_raises_at_a_look_every_lamp_goes_off_and_the_error_is_told(
    odd: BaseException, checked: bool
) -> None:
    room = Room(checked=checked)
    light(room.guards, deadline=soon(), advance=room.advance, clock=room.world)
    room.lamps[0].odd = odd
    failures = power_down(room.guards, within_s=0.1, clock=room.world)
    assert [lamp.lit_at_s for lamp in room.lamps] == [None, None, None]
    assert [failure.projector for failure in failures] == ["left"]
    assert type(odd).__name__ in f"{type(failures[0].error).__name__} {failures[0].error}"


def test_a_status_of_a_wrong_kind_keeps_no_lamp_lit() -> None:
    room = Room()
    light(room.guards, deadline=soon(), advance=room.advance, clock=room.world)
    room.lamps[1].reports = {"power": "on"}  # type: ignore[assignment]
    failures = power_down(room.guards, within_s=0.1, clock=room.world)
    assert [lamp.lit_at_s for lamp in room.lamps] == [None, None, None]
    assert [failure.projector for failure in failures] == ["middle"]


def test_a_driver_that_no_longer_tells_what_it_can_do_is_still_told_to_switch_off() -> None:
    room = Room()
    light(room.guards, deadline=soon(), advance=room.advance, clock=room.world)
    room.lamps[2].forgets = True
    assert power_down(room.guards, within_s=0.1, clock=room.world) == ()
    assert [lamp.lit_at_s for lamp in room.lamps] == [None, None, None]


def test_a_projector_that_is_slow_to_confirm_gets_the_time_that_its_driver_asks_for() -> None:
    room = Room()
    room.lamps[1].switch_s = 150.0
    light(room.guards, deadline=in_seconds(600), advance=room.advance, clock=room.world)
    assert [round(lamp.patience_s[0], -1) for lamp in room.lamps] == [10, 150, 10]


def test_a_projector_without_power_codes_is_left_to_the_technician_and_the_others_go_on() -> None:
    room = Room()
    room.lamps[1].switchable = False
    told: list[str] = []
    light(room.guards, deadline=in_seconds(600), advance=room.advance, clock=room.world, tell=told.append)
    assert len(told) == 1
    assert "middle" in told[0]
    assert [lamp.strikes for lamp in room.lamps] == [1, 0, 1]
    assert room.world.time_s - 1000 >= BY_HAND_S
    steady(room.guards, deadline=in_seconds(600), advance=room.advance, clock=room.world)
    check_light(room.guards)
    assert room.guards[1].use().strikes == 1
    assert power_down(room.guards, clock=room.world) == ()


def test_a_lamp_that_was_switched_off_by_hand_rests_before_the_technician_is_asked_again() -> None:
    room = Room()
    room.lamps[0].switchable = False
    told: list[float] = []

    def tell(sentence: str) -> None:
        told.append(room.world.time_s)

    light(room.guards[:1], deadline=in_seconds(600), advance=room.advance, clock=room.world, tell=tell)
    power_down(room.guards[:1], clock=room.world)
    off_s = room.world.time_s
    light(room.guards[:1], deadline=in_seconds(600), advance=room.advance, clock=room.world, tell=tell)
    assert told[1] - off_s >= RULES.minimum_off_s
    assert any("must stay off for" in note for _, note in room.notes)


def test_the_mains_of_a_projector_that_cannot_be_switched_stay_on() -> None:
    room = Room()
    room.lamps[0].switchable = False
    light(room.guards[:1], deadline=in_seconds(600), advance=room.advance, clock=room.world)
    power_down(room.guards[:1], clock=room.world)
    room.world.time_s += 10_000
    assert not room.guards[0].may_open_mains(deadline=soon())


def test_one_that_tells_of_cooling_is_not_taken_to_burn() -> None:
    room = Room()
    room.lamps[0].switchable = False
    light(room.guards[:1], deadline=in_seconds(600), advance=room.advance, clock=room.world)
    room.lamps[0].reports = ProjectorStatus(Power.COOLING)
    assert room.guards[0].status(deadline=soon()).power is Power.COOLING
    assert not room.guards[0].may_be_lit
