from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from controller.kiosk.decide.interfaces import DISK_FULL, Condition
from controller.kiosk.supervisors.projector_supervisor import (
    LIGHT_MARGIN_S,
    MOST_STRIKES,
    REOPEN_AFTER_FAULT_S,
    LampBefore,
    Mains,
    ProjectorSupervisor,
)
from controller.stage.rig.lamp_guard import LampGuard
from controller.stage.rig.lamp_ledger import LampFile, LampLedger, LampRecord
from hal.deadline import Deadline
from hal.errors import DeviceGone, DeviceTimeout, ProtocolError
from hal.notices import Level, Notice
from hal.values import Power, ProjectorStatus
from tests.controller.kiosk.model import FragileLamp
from tests.controller.stage.rig.lamp_model import RULES, Shelf, World

FAULT = ProjectorStatus(Power.FAULT, ("lamp-failed",))


class TellingLamp(FragileLamp):
    """Reports a fault once, unasked; who heard it, and did not hang up since, has no way to learn that it is over."""

    heard = False

    def status(self, *, deadline: Deadline) -> ProjectorStatus:
        answer = super().status(deadline=deadline)
        return FAULT if self.heard and self.lit_at_s is None else answer

    def strike(self, *, sin: bool) -> None:
        super().strike(sin=sin)
        self.heard = self.dud

    def burst(self) -> None:
        super().burst()
        self.heard = True

    def close(self) -> None:
        self.heard = False


class LateLamp(FragileLamp):
    """Switches, and does not answer in time."""

    def switch_on(self, *, deadline: Deadline) -> None:
        super().switch_on(deadline=deadline)
        raise DeviceTimeout("projector-not-confirmed", what="It did not switch in time.", remedy="Check its cable.")


class DeafLamp(FragileLamp):
    """Never receives a command while it is ``deaf``; if ``garbled``, a third of its answers are none either."""

    deaf, garbled = True, False
    commands = asked = 0

    def status(self, *, deadline: Deadline) -> ProjectorStatus:
        self.asked += 1
        if self.garbled and self.asked % 3 == 0:
            raise ProtocolError("answer-wrong", what="That was no answer.", remedy="Check its cable.")
        return super().status(deadline=deadline)

    def switch_on(self, *, deadline: Deadline) -> None:
        self.commands += 1
        if self.deaf:
            raise DeviceTimeout("projector-not-confirmed", what="It did not switch in time.", remedy="Check its cable.")
        super().switch_on(deadline=deadline)


class SlowToStart(FragileLamp):
    """Takes the command at once, and begins to warm up shortly before its light is awaited no longer."""

    after_s = 2 * RULES.warm_up_s + LIGHT_MARGIN_S - 1.0
    starts_at_s = float("inf")

    def switch_on(self, *, deadline: Deadline) -> None:
        self.starts_at_s = self.world.time_s + self.after_s

    def status(self, *, deadline: Deadline) -> ProjectorStatus:
        if self.world.time_s >= self.starts_at_s:
            self.starts_at_s = float("inf")
            self.strike(sin=True)
        return super().status(deadline=deadline)


class ShutMeanwhile(FragileLamp):
    """Somebody does something while it is looked at."""

    meanwhile: Callable[[], None] = staticmethod(lambda: None)

    def status(self, *, deadline: Deadline) -> ProjectorStatus:
        answer = super().status(deadline=deadline)
        self.meanwhile()
        return answer


