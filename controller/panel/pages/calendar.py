"""The next days of a schedule, for display only; the kiosk itself decides when to open."""

from __future__ import annotations

import functools
import zoneinfo
from dataclasses import dataclass
from datetime import UTC, date, datetime, time, timedelta
from typing import Final

from controller.kiosk.interface import Schedule, ScheduleRow

DAYS: Final = ("mon", "tue", "wed", "thu", "fri", "sat", "sun")
SHOWN: Final = 14


@dataclass(frozen=True, slots=True)
class CalendarDay:
    """One day: ``hours`` are (opens, closes, appearance) as they are saved; ``bars`` are (first minute, minutes,
    appearance) within it; ``special``: whether a row for this date applies; ``check_minute`` of the nightly check, None
    without one.
    """

    day: date
    hours: tuple[tuple[str, str, str], ...]
    bars: tuple[tuple[int, int, str], ...]
    special: bool
    check_minute: int | None = None


def days(schedule: Schedule, first: date | None = None) -> list[CalendarDay]:
    """The next 14 days from ``first``, in the schedule's local time; default: today."""
    start = first or _today(schedule.time_zone)
    return [_day(schedule, start + timedelta(n)) for n in range(SHOWN)]


def _today(zone: str) -> date:
    try:
        return datetime.now(zoneinfo.ZoneInfo(zone)).date()
    except (zoneinfo.ZoneInfoNotFoundError, ValueError, OSError):
        return datetime.now(UTC).date()


def _day(schedule: Schedule, day: date) -> CalendarDay:
    rows, special = _rows(schedule, day)
    # Hours after midnight belong to the row of the day before, but are shown on this day.
    before, _ = _rows(schedule, day - timedelta(1))
    bars = [(0, end - 1440, row.appearance) for row in before for _, end in [_minutes(row)] if end > 1440]
    bars += [(start, min(end, 1440) - start, row.appearance) for row in rows for start, end in [_minutes(row)]]
    hours = tuple((row.opens, row.closes, row.appearance) for row in rows)
    check_minute = _minute(schedule.drift_check)
    if not schedule.rows:
        return CalendarDay(day, (), ((0, 1440, ""),), False, check_minute)
    return CalendarDay(day, hours, tuple(bars), special, check_minute)


def _minute(clock: str) -> int | None:
    try:
        at = time.fromisoformat(clock)
    except ValueError:
        return None
    return at.hour * 60 + at.minute


def _rows(schedule: Schedule, day: date) -> tuple[list[ScheduleRow], bool]:
    dated = [row for row in schedule.rows if row.day == day.isoformat()]
    rows = dated or [row for row in schedule.rows if row.day == DAYS[day.weekday()]]
    return [row for row in rows if row.opens and row.closes], bool(dated)


def _minutes(row: ScheduleRow) -> tuple[int, int]:
    start, end = (int(text[:2]) * 60 + int(text[3:5]) for text in (row.opens, row.closes))
    return start, end if end > start else end + 1440


@functools.cache
def zones() -> list[str]:
    """The time zones of places that this machine knows."""
    return sorted(name for name in zoneinfo.available_timezones() if "/" in name and not name.startswith("Etc/"))
