"""What people ask of a stage beside its schedule, over restarts and power cuts of any length."""

from __future__ import annotations

import json
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path
from zoneinfo import ZoneInfo

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from controller.kiosk.decide.operator_overrides import OperatorOverrides
from controller.kiosk.decide.planner import Plan, plan
from controller.kiosk.store.event_log import EventLog
from controller.kiosk.values import IN_TURN, Schedule, ScheduleRow

DAYS = ("mon", "tue", "wed", "thu", "fri", "sat", "sun")
HOURS = Schedule("Europe/Vienna", tuple(ScheduleRow(day, "10:00", "18:00") for day in DAYS), "03:00")


def at(text: str, schedule: Schedule = HOURS) -> Plan:
    """2026-05-04 is a Monday."""
    now = datetime.fromisoformat(f"2026-05-{text}").replace(tzinfo=ZoneInfo("Europe/Vienna"))
    return plan(now.timestamp(), schedule, (), since_s=0.0)


class Memory:
    """A log on disk, and what a service after another makes of it."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / "events.sqlite"
        self.log = EventLog(self.path, durable=False)

    def overrides(self, *, without_time: bool = False) -> OperatorOverrides:
        self.log.close()
        self.log = EventLog(self.path, durable=False)
        return OperatorOverrides(self.log, without_time=without_time)


@pytest.fixture
def memory(tmp_path: Path) -> Iterator[Memory]:
    found = Memory(tmp_path)
    yield found
    found.log.close()


def open_at(overrides: OperatorOverrides, *moments: str) -> list[bool]:
    found = []
    for moment in moments:
        overrides.follow(at(moment))
        found.append(overrides.open(at(moment)))
    return found


def test_who_closes_or_opens_by_hand_is_heard_until_the_hours_say_something_new(memory: Memory) -> None:
    overrides = memory.overrides()
    assert open_at(overrides, "04T15:00") == [True]
    overrides.override(False, at("04T15:00"))
    assert open_at(overrides, "04T15:00", "04T17:59", "04T18:00", "05T09:59", "05T10:00") == [
        False, False, False, False, True,
    ]  # fmt: skip
    overrides.override(True, at("05T20:00"))
    assert open_at(overrides, "05T20:00", "06T09:59", "06T10:00", "06T18:00") == [True, True, True, False]
    overrides.override(False, at("06T20:00"))
    assert open_at(overrides, "07T10:00") == [True], "what the schedule says anyway binds nobody"
    told = [row.code for row in memory.log.after(0)]
    assert told == ["asked", "schedule-rules", "asked", "schedule-rules", "asked"]


@pytest.mark.parametrize(
    ("asked_at", "wanted", "woken_at", "is_open"),
    [
        ("04T15:00", False, "04T17:00", False),
        # The building cuts the power for the night: next morning no one remembers who closed the day before.
        ("04T15:00", False, "05T10:05", True),
        ("04T15:00", False, "05T09:00", False),
        ("04T20:00", True, "05T02:00", True),
        ("04T20:00", True, "05T20:00", False),
        ("04T20:00", True, "11T02:00", False),
    ],
)
def test_a_power_cut_outlives_no_override_that_had_ended_meanwhile(
    memory: Memory, asked_at: str, wanted: bool, woken_at: str, is_open: bool
) -> None:
    overrides = memory.overrides()
    overrides.follow(at(asked_at))
    overrides.override(wanted, at(asked_at))
    assert open_at(overrides, asked_at) == [wanted]
    assert open_at(memory.overrides(), woken_at, woken_at) == [is_open, is_open]


def test_an_override_is_kept_while_nobody_knows_the_time_after_a_power_cut(memory: Memory) -> None:
    overrides = memory.overrides(without_time=True)
    overrides.follow(at("04T15:00"))
    overrides.override(False, at("04T15:00"))
    overrides = memory.overrides(without_time=True)
    overrides.follow(Plan(None))
    assert not overrides.open(Plan(None))
    assert open_at(overrides, "04T16:00") == [False]
    overrides = memory.overrides(without_time=True)
    overrides.follow(Plan(None))
    assert open_at(overrides, "05T11:00") == [True]


@pytest.mark.parametrize(("asked_at", "wanted"), [("04T15:00", False), ("04T20:00", True)])
def test_a_time_that_is_lost_for_a_while_ends_no_override(memory: Memory, asked_at: str, wanted: bool) -> None:
    overrides = memory.overrides()
    overrides.follow(at(asked_at))
    overrides.override(wanted, at(asked_at))
    overrides.follow(Plan(None))
    assert overrides.open(Plan(None)) is wanted
    assert open_at(overrides, asked_at, "05T02:00") == [wanted, wanted and asked_at == "04T20:00"]


def test_a_time_that_is_lost_outlives_no_override_that_had_ended_meanwhile(memory: Memory) -> None:
    overrides = memory.overrides()
    overrides.follow(at("04T15:00"))
    overrides.override(False, at("04T15:00"))
    overrides.follow(Plan(None))
    assert open_at(overrides, "05T11:00") == [True]


@pytest.mark.parametrize("without_time", [False, True])
@pytest.mark.parametrize("wanted", [False, True])
def test_what_is_asked_without_the_time_lasts_until_the_first_change_after_it_is_known(
    memory: Memory, wanted: bool, without_time: bool
) -> None:
    for known_at, then in (("04T15:00", "04T18:00"), ("04T20:00", "05T10:00")):
        overrides = memory.overrides(without_time=without_time)
        overrides.follow(Plan(None))
        overrides.override(wanted, Plan(None))
        assert overrides.open(Plan(None)) is wanted
        overrides = memory.overrides(without_time=without_time)
        overrides.follow(Plan(None))
        assert open_at(overrides, known_at, then) == [wanted, then == "05T10:00"]
        overrides.override(then == "05T10:00", at(then))


def test_hours_that_are_edited_end_no_override_of_the_same_day(memory: Memory) -> None:
    longer = Schedule("Europe/Vienna", tuple(ScheduleRow(day, "10:00", "20:00") for day in DAYS))
    overrides = memory.overrides()
    overrides.follow(at("04T15:00"))
    overrides.override(False, at("04T15:00"))
    for schedule in (longer, HOURS):
        overrides.follow(at("04T15:01", schedule))
        assert not overrides.open(at("04T15:01", schedule))
    overrides.follow(at("04T15:02", longer))
    overrides = memory.overrides()
    overrides.follow(at("04T16:00", longer))
    assert not overrides.open(at("04T16:00", longer))


def test_an_appearance_is_played_until_the_schedule_names_another(memory: Memory) -> None:
    names = ("shine", "marble", "glass")
    rows = [ScheduleRow("mon", "10:00", "12:00", "marble"), ScheduleRow("mon", "12:00", "18:00", "gone")]
    schedule = Schedule("Europe/Vienna", (*rows, ScheduleRow("tue", "10:00", "18:00")))
    overrides = memory.overrides()

    def shown(moment: str) -> str:
        now = at(moment, schedule)
        overrides.follow(now)
        return overrides.appearance(now, names)

    assert shown("04T09:00") == IN_TURN, "all, as long as nobody wants a certain one"
    assert shown("04T10:00") == "marble"
    overrides.choose("glass", at("04T11:00", schedule))
    assert shown("04T11:00") == "glass"
    overrides = memory.overrides()
    assert shown("04T11:30") == "glass", "a restart is no new opinion of the schedule"
    overrides.follow(Plan(None))
    assert shown("04T11:31") == "glass", "nor is a clock that was lost for a while"
    assert shown("04T12:00") == IN_TURN, "the bundle has none of that name"
    assert shown("05T12:00") == IN_TURN
    assert overrides.appearance(at("05T12:00", schedule), ()) == ""


@given(st.one_of(st.text(max_size=12), st.recursive(
    st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=3)),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=2), inner, max_size=3), max_leaves=6,
).map(json.dumps)))  # fmt: skip
@settings(max_examples=60, deadline=None)
def test_whatever_the_log_holds_a_service_begins(text: str) -> None:
    log = EventLog(Path(":memory:"), durable=False)
    log.keep("override", text)
    overrides = OperatorOverrides(log, without_time=False)
    for moment in ("04T15:00", "04T18:00", "05T10:00"):
        overrides.follow(at(moment))
    assert overrides.open(at("05T10:00"))
    log.close()


def test_a_log_of_the_version_before_is_understood(memory: Memory) -> None:
    memory.log.keep("override", "[false, true]")
    assert open_at(memory.overrides(), "04T15:00", "04T18:00", "05T10:00") == [False, False, True]