class Kept:
    """A supervisor with its lamp, in virtual time."""

    def __init__(self, kind: type[FragileLamp] = FragileLamp, *, file: Path | None = None) -> None:
        self.world = World()
        self.lamp = kind(self.world)
        self.there = True
        self.told: list[Notice] = []
        self.file, self.shelf = file, Shelf()
        self.begin_anew()

    def begin_anew(self, *, maybe_lit: bool = False) -> None:
        """As a service that was killed and starts."""
        self.ledger: LampLedger = self.shelf if self.file is None else LampFile(self.file)
        record = self.ledger.read("left") or LampRecord()
        self.supervisor = ProjectorSupervisor(
            "left", self._opened, self.told.append, clock=self.world,
            lamp=LampBefore(maybe_lit, record.failed_in(self.world.boot()), partial(self.ledger.forgive, "left")),
        )  # fmt: skip

    def _opened(self, deadline: Deadline) -> LampGuard:
        if not self.there:
            raise DeviceGone("port-gone", what="The cable is away.", remedy="Plug it in.")
        return LampGuard("left", self.lamp, self.ledger, clock=self.world)

    def lose_line(self) -> None:
        self.there, self.lamp.trouble = False, "gone"

    def mend_line(self) -> None:
        self.there, self.lamp.trouble = True, ""

    def run(self, seconds: float) -> Condition:
        ends_s = self.world.time_s + seconds
        while self.world.time_s < ends_s:
            self.supervisor.step()
            self.world.time_s += 1.0
        assert not self.lamp.sins
        return self.supervisor.view.condition

    @property
    def codes(self) -> list[str]:
        return [decision.code for decision in self.told]


@pytest.fixture
def kept() -> Kept:
    return Kept()


@pytest.fixture
def given_up(tmp_path: Path) -> Kept:
    """A lamp that stays off after its last attempt, behind a line that broke then."""
    kept = Kept(file=tmp_path / LampFile.NAME)
    kept.lamp.dud = True
    kept.supervisor.want_lit = True
    assert kept.run(400.0) is Condition.BROKEN
    kept.lose_line()
    assert kept.run(60.0) is Condition.LOST
    return kept


def test_nothing_is_done_until_somebody_says_what_is_wanted(kept: Kept) -> None:
    assert kept.run(30) is Condition.DARK
    assert kept.lamp.strikes == 0


def test_a_lamp_that_was_lit_at_the_start_may_be_lit_until_its_projector_answers(kept: Kept) -> None:
    kept.supervisor.want_lit = True
    kept.run(5)
    kept.there = False
    kept.begin_anew(maybe_lit=True)
    kept.supervisor.want_lit = False
    assert kept.run(60) is Condition.LOST
    assert kept.supervisor.view.maybe_lit
    kept.there = True
    assert kept.run(60) is Condition.DARK
    assert not kept.supervisor.view.maybe_lit


def test_lights_and_darkens_as_it_is_wanted(kept: Kept) -> None:
    kept.supervisor.want_lit = True
    assert kept.run(5) is Condition.LIT
    kept.supervisor.want_lit = False
    assert kept.run(3) is Condition.COOLING
    assert kept.run(20) is Condition.DARK
    assert kept.lamp.strikes == 1


def test_a_fault_that_was_told_once_is_asked_about_anew_and_the_mended_lamp_lights() -> None:
    kept = Kept(TellingLamp)
    kept.supervisor.want_lit = True
    assert kept.run(10) is Condition.LIT
    kept.lamp.burst()
    assert kept.run(10) is Condition.BROKEN
    kept.lamp.dud = False
    assert kept.run(REOPEN_AFTER_FAULT_S - 15) is Condition.BROKEN
    assert kept.run(30) is Condition.LIT
    assert kept.codes[-1] == "projector-back"


def test_a_lamp_that_stays_dead_and_says_so_is_struck_as_often_as_one_that_does_not() -> None:
    kept = Kept(TellingLamp)
    kept.lamp.dud = True
    kept.supervisor.want_lit = True
    assert kept.run(3600) is Condition.BROKEN
    assert kept.lamp.strikes <= MOST_STRIKES + 1
    struck = kept.lamp.strikes
    kept.supervisor.want_lit = False
    kept.run(60)
    kept.supervisor.want_lit = True
    kept.run(3600)
    assert kept.lamp.strikes == struck + 1


