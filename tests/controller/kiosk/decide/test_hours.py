"""Opening hours as moments, against minutes counted one by one; and what is refused before it is kept."""

from __future__ import annotations

from datetime import UTC, date, datetime, timedelta
from zoneinfo import ZoneInfo

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from controller.core.errors import UsageError
from controller.kiosk.schedule import MOST_ROWS, WEEKDAYS, check_schedule, moment, openings, rows_of, zone_of
from controller.kiosk.values import Schedule, ScheduleRow

ZONES = ("UTC", "Europe/Vienna", "America/New_York", "Australia/Lord_Howe", "Asia/Kathmandu", "America/St_Johns",
         "Africa/Casablanca", "Pacific/Chatham", "America/Asuncion")  # fmt: skip


@pytest.mark.parametrize(
    "day",
    ["2026-W01-1", "2026-W53-4", "20261224", "2026-358", "2026-13-01", "2026-02-29", "Mon", "mon ", "", "2026-12-24\n",
     "\uff12026-12-24", "-026-12-24", "monday", "x" * 10_000],
)  # fmt: skip
def test_a_day_that_would_never_come_is_refused(day: str) -> None:
    with pytest.raises(UsageError) as caught:
        check_schedule(Schedule("UTC", (ScheduleRow("mon", "10:00", "18:00"), ScheduleRow(day, "", ""))))
    assert caught.value.code == "schedule-wrong"
    assert "row 2" in caught.value.what
    assert len(caught.value.what) < 400


@given(st.text("0123456789-W:monTZ ", min_size=1, max_size=12))
@settings(max_examples=200, deadline=None)
def test_a_day_that_is_accepted_comes(text: str) -> None:
    row = ScheduleRow(text, "10:00", "11:00")
    try:
        check_schedule(Schedule("UTC", (row,)))
    except UsageError:
        return
    start = date.fromisoformat(text) if text not in WEEKDAYS else date(2026, 1, 1)
    assert any(row in rows_of(Schedule("UTC", (row,)), start + timedelta(days=n)) for n in range(7))


@pytest.mark.parametrize(
    "zone",
    ["", "Europe", "../etc/passwd", "/etc/passwd", "Europe/Vienna\x00", "\ud800", "zone.tab", "europe vienna",
     "a" * 5000, "Europe/Vienna/.."],
)  # fmt: skip
def test_a_zone_that_is_none_is_refused_in_words(zone: str) -> None:
    with pytest.raises(UsageError) as caught:
        zone_of(zone)
    assert caught.value.code == "schedule-zone"
    assert len(caught.value.what) < 400


def test_midnights_and_hours_that_do_not_exist_or_come_twice() -> None:
    def local(zone: str, day: str, clock: str) -> str:
        place = ZoneInfo(zone)
        return datetime.fromtimestamp(moment(date.fromisoformat(day), clock, place), place).isoformat()

    assert local("Europe/Vienna", "2026-03-29", "02:30") == "2026-03-29T03:30:00+02:00"
    assert local("Europe/Vienna", "2026-10-25", "02:30") == "2026-10-25T02:30:00+02:00"
    assert local("America/Santiago", "2026-09-06", "00:00") == "2026-09-06T01:00:00-03:00"
    assert local("Australia/Lord_Howe", "2026-10-04", "02:15") == "2026-10-04T02:45:00+11:00"


CLOCK = st.builds("{:02d}:{:02d}".format, st.integers(0, 23), st.sampled_from((0, 15, 30, 59)))
DAY = st.one_of(st.sampled_from(WEEKDAYS), st.sampled_from(("2026-03-29", "2026-10-25", "2026-10-04", "2026-11-01")))
ROW = st.one_of(
    st.builds(ScheduleRow, DAY, CLOCK, CLOCK, st.sampled_from(("", "marble"))),
    st.builds(ScheduleRow, DAY, st.just(""), st.just("")),
)
AROUND = st.sampled_from(
    [datetime(2026, month, day, 12, tzinfo=UTC) for month, day in ((3, 28), (10, 3), (10, 24), (10, 31), (6, 1))]
)


@given(st.sampled_from(ZONES), st.lists(ROW, min_size=1, max_size=6), AROUND)
@settings(max_examples=60, deadline=None)
def test_openings_are_the_hours_as_a_clock_on_the_wall_shows_them(
    zone: str, rows: list[ScheduleRow], around: datetime
) -> None:
    schedule, place = Schedule(zone, tuple(rows)), ZoneInfo(zone)
    check_schedule(schedule)
    found = openings(schedule, around.timestamp(), days=3)
    assert list(found) == sorted(found, key=lambda one: (one.begins_s, one.ends_s))
    assert all(0 < one.ends_s - one.begins_s <= 25.5 * 3600 for one in found)
    today = around.astimezone(place).date()
    for hour in range(48):
        now = around + timedelta(minutes=30 * hour + 7)
        clock = now.astimezone(place)
        # Where the clock is set, the same reading comes twice or never; that night has tests of its own.
        if clock.utcoffset() != (clock - timedelta(hours=26)).utcoffset():
            continue
        if now.astimezone(place).date() > today + timedelta(days=1):
            continue
        assert any(one.begins_s <= now.timestamp() < one.ends_s for one in found) is _open_by_wall(rows, clock)


def _open_by_wall(rows: list[ScheduleRow], now: datetime) -> bool:
    reading = f"{now:%H:%M}"

    def of(day: date) -> list[ScheduleRow]:
        own = [row for row in rows if row.day == f"{day:%Y-%m-%d}"]
        return own or [row for row in rows if row.day == f"{day:%a}".lower()]

    for row in of(now.date()):
        if row.opens and row.opens <= reading and (reading < row.closes or row.closes <= row.opens):
            return True
    return any(row.opens and row.closes <= row.opens and reading < row.closes for row in of(now.date() - timedelta(1)))


def test_no_more_rows_than_anybody_reads() -> None:
    row = ScheduleRow("mon", "10:00", "11:00")
    check_schedule(Schedule("UTC", (row,) * MOST_ROWS))
    with pytest.raises(UsageError, match="number of rows"):
        check_schedule(Schedule("UTC", (row,) * (MOST_ROWS + 1)))
