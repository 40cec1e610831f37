"""Opening hours as Unix times: local times of a zone, exceptions, and clock changes. Pure functions."""

from __future__ import annotations

import itertools
import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from datetime import date, datetime, timedelta
from datetime import time as time_of_day
from functools import lru_cache
from typing import Final
from zoneinfo import ZoneInfo

from controller.core.errors import UsageError
from controller.kiosk.decide.interfaces import IN_TURN
from controller.kiosk.interface import Schedule, ScheduleRow

WEEKDAYS: Final = ("mon", "tue", "wed", "thu", "fri", "sat", "sun")
_TIME: Final = re.compile(r"([01][0-9]|2[0-3]):[0-5][0-9]")
MOST_ROWS: Final = 1000


@dataclass(frozen=True, slots=True)
class Opening:
    """The stage is open from ``begins_s`` until ``ends_s`` (Unix seconds); ``appearance`` empty: what played last."""

    begins_s: float
    ends_s: float
    appearance: str = ""


def zone_of(name: str) -> ZoneInfo:
    """Raises UsageError("schedule-zone") for a name that the time zone database does not have."""
    try:
        return _zone(name)
    except (KeyError, ValueError, OSError) as error:
        raise UsageError(
            "schedule-zone",
            what=f"There is no time zone {name[:64]!r}.",
            remedy='Use a name of the IANA database, for example "Europe/Vienna" or "UTC".',
        ) from error


@lru_cache(maxsize=64)
def _zone(name: str) -> ZoneInfo:
    return ZoneInfo(name)


def check_schedule(schedule: Schedule, appearances: Collection[str] | None = None) -> None:
    """Raises UsageError with the row's number. ``appearances``: the allowed names, None if they are not known."""
    zone_of(schedule.time_zone)
    if schedule.drift_check and not _TIME.fullmatch(schedule.drift_check):
        raise _wrong("The time of the drift check", schedule.drift_check, '"HH:MM", or empty')
    if len(schedule.rows) > MOST_ROWS:
        raise _wrong("The number of rows", str(len(schedule.rows)), f"at most {MOST_ROWS}")
    for number, row in enumerate(schedule.rows, 1):
        if row.day not in WEEKDAYS and _date(row.day) is None:
            raise _wrong(f"The day of row {number}", row.day, "mon to sun, or a date such as 2026-12-24")
        if bool(row.opens) != bool(row.closes):
            raise _wrong(
                f"The time span of row {number}", f"{row.opens}-{row.closes}", "both times, or neither (closed)"
            )
        for text in (row.opens, row.closes):
            if text and not _TIME.fullmatch(text):
                raise _wrong(f"A time of row {number}", text, '"HH:MM", from 00:00 to 23:59')
        if row.appearance not in ("", IN_TURN) and appearances is not None and row.appearance not in appearances:
            known = ", ".join(sorted(appearances))
            allowed = (
                f"one of {known}, or {IN_TURN} for all in turn"
                if known
                else "none, because the stage has no appearances yet"
            )
            raise _wrong(f"The appearance of row {number}", row.appearance, allowed)


def check_overlaps(schedule: Schedule) -> None:
    """Raises UsageError("schedule-overlap") for hours of which two run at the same time, with day and hours.

    Apart from ``check_schedule``: a stage whose old schedule has such hours must still open.
    """
    dates = [date.fromisoformat(row.day) for row in schedule.rows if row.day not in WEEKDAYS]
    for day in dates:
        for other in (day - timedelta(days=1), day):
            _check_day(rows_of(schedule, other), rows_of(schedule, other + timedelta(days=1)), day.isoformat())
    for number, name in enumerate(WEEKDAYS):
        today, tomorrow = ([row for row in schedule.rows if row.day == WEEKDAYS[n % 7]] for n in (number, number + 1))
        _check_day(today, tomorrow, name)


def _check_day(today: Sequence[ScheduleRow], tomorrow: Sequence[ScheduleRow], name: str) -> None:
    spans = [(*_minutes(row, 0), row) for row in today if row.opens]
    spans += [(*_minutes(row, 1440), row) for row in tomorrow if row.opens]
    spans.sort(key=lambda span: span[:2])
    for (first, ends, one), (begins, _, other) in itertools.pairwise(spans):
        if begins < ends and first < 1440:
            raise UsageError(
                "schedule-overlap",
                what=f"Hours overlap ({name}): {one.opens}-{one.closes} and {other.opens}-{other.closes}.",
                remedy="Change one of the two rows, so that the first one closes before the other one opens.",
            )


def _minutes(row: ScheduleRow, from_minute: int) -> tuple[int, int]:
    start, end = (int(text[:2]) * 60 + int(text[3:]) + from_minute for text in (row.opens, row.closes))
    return start, end if end > start else end + 1440


def _wrong(what: str, value: str, allowed: str) -> UsageError:
    return UsageError("schedule-wrong", what=f"{what} is {value[:64]!r}.", remedy=f"Allowed: {allowed}.")


def _date(text: str) -> date | None:
    """Only the form of ``date.isoformat``: rows are looked up by that text, and "2026-W53-4" would never match."""
    try:
        day = date.fromisoformat(text)
    except ValueError:
        return None
    return day if day.isoformat() == text else None


def moment(day: date, clock: str, zone: ZoneInfo) -> float:
    """Unix seconds of a local time. Skipped times shift with the clock; of repeated times, the first counts."""
    return datetime.combine(day, time_of_day.fromisoformat(clock), tzinfo=zone).timestamp()


def local_day(unix_s: float, zone: ZoneInfo) -> date:
    return datetime.fromtimestamp(unix_s, zone).date()


def rows_of(schedule: Schedule, day: date) -> Sequence[ScheduleRow]:
    """The rows of this date, or else those of its weekday."""
    own = [row for row in schedule.rows if row.day == day.isoformat()]
    return own or [row for row in schedule.rows if row.day == WEEKDAYS[day.weekday()]]


def openings(schedule: Schedule, around_s: float, *, days: int = 8) -> Sequence[Opening]:
    """Openings that begin on the day before ``around_s`` or on the ``days`` days after it, sorted."""
    return _openings(schedule, local_day(around_s, zone_of(schedule.time_zone)) - timedelta(days=1), days)


@lru_cache(maxsize=8)
def _openings(schedule: Schedule, first: date, days: int) -> tuple[Opening, ...]:
    # Called four times a second, and the same all day.
    zone, result = zone_of(schedule.time_zone), []
    for number in range(days + 1):
        day = first + timedelta(days=number)
        for row in rows_of(schedule, day):
            if not row.opens:
                continue
            last = day + timedelta(days=1) if row.closes <= row.opens else day
            begins_s, ends_s = moment(day, row.opens, zone), moment(last, row.closes, zone)
            if ends_s > begins_s:
                result.append(Opening(begins_s, ends_s, row.appearance))
    return tuple(sorted(result, key=lambda opening: (opening.begins_s, opening.ends_s)))


def always_open(schedule: Schedule) -> bool:
    """Whether the schedule has no hours: such a stage plays whenever it has power."""
    return not schedule.rows
