from __future__ import annotations

from datetime import UTC, datetime
from zoneinfo import ZoneInfo

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from controller.config.models import HoursTable, ScheduleTable
from controller.core.errors import UsageError
from controller.kiosk.decide.planner import DOUBT_S, WINDOW_S, Plan, believed, plan
from controller.kiosk.schedule import check_overlaps, check_schedule, expanded, of_table, openings
from controller.kiosk.values import Schedule, ScheduleRow

VIENNA = ZoneInfo("Europe/Vienna")
WEEK = tuple(ScheduleRow(day, "10:00", "18:00") for day in ("mon", "tue", "wed", "thu", "fri", "sat", "sun"))
HOURS = Schedule("Europe/Vienna", (*WEEK, ScheduleRow("2026-12-24", "", "")), "03:00")


def at(text: str, zone: ZoneInfo = VIENNA) -> float:
    return datetime.fromisoformat(text).replace(tzinfo=zone).timestamp()


def planned(text: str, schedule: Schedule = HOURS, done: frozenset[str] = frozenset()) -> Plan:
    return plan(at(text), schedule, done, since_s=0.0)


@pytest.mark.parametrize(
    ("now", "is_open"),
    [
        ("2026-05-04T09:59:59", False), ("2026-05-04T10:00:00", True), ("2026-05-04T17:59:59", True),
        ("2026-05-04T18:00:00", False), ("2026-12-24T12:00:00", False), ("2026-12-25T12:00:00", True),
        # The days on which the clocks change.
        ("2026-03-29T09:59:59", False), ("2026-03-29T10:00:00", True), ("2026-10-25T10:00:00", True),
        ("2026-10-25T18:00:00", False),
    ],
)  # fmt: skip
def test_open_by_local_time_with_exceptions(now: str, is_open: bool) -> None:
    assert planned(now).open is is_open


def test_hours_past_midnight_belong_to_the_day_on_which_they_begin() -> None:
    friday = Schedule("Europe/Vienna", (ScheduleRow("fri", "20:00", "02:00", "marble"),))
    assert planned("2026-05-09T01:59:00", friday).appearance == "marble"
    assert planned("2026-05-09T02:00:00", friday).open is False
    assert planned("2026-05-08T01:00:00", friday).open is False


def test_a_schedule_without_hours_is_always_open_also_without_time() -> None:
    assert plan(None, Schedule("UTC"), (), since_s=0.0).open is True
    assert plan(None, HOURS, (), since_s=0.0).open is None


def test_what_comes_next() -> None:
    following = planned("2026-05-04T09:00:00").next
    assert following is not None
    assert (following.what, following.at_unix_s) == ("opens", at("2026-05-04T10:00:00"))
    following = planned("2026-05-04T20:00:00").next
    assert following is not None
    assert (following.what, following.at_unix_s) == ("drift check", at("2026-05-05T03:00:00"))


def test_a_check_in_the_hour_that_a_clock_change_skips_is_done_once() -> None:
    night = Schedule("Europe/Vienna", (), "02:30")
    due = plan(at("2026-03-29T03:45:00"), night, (), since_s=at("2026-03-28T12:00:00")).due
    assert [task.key for task in due] == ["drift-check 2026-03-29"]


def test_a_check_in_the_hour_that_comes_twice_is_done_once() -> None:
    night = Schedule("Europe/Vienna", (), "02:30")
    first = at("2026-10-25T02:30:00")
    due = plan(first + 60, night, (), since_s=first - 86_400).due
    again = plan(first + 3700, night, {due[0].key}, since_s=first - 86_400).due
    assert not again


def test_the_check_of_a_night_without_power_is_left_out_and_told() -> None:
    found = plan(at("2026-05-06T12:00:00"), HOURS, {"drift-check 2026-05-04"}, since_s=at("2026-05-04T00:00:00"))
    assert [task.key for task in found.expired] == ["drift-check 2026-05-05", "drift-check 2026-05-06"]
    assert not found.due


@given(
    st.floats(1.75e9, 2e9), st.one_of(st.none(), st.floats(1.75e9, 2e9)), st.booleans(),
)  # fmt: skip
def test_the_believed_time_never_runs_back_by_less_than_it_is_held(
    now_s: float, latest_s: float | None, synchronised: bool
) -> None:
    found = believed(now_s, latest_s, synchronised=synchronised)
    if found is None:
        assert latest_s is not None
        assert latest_s - now_s > DOUBT_S
        assert not synchronised
    elif latest_s is not None and abs(latest_s - now_s) <= 7200.0:
        assert found == max(now_s, latest_s)
    else:
        assert found == now_s


@pytest.mark.parametrize("back_h", [2.01, 3.0, 4.0, 30.0])
def test_a_clock_set_back_by_more_than_two_hours_counts_at_once(back_h: float) -> None:
    latest_s = at("2026-05-04T10:00:00")
    assert believed(latest_s - back_h * 3600.0, latest_s, synchronised=False) == latest_s - back_h * 3600.0
    assert believed(latest_s - 7200.0, latest_s, synchronised=False) == latest_s


def test_a_clock_that_was_never_set_tells_nothing() -> None:
    assert believed(0.0, None, synchronised=False) is None
    assert believed(86_400.0, at("2026-05-04T10:00:00"), synchronised=True) is None