def test_a_dead_lamp_whose_projector_answers_late_is_struck_as_often_as_any() -> None:
    kept = Kept(LateLamp)
    kept.lamp.dud = True
    kept.supervisor.want_lit = True
    assert kept.run(2 * 3600) is Condition.BROKEN
    assert kept.lamp.strikes == MOST_STRIKES
    assert kept.codes.count("lamp-given-up") == 1


def test_a_lamp_that_heard_no_command_through_a_bad_line_lights_once_the_line_is_well() -> None:
    kept = Kept(DeafLamp)
    lamp = kept.lamp
    assert isinstance(lamp, DeafLamp)
    lamp.garbled = True
    kept.supervisor.want_lit = True
    kept.run(900.0)
    assert kept.codes.count("lamp-given-up") == 1
    assert lamp.strikes == 0
    lamp.deaf = lamp.garbled = False
    assert kept.run(180.0) is Condition.LIT
    assert lamp.strikes == 1


def test_a_lamp_that_never_hears_a_command_is_given_up_after_one_attempt_more() -> None:
    kept = Kept(DeafLamp)
    kept.supervisor.want_lit = True
    assert kept.run(2 * 3600) is Condition.BROKEN
    assert isinstance(kept.lamp, DeafLamp)
    assert kept.lamp.commands == MOST_STRIKES + 1


def test_a_lamp_whose_projector_answers_late_lights_by_one_strike() -> None:
    kept = Kept(LateLamp)
    kept.supervisor.want_lit = True
    assert kept.run(600) is Condition.LIT
    assert kept.lamp.strikes == 1


def test_a_lamp_whose_command_arrives_late_is_not_switched_off_while_it_warms_up() -> None:
    kept = Kept(SlowToStart)
    kept.supervisor.want_lit = True
    assert kept.run(SlowToStart.after_s + 2.0) is Condition.LIGHTING
    assert kept.run(120.0) is Condition.LIT
    assert kept.lamp.strikes == 1
    assert "lamp-not-lit" not in kept.codes


def test_a_lamp_that_could_not_be_recorded_has_no_problem_once_it_is_struck(kept: Kept) -> None:
    kept.shelf.full = True
    kept.supervisor.want_lit = True
    kept.run(5.0)
    assert kept.supervisor.view.problem is not None
    assert kept.supervisor.view.problem.code == DISK_FULL
    kept.shelf.full = False
    assert kept.run(2.0) is Condition.LIGHTING
    assert kept.supervisor.view.problem is None
    kept.run(300.0)
    assert "projector-back" not in kept.codes


def test_a_service_that_is_restarted_again_and_again_strikes_no_dead_lamp_anew(kept: Kept) -> None:
    kept.lamp.dud = True
    for _ in range(6):
        kept.supervisor.want_lit = True
        kept.run(400.0)
        kept.begin_anew()
    assert kept.lamp.strikes == MOST_STRIKES
    kept.supervisor.want_lit = False
    kept.run(5.0)
    kept.supervisor.want_lit = True
    kept.run(400.0)
    assert kept.lamp.strikes == MOST_STRIKES + 1, "one more at the next opening"
    kept.lamp.dud = False
    kept.begin_anew()
    kept.supervisor.forgive()
    kept.supervisor.want_lit = True
    assert kept.run(400.0) is Condition.LIT
    for _ in range(2):
        kept.begin_anew()
        kept.supervisor.want_lit = True
        assert kept.run(5.0) is Condition.LIT
        assert kept.lamp.strikes == MOST_STRIKES + 2


def test_a_repair_that_was_told_while_the_line_was_away_outlives_a_kill(kept: Kept) -> None:
    kept.lamp.dud = True
    kept.supervisor.want_lit = True
    kept.run(400.0)
    kept.lamp.dud, kept.there, kept.lamp.trouble = False, False, "gone"
    assert kept.run(60.0) is Condition.LOST
    kept.supervisor.forgive()
    kept.begin_anew()
    kept.there, kept.lamp.trouble = True, ""
    kept.supervisor.want_lit = True
    assert kept.run(400.0) is Condition.LIT


