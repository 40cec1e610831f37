"""The calendar shows the hours that the supervisor keeps; an oracle that it does not share code with."""

from __future__ import annotations

import contextlib
from datetime import UTC, date, datetime, timedelta

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from controller.kiosk.schedule import openings, zone_of
from controller.kiosk.values import Schedule, ScheduleRow
from controller.panel.pages.calendar import DAYS, SHOWN, days, zones

MONDAY = date(2026, 5, 4)
CLOCK = st.builds("{:02d}:{:02d}".format, st.integers(0, 23), st.integers(0, 59))
NAMED = st.sampled_from((*DAYS, "2026-05-04", "2026-05-05", "2026-05-17", "2026-05-18", "2026-05-03"))
ROW = st.one_of(
    st.builds(ScheduleRow, NAMED, CLOCK, CLOCK, st.sampled_from(("", "marble"))),
    st.builds(ScheduleRow, NAMED, st.just(""), st.just("")),
)


@given(st.lists(ROW, max_size=8))
@settings(max_examples=80, deadline=None)
def test_the_bars_are_the_openings(rows: list[ScheduleRow]) -> None:
    schedule = Schedule("UTC", tuple(rows))
    shown = days(schedule, MONDAY)
    assert [one.day for one in shown] == [MONDAY + timedelta(number) for number in range(SHOWN)]
    begins = datetime.combine(MONDAY, datetime.min.time(), UTC).timestamp()
    kept = set[int]() if rows else set(range(SHOWN * 1440))
    for one in openings(schedule, begins, days=SHOWN + 1):
        kept |= set(range(round((one.begins_s - begins) / 60), round((one.ends_s - begins) / 60)))
    drawn = set[int]()
    for number, day in enumerate(shown):
        for start, minutes, appearance in day.bars:
            assert minutes > 0
            assert start >= 0
            assert start + minutes <= 1440
            assert appearance in ("", "marble")
            drawn |= set(range(1440 * number + start, 1440 * number + start + minutes))
        assert day.special == any(row.day == day.day.isoformat() for row in rows)
    assert drawn == {minute for minute in kept if 0 <= minute < 1440 * SHOWN}


def test_hours_past_midnight_are_seen_on_the_next_day_and_told_on_their_own() -> None:
    schedule = Schedule("UTC", (ScheduleRow("mon", "22:00", "02:30", "marble"), ScheduleRow("tue", "10:00", "00:00")))
    monday, tuesday, wednesday = days(schedule, MONDAY)[:3]
    assert monday.bars == ((1320, 120, "marble"),)
    assert monday.hours == (("22:00", "02:30", "marble"),)
    assert tuesday.bars == ((0, 150, "marble"), (600, 840, ""))
    assert (wednesday.bars, wednesday.hours, wednesday.special) == ((), (), False)


@pytest.mark.parametrize("zone", ["Europe/Vienna", "Pacific/Kiritimati", "Nowhere/At_All", "", "../etc", "\ud800"])
def test_it_begins_today_where_the_stage_is(zone: str) -> None:
    place = UTC
    with contextlib.suppress(Exception):
        place = zone_of(zone)  # type: ignore[assignment]
    before = datetime.now(place).date()
    first = days(Schedule(zone))[0].day
    assert before <= first <= datetime.now(place).date()


def test_every_zone_that_is_offered_can_be_chosen() -> None:
    assert "Europe/Vienna" in zones()
    assert not [name for name in zones() if "/" not in name or name.startswith("Etc/")], "places alone"
    for name in zones()[::25]:
        zone_of(name)
