"""How often a projector is asked, and how soon a change is noticed: counted by an emulated one, in virtual time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from controller.kiosk.decide.interfaces import Condition
from controller.kiosk.supervisors.projector_supervisor import ProjectorSupervisor
from controller.stage.rig.lamp_guard import LampGuard
from hal.deadline import Deadline
from hal.links import TcpLink
from lab.emulated.projectors.pjlink import EmulatedPjLinkProjector, PjLinkOddities
from plugins.emulated.projectors.lamp import EmulatedLamp, LampTiming
from plugins.projectors.pjlink import PjLinkProjector
from plugins.projectors.profile_files import load_profile
from tests.controller.stage.rig.lamp_model import Shelf, World

HOUR_S = 3600.0
LIT_H, DARK_H = 10, 14
MOST_CONNECTIONS, MOST_QUERIES = 500, 12_000
"""Of a projector in a day of so many hours."""


class Clock(World):
    """Virtual time, as deadlines measure it, too."""

    def monotonic(self) -> float:
        return self.time_s

    def sleep(self, seconds: float, deadline: Deadline | None = None) -> None:
        self.time_s += seconds

    def deadline(self, seconds: float) -> Deadline:
        return Deadline(self.time_s + seconds, None, self)


@dataclass
class Kept:
    """A supervisor and an emulated projector; ``timing`` of the lamp in seconds of the virtual clock."""

    odd: PjLinkOddities = field(default_factory=PjLinkOddities)
    password: str | None = None
    idle_s: float = 30.0
    timing: LampTiming = field(default_factory=lambda: LampTiming(90.0, 120.0))

    def __post_init__(self) -> None:
        self.clock = Clock()
        self.lamp = EmulatedLamp(self.timing, clock=self.clock.monotonic)
        self.projector = EmulatedPjLinkProjector(self.lamp, password=self.password, idle_s=self.idle_s, odd=self.odd)
        self.projector.start()
        self.told: list[str] = []
        self.supervisor = ProjectorSupervisor(
            "left", self._opened, lambda notice: self.told.append(notice.code), clock=self.clock,
            deadline=self.clock.deadline,
        )  # fmt: skip

    def _opened(self, deadline: Deadline) -> LampGuard:
        host, _, port = self.projector.address.rpartition(":")
        driver = PjLinkProjector(
            lambda until: TcpLink(host, int(port), deadline=until), load_profile("pjlink", Path()),
            name=self.projector.address, password=self.password,
        )  # fmt: skip
        driver.open(deadline)
        return LampGuard("left", driver, Shelf(), clock=self.clock)

    def steps_for(self, seconds: float) -> None:
        ends_s = self.clock.time_s + seconds
        while self.clock.time_s < ends_s:
            self.step()

    def step(self) -> None:
        self.supervisor.step()
        self.clock.time_s += 1.0

    def bring(self, lit: bool) -> None:
        """Steady as wanted; after that, nothing is counted yet."""
        self.supervisor.want_lit = lit
        self.until(Condition.LIT if lit else Condition.DARK)
        self.steps_for(60.0)
        self.projector.heard.clear()
        self.projector.connections = 0

    def until(self, condition: Condition) -> float:
        """Seconds until it is seen so."""
        begun_s = self.clock.time_s
        while self.supervisor.view.condition is not condition:
            self.step()
            assert self.clock.time_s - begun_s < 1000.0, f"{self.supervisor.view}"
        return self.clock.time_s - begun_s


@pytest.fixture
def keep() -> Iterator[Callable[..., Kept]]:
    made: list[Kept] = []

    def make(**kwargs: object) -> Kept:
        made.append(Kept(**kwargs))  # type: ignore[arg-type]
        return made[-1]

    yield make
    for kept in made:
        kept.supervisor.close()
        kept.projector.stop()


@pytest.mark.parametrize(
    "more",
    [
        {},
        {"password": "secret"},
        {"password": "secret", "odd": PjLinkOddities(digest_each=True)},
        {"odd": PjLinkOddities(answers={"LAMP": b"ERR3"})},
    ],
)
def test_a_day_of_a_steady_projector_has_few_connections_and_questions(
    keep: Callable[..., Kept], more: dict[str, object]
) -> None:
    kept, connections, queries = keep(**more), 0, 0
    for lit, hours in ((True, LIT_H), (False, DARK_H)):
        kept.bring(lit)
        kept.steps_for(HOUR_S)
        connections += kept.projector.connections * hours
        queries += len(kept.projector.heard) * hours
    assert connections <= MOST_CONNECTIONS
    assert queries <= MOST_QUERIES
    assert kept.told == ["lamp-struck"]


def test_the_lamp_hours_are_asked_once_an_hour(keep: Callable[..., Kept]) -> None:
    kept = keep()
    kept.bring(True)
    kept.steps_for(3 * HOUR_S)
    assert kept.projector.heard.count(b"%1LAMP ?") == 3
    assert kept.supervisor.view.counter_hours == kept.lamp.hours


def test_a_projector_that_closes_after_each_answer_is_asked_over_new_connections(keep: Callable[..., Kept]) -> None:
    kept = keep(odd=PjLinkOddities(closes=True))
    kept.bring(True)
    kept.steps_for(HOUR_S)
    assert kept.projector.connections == len(kept.projector.heard) <= MOST_QUERIES / 24
    assert kept.supervisor.view.condition is Condition.LIT


@pytest.mark.parametrize("after_s", [0, 7, 13])
@pytest.mark.parametrize("lit", [True, False])
def test_what_somebody_does_by_remote_control_is_seen_within_twenty_seconds(
    keep: Callable[..., Kept], lit: bool, after_s: float
) -> None:
    kept = keep(timing=LampTiming(0.0, 0.0))
    kept.bring(lit)
    kept.steps_for(after_s)
    (kept.lamp.extinguish if lit else kept.lamp.strike)()
    kept.steps_for(20.0)
    assert kept.told[1:] == ["lamp-went-off"] if lit else not kept.lamp.burning


def test_an_expected_change_is_seen_within_three_seconds(keep: Callable[..., Kept]) -> None:
    kept = keep()
    kept.bring(False)
    kept.supervisor.want_lit = True
    assert kept.until(Condition.LIGHTING) <= 3.0
    assert abs(kept.until(Condition.LIT) - 90.0) <= 3.0
    kept.steps_for(HOUR_S)
    kept.supervisor.want_lit = False
    assert kept.until(Condition.COOLING) <= 4.0, "with a second for the command"


def test_a_warm_up_longer_than_the_profile_is_told_and_not_ended(keep: Callable[..., Kept]) -> None:
    kept = keep(timing=LampTiming(800.0, 600.0))
    kept.supervisor.want_lit = True
    kept.until(Condition.LIT)
    assert (kept.lamp.strikes, kept.told) == (1, ["lamp-struck", "lamp-warms-long"])
    kept.supervisor.want_lit = False
    kept.until(Condition.DARK)
    assert kept.told[2:] == ["lamp-cools-long"]


def test_a_warm_up_without_end_is_ended_after_a_quarter_of_an_hour(keep: Callable[..., Kept]) -> None:
    kept = keep(timing=LampTiming(1e9, 120.0))
    kept.supervisor.want_lit = True
    kept.steps_for(890.0)
    assert kept.lamp.burning
    kept.steps_for(30.0)
    assert not kept.lamp.burning
    assert "lamp-not-lit" in kept.told


def test_a_standby_that_answers_err3_for_ever_lights_when_it_is_wanted(keep: Callable[..., Kept]) -> None:
    kept = keep(odd=PjLinkOddities(dark_answer=b"ERR3"))
    kept.bring(False)
    kept.bring(True)
    assert kept.lamp.strikes == 1
    kept.bring(False)
    assert not kept.lamp.burning


def test_a_projector_that_answers_err3_for_a_moment_stays_lit(keep: Callable[..., Kept]) -> None:
    kept = keep()
    kept.bring(True)
    kept.projector.set_oddities(PjLinkOddities(answers={"POWR": b"ERR3"}))
    kept.steps_for(20.0)
    kept.projector.set_oddities(PjLinkOddities())
    kept.steps_for(20.0)
    assert kept.supervisor.view.condition is Condition.LIT
    assert kept.told == ["lamp-struck"]


@pytest.mark.parametrize(("answer", "code"), [(b"ERR4", "projector-fault"), (b"4", "lamp-state-unknown")])
def test_a_projector_that_reports_a_failure_says_so(keep: Callable[..., Kept], answer: bytes, code: str) -> None:
    kept = keep(odd=PjLinkOddities(answers={"POWR": answer}))
    kept.supervisor.want_lit = True
    kept.steps_for(60.0)
    problem = kept.supervisor.view.problem
    assert problem is not None
    assert problem.code == code
    assert kept.lamp.strikes == 0
