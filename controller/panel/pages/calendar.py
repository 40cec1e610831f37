"""Days for display: the next ones of a schedule, and the past ones of the lamps. The kiosk decides when to open."""

from __future__ import annotations

import functools
import re
import zoneinfo
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, date, datetime, time, timedelta
from typing import Final

from controller.kiosk.schedule import grouped
from controller.kiosk.state import EventRow, Lamp
from controller.kiosk.values import MIDNIGHT, LampDay, Schedule, ScheduleRow

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


def later(schedule: Schedule, first: date | None = None) -> list[ScheduleRow]:
    """The special days after those of ``days``, in as few rows as possible."""
    last = ((first or _today(schedule.time_zone)) + timedelta(SHOWN - 1)).isoformat()
    return list(grouped([row for row in schedule.rows if row.day not in DAYS and row.day > last]))


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
        at = time.fromisoformat(clock.replace(MIDNIGHT, "00:00"))
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


SHOWN_DAYS: Final = 21
SHOWN_EVENTS: Final = 12
OFTEN: Final = 20


@dataclass(frozen=True, slots=True)
class LampUse:
    """One day: ``hours`` and ``strikes`` of that day alone."""

    day: str
    hours: float
    strikes: int


@dataclass(frozen=True, slots=True)
class LampReport:
    """A lamp with its last days and its entries in the event log, both newest first."""

    lamp: Lamp
    days: tuple[LampUse, ...]
    events: tuple[EventRow, ...]

    @property
    def hours_a_strike(self) -> float | None:
        """Hours per strike; frequent strikes wear a lamp out. None before the first strike."""
        return self.lamp.hours / self.lamp.strikes if self.lamp.strikes else None

    @property
    def worn_by_strikes(self) -> bool:
        """Whether it was switched on often, for less than half an hour each time on average."""
        hours = self.hours_a_strike
        return hours is not None and hours < 0.5 and self.lamp.strikes >= OFTEN


def lamp_reports(lamps: Sequence[Lamp], history: Sequence[LampDay], events: Sequence[EventRow]) -> list[LampReport]:
    """One entry per lamp, in the order of ``lamps``."""
    lamp_events = [row for row in events if row.code.startswith("lamp-")]
    longest_first = sorted((lamp.projector for lamp in lamps), key=len, reverse=True)
    named = [(row, _named(row.text, longest_first)) for row in lamp_events]
    return [_report(lamp, history, [row for row, names in named if lamp.projector in names]) for lamp in lamps]


def _named(text: str, longest_first: Sequence[str]) -> set[str]:
    """The projectors that a text names; "far left" does not name "left"."""
    named = set()
    for name in longest_first:
        whole = re.compile(rf"(?<![^\s,]){re.escape(name)}(?![^\s,.;:])")
        if whole.search(text):
            named.add(name)
            text = whole.sub("\x00", text)
    return named


def _report(lamp: Lamp, history: Sequence[LampDay], events: Sequence[EventRow]) -> LampReport:
    own = [row for row in history if row.projector == lamp.projector]
    days = [
        # A counter that went back was reset with a new lamp.
        LampUse(now.day, max(0.0, now.hours - then.hours), max(0, now.strikes - then.strikes))
        for then, now in zip([LampDay(lamp.projector, "", 0.0, 0), *own], own, strict=False)
    ]
    if len(own) > 0 and own[0].strikes > 1:
        # The counter's value before the history began belongs to no day.
        days = days[1:]
    return LampReport(lamp, tuple(days[::-1][:SHOWN_DAYS]), tuple(events[::-1][:SHOWN_EVENTS]))