def test_an_opening_before_the_projector_was_reached_gives_one_attempt_more(given_up: Kept) -> None:
    given_up.begin_anew()
    given_up.supervisor.want_lit = False
    given_up.run(30.0)
    given_up.supervisor.want_lit = True
    given_up.run(30.0)
    given_up.mend_line()
    assert given_up.run(800.0) is Condition.BROKEN
    assert given_up.lamp.strikes == MOST_STRIKES + 1


def test_the_attempt_of_an_opening_outlives_a_kill_before_the_projector_answers(given_up: Kept) -> None:
    given_up.supervisor.want_lit = False
    given_up.run(30.0)
    given_up.supervisor.want_lit = True
    for _ in range(2):
        given_up.begin_anew()
        given_up.supervisor.want_lit = True
        given_up.run(30.0)
    given_up.mend_line()
    assert given_up.run(800.0) is Condition.BROKEN
    assert given_up.lamp.strikes == MOST_STRIKES + 1


def test_a_repair_that_was_told_just_after_the_line_broke_outlives_a_kill(tmp_path: Path) -> None:
    kept = Kept(file=tmp_path / LampFile.NAME)
    kept.supervisor.want_lit = True
    kept.run(10.0)
    kept.lamp.burst()
    kept.lamp.reports = FAULT
    assert kept.run(400.0) is Condition.BROKEN
    kept.lose_line()
    kept.run(2.0)
    kept.lamp.dud, kept.lamp.reports = False, None
    kept.supervisor.forgive()
    assert kept.run(60.0) is Condition.LOST
    kept.begin_anew()
    kept.mend_line()
    kept.supervisor.want_lit = True
    assert kept.run(800.0) is Condition.LIT


def test_kills_soon_after_each_strike_do_not_lose_count(kept: Kept) -> None:
    kept.lamp.dud = True
    for _ in range(8):
        kept.begin_anew()
        kept.supervisor.want_lit = True
        for _ in range(100):
            kept.run(1.0)
            if kept.supervisor.view.condition is Condition.LIGHTING:
                break
        kept.run(70.0)
    assert kept.lamp.strikes == MOST_STRIKES


def test_a_computer_that_was_started_anew_counts_anew(kept: Kept) -> None:
    kept.lamp.dud = True
    kept.supervisor.want_lit = True
    kept.run(400.0)
    kept.world.reboot()
    kept.begin_anew()
    kept.supervisor.want_lit = True
    kept.run(800.0)
    assert kept.lamp.strikes == 2 * MOST_STRIKES


def test_a_technician_who_looked_after_it_needs_not_wait() -> None:
    kept = Kept(TellingLamp)
    kept.supervisor.want_lit = True
    kept.run(10)
    kept.lamp.burst()
    kept.run(20)
    kept.lamp.dud = False
    kept.supervisor.forgive()
    assert kept.run(15) is Condition.LIT


def test_a_cable_that_is_away_is_tried_again_and_the_lamp_not_struck_twice(kept: Kept) -> None:
    kept.supervisor.want_lit = True
    kept.run(10)
    kept.there, kept.lamp.trouble = False, "gone"
    assert kept.run(40) is Condition.LOST
    assert kept.supervisor.view.maybe_lit
    kept.there, kept.lamp.trouble = True, ""
    assert kept.run(70) is Condition.LIT
    assert kept.lamp.strikes == 1
    assert [code for code in kept.codes if code in ("model-trouble", "port-gone", "projector-back")][
        -1
    ] == "projector-back"


def test_a_short_silence_is_no_event(kept: Kept) -> None:
    kept.supervisor.want_lit = True
    kept.run(10)
    kept.lamp.trouble = "silent"
    assert kept.run(8) is Condition.LIT
    kept.lamp.trouble = ""
    assert kept.run(3) is Condition.LIT
    assert set(kept.codes) == {"lamp-struck"}


