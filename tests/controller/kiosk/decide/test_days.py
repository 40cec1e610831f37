"""Days as people write them, and hours that run at the same time, against minutes counted one by one."""

from __future__ import annotations

from datetime import date, timedelta

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from controller.core.errors import UsageError
from controller.kiosk.schedule import WEEKDAYS, check_overlaps, days_of, expanded, grouped, rows_of
from controller.kiosk.values import Schedule, ScheduleRow

FIRST = date(2026, 5, 4)
CLOCK = st.builds("{:02d}:{:02d}".format, st.integers(0, 23), st.sampled_from((0, 30)))
DAY = st.sampled_from((*WEEKDAYS, "2026-05-05", "2026-05-06", "2026-05-10", "2026-05-11"))
ROWS = st.lists(
    st.one_of(st.builds(ScheduleRow, DAY, CLOCK, CLOCK), st.builds(ScheduleRow, DAY, st.just(""), st.just(""))),
    max_size=5,
)


@pytest.mark.parametrize(
    ("text", "days"),
    [
        ("mon", "mon"), ("Monday", "mon"), ("Mon.", "mon"), ("Mondays", "mon"), (" TUES ", "tue"),
        ("mon-fri", "mon tue wed thu fri"), ("Mon - Wed", "mon tue wed"), ("Fri to Mon", "fri sat sun mon"),
        ("sat, Sunday", "sat sun"), ("mon and wed", "mon wed"), ("weekdays", "mon tue wed thu fri"),
        ("weekend", "sat sun"), ("Every day", "mon tue wed thu fri sat sun"), ("mon\u2013tue", "mon tue"),
        ("2026-12-24", "2026-12-24"), ("2026-12-31 to 2027-01-01", "2026-12-31 2027-01-01"),
        ("2026-12-24-2026-12-25", "2026-12-24 2026-12-25"), ("mon, mon-tue", "mon tue"),
        ("someday", ""), ("", ""), ("mo", ""), ("mon-", ""), ("mon-tue-wed", ""), ("2026-02-30", ""), ("mon,", ""),
        ("2026-12-25 to 2026-12-24", ""), ("2026-01-01 to 2027-01-01", ""), ("24.12.2026", ""), ("month", ""),
    ],
)  # fmt: skip
def test_a_day_is_understood_as_it_is_written(text: str, days: str) -> None:
    assert " ".join(days_of(text)) == days


@given(st.text("monday-, to2026:.\u2013", max_size=24))
@settings(max_examples=200, deadline=None)
def test_a_text_names_days_that_come_or_none(text: str) -> None:
    assert all(day in WEEKDAYS or date.fromisoformat(day).isoformat() == day for day in days_of(text))


@given(ROWS)
@settings(max_examples=150, deadline=None)
def test_grouped_rows_say_the_same(rows: list[ScheduleRow]) -> None:
    shown = grouped(rows)
    assert len(shown) <= len(rows)
    assert set(expanded(shown)) == set(rows)


def test_a_week_with_two_special_days_needs_few_rows() -> None:
    week = [ScheduleRow(day, "10:00", "18:00") for day in WEEKDAYS]
    special = [ScheduleRow("2026-12-24", "", ""), ScheduleRow("2026-12-25", "", "")]
    assert [row.day for row in grouped([*week, *special])] == ["daily", "2026-12-24 to 2026-12-25"]


@given(ROWS)
@settings(max_examples=200, deadline=None)
def test_hours_are_refused_exactly_when_a_minute_is_named_twice(rows: list[ScheduleRow]) -> None:
    schedule = Schedule("UTC", tuple(rows))
    if _twice(schedule, FIRST, 8) or _twice(_weekly(schedule), FIRST, 8):
        with pytest.raises(UsageError) as caught:
            check_overlaps(schedule)
        assert (caught.value.code, bool(caught.value.remedy)) == ("schedule-overlap", True)
    else:
        check_overlaps(schedule)


def _weekly(schedule: Schedule) -> Schedule:
    """Every date is followed by weeks without one."""
    return Schedule("UTC", tuple(row for row in schedule.rows if row.day in WEEKDAYS))


def _twice(schedule: Schedule, first: date, days: int) -> bool:
    """Minute by minute, in steps of 30."""
    open_at: set[int] = set()
    for number in range(days):
        for row in rows_of(schedule, first + timedelta(number)):
            if not row.opens:
                continue
            at, end = (int(text[:2]) * 60 + int(text[3:]) + 1440 * number for text in (row.opens, row.closes))
            for minute in range(at, end if end > at else end + 1440, 30):
                if minute in open_at:
                    return True
                open_at.add(minute)
    return False