times = st.times().map(lambda time: time.strftime("%H:%M"))
days = st.one_of(
    st.sampled_from(["mon", "tue", "wed", "thu", "fri", "sat", "sun"]),
    st.dates(datetime(2026, 1, 1).date(), datetime(2026, 12, 31).date()).map(lambda day: day.isoformat()),
)
zones = st.sampled_from(["Europe/Vienna", "America/St_Johns", "Australia/Lord_Howe", "Pacific/Apia", "UTC"])
rows = st.lists(st.builds(ScheduleRow, days, times, times), min_size=1, max_size=6).map(tuple)
moments = st.datetimes(datetime(2026, 1, 5), datetime(2026, 12, 20)).map(
    lambda when: when.replace(tzinfo=UTC).timestamp()
)


@settings(max_examples=60)
@given(zones, rows, moments)
def test_the_next_event_is_where_the_plan_changes(zone: str, hours: tuple[ScheduleRow, ...], now_s: float) -> None:
    schedule = Schedule(zone, hours)
    found = plan(now_s, schedule, (), since_s=now_s)
    if found.next is None:
        assert not [one for one in openings(schedule, now_s) if one.ends_s > now_s]
        return
    before = plan(found.next.at_unix_s - 0.5, schedule, (), since_s=now_s)
    after = plan(found.next.at_unix_s, schedule, (), since_s=now_s)
    assert before.open is found.open
    assert after.open is (found.next.what == "opens")


jumps = st.lists(
    st.tuples(st.floats(0, 3 * 86_400), st.one_of(st.just(0.0), st.floats(-90_000, 90_000))), min_size=3, max_size=30
)


@settings(max_examples=80)
@given(zones, times, moments, jumps)
def test_whatever_the_clock_does_each_night_is_done_or_left_out_once(
    zone: str, check: str, start_s: float, steps: list[tuple[float, float]]
) -> None:
    schedule, wall_s, latest_s = Schedule(zone, (), check), start_s, start_s
    done: set[str] = set()
    for passes_s, jump_s in steps:
        wall_s += passes_s + jump_s
        now_s = believed(wall_s, latest_s, synchronised=True)
        if now_s is None:
            continue
        latest_s = now_s
        found = plan(now_s, schedule, done, since_s=start_s)
        keys = [task.key for task in (*found.due, *found.expired)]
        assert len(keys) == len(set(keys))
        assert done.isdisjoint(keys)
        assert all(task.begins_s <= now_s < task.begins_s + WINDOW_S for task in found.due)
        done.update(keys)
        assert not plan(now_s, schedule, done, since_s=start_s).due


@pytest.mark.parametrize(
    "schedule",
    [
        Schedule("Mars/Olympus"),
        Schedule("../../etc/passwd"),
        Schedule("UTC", drift_check="25:00"),
        Schedule("UTC", (ScheduleRow("monday", "10:00", "18:00"),)),
        Schedule("UTC", (ScheduleRow("mon", "10:00", ""),)),
        Schedule("UTC", (ScheduleRow("2026-02-30", "10:00", "18:00"),)),
        Schedule("UTC", (ScheduleRow("mon", "10", "18"),)),
        Schedule("UTC", (ScheduleRow("mon", "10:00", "18:00", "x"),)),
    ],
)
def test_wrong_schedules_are_refused(schedule: Schedule) -> None:
    with pytest.raises(UsageError, match=r"Allowed|time zone"):
        check_schedule(schedule, ["shine"])


def test_of_hours_at_the_same_time_those_that_began_last_count() -> None:
    rows = (ScheduleRow("mon", "10:00", "18:00", "day"), ScheduleRow("mon", "12:00", "14:00", "noon"))
    both = Schedule("Europe/Vienna", rows)
    shown = [planned(f"2026-05-04T{hour}:00", both).appearance for hour in ("11:00", "13:00", "15:00")]
    assert shown == ["day", "noon", "day"]


def test_24_00_is_the_end_of_a_day_wherever_a_time_is_taken() -> None:
    rows = (ScheduleRow("daily", "18:00", "24:00"),)
    schedule = of_table(ScheduleTable(time_zone="Europe/Vienna", drift_check="24:00", hours=(
        HoursTable(day="daily", opens="18:00", closes="24:00"),)))  # fmt: skip
    check_schedule(schedule)
    check_overlaps(schedule)
    assert schedule.rows == expanded(rows)
    opened = [planned(f"2026-05-04T{at_}:00", schedule).open for at_ in ("17:59", "18:00", "23:59")]
    assert opened == [False, True, True]
    assert planned("2026-05-05T00:00:00", schedule).open is False
    assert planned("2026-05-04T00:00:00", schedule).due, "the check at midnight"
    whole = Schedule("Europe/Vienna", (ScheduleRow("mon", "00:00", "24:00"), ScheduleRow("tue", "24:00", "02:00")))
    check_schedule(whole)
    times = ("04T00:00:00", "04T23:59:00", "05T00:00:00", "05T23:59:00", "06T01:59:00", "06T02:00:00")
    assert [planned(f"2026-05-{text}", whole).open for text in times] == [True, True, False, False, True, False]
    with pytest.raises(UsageError):
        check_schedule(Schedule("UTC", (ScheduleRow("mon", "10:00", "24:01"),)))