def test_without_mains_it_counts_as_dark_and_nobody_asks_it() -> None:
    kept = Kept()
    kept.there = False
    mains = Mains(asleep=lambda: True)
    asleep = ProjectorSupervisor("left", kept._opened, kept.told.append, clock=kept.world, mains=mains)
    asleep.want_lit = True
    asleep.step()
    assert asleep.view.condition is Condition.DARK
    assert kept.told == []


def test_a_projector_behind_a_relay_board_that_is_away_says_so(kept: Kept) -> None:
    kept.there = False
    board = Notice("hid-unplugged", "No relay board is plugged in.", "Check its hub.", Level.ERROR)
    fed: list[Notice] = []
    supervisor = ProjectorSupervisor(
        "left", kept._opened, kept.told.append, clock=kept.world, mains=Mains(problem=lambda: fed[0] if fed else None)
    )
    supervisor.step()
    assert supervisor.view.problem is not None
    assert supervisor.view.problem.text == "The cable is away. Plug it in."
    fed.append(board)
    kept.world.time_s += 2.0
    supervisor.step()
    assert supervisor.view.problem.text == "The cable is away. No relay board is plugged in. Check its hub."


def test_a_projector_that_got_its_mains_back_is_spoken_to_at_once(kept: Kept) -> None:
    kept.there, dark = False, False
    mains = Mains(asleep=lambda: dark)
    supervisor = ProjectorSupervisor("left", kept._opened, kept.told.append, clock=kept.world, mains=mains)
    for _ in range(60):
        supervisor.step()
        kept.world.time_s += 1.0
    assert supervisor.view.condition is Condition.LOST
    kept.there = dark = True
    supervisor.step()
    dark = False
    supervisor.want_lit = True
    supervisor.step()
    assert kept.lamp.strikes == 1


def test_a_projector_that_was_plugged_in_again_is_found_within_a_quarter_of_a_minute(kept: Kept) -> None:
    kept.there = False
    assert kept.run(300) is Condition.LOST
    kept.there = True
    assert kept.run(16) is Condition.DARK


def test_a_stage_that_is_shut_while_a_projector_is_looked_at_costs_no_strike() -> None:
    kept = Kept(ShutMeanwhile)
    assert isinstance(kept.lamp, ShutMeanwhile)
    kept.supervisor.want_lit = True
    kept.lamp.meanwhile = lambda: setattr(kept.supervisor, "want_lit", False)
    kept.supervisor.step()
    assert kept.lamp.strikes == 0


def test_a_line_that_opens_after_its_keeper_was_closed_is_let_go_of_and_no_lamp_is_struck() -> None:
    kept = Kept(TellingLamp)
    closed: list[str] = []

    def opened_slowly(deadline: Deadline) -> LampGuard:
        supervisor.close()  # the service ends while the line is still being opened
        return LampGuard("left", kept.lamp, kept.shelf, clock=kept.world)

    kept.lamp.close = lambda: closed.append("left")  # type: ignore[method-assign]
    supervisor = ProjectorSupervisor("left", opened_slowly, kept.told.append, clock=kept.world)
    supervisor.want_lit = True
    supervisor.step()
    assert closed == ["left"]
    assert kept.lamp.strikes == 0
    assert supervisor.guard is None


def test_a_lamp_that_can_not_be_switched_off_is_one_problem_and_not_one_each_second() -> None:
    kept = Kept()
    kept.supervisor.want_lit = True
    kept.run(20.0)
    kept.lamp.trouble = "lost"
    kept.supervisor.want_lit = False
    assert kept.run(60.0) is Condition.LIT
    assert [one.code for one in kept.told if one.code != "lamp-struck"] == ["model-trouble"]
    kept.lamp.trouble = ""
    kept.run(30.0)
    assert [one.code for one in kept.told if one.code != "lamp-struck"] == ["model-trouble", "projector-back"]
    assert kept.supervisor.view.problem is None
