"""New hours that would close an open stage say so first; an operator's request counts as it will count."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

import pytest

from controller.kiosk.decide.operator_overrides import OperatorOverrides, effect
from controller.kiosk.decide.planner import Plan, plan
from controller.kiosk.store.event_log import EventLog
from controller.kiosk.values import Schedule, ScheduleRow

MONDAY_NOON = datetime(2026, 5, 4, 12, 0, tzinfo=UTC).timestamp()
NOW, EVENING = (Schedule("UTC", (ScheduleRow("mon", opens, "20:00"),)) for opens in ("10:00", "18:00"))


@pytest.fixture
def log(tmp_path: Path) -> Iterator[EventLog]:
    log = EventLog(tmp_path / "events", durable=False)
    yield log
    log.close()


def planned(schedule: Schedule) -> Plan:
    return plan(MONDAY_NOON, schedule, (), since_s=MONDAY_NOON)


def test_hours_that_close_the_running_show_are_told_with_the_next_opening(log: EventLog) -> None:
    told = effect(EVENING, OperatorOverrides(log, without_time=False), planned(NOW), MONDAY_NOON)
    assert "The stage closes at once" in told
    assert "it is Monday, 12:00 in UTC" in told
    assert told.endswith("It opens again on Monday at 18:00.")


def test_hours_that_leave_it_open_or_find_it_closed_say_nothing(log: EventLog) -> None:
    overrides = OperatorOverrides(log, without_time=False)
    assert effect(NOW, overrides, planned(NOW), MONDAY_NOON) == ""
    assert effect(Schedule("UTC"), overrides, planned(NOW), MONDAY_NOON) == ""
    assert effect(EVENING, overrides, planned(EVENING), MONDAY_NOON) == ""
    assert effect(EVENING, overrides, Plan(None), MONDAY_NOON) == ""


def test_a_stage_that_a_person_opened_stays_open_and_so_do_the_words(log: EventLog) -> None:
    overrides = OperatorOverrides(log, without_time=False)
    overrides.override(True, planned(EVENING))
    assert effect(EVENING, overrides, planned(EVENING), MONDAY_NOON) == ""
    overrides.follow(planned(EVENING))
    assert overrides.open(planned(EVENING))
