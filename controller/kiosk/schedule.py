"""Opening hours as Unix times: local times of a zone, exceptions, and clock changes. Pure functions.

Then days as people write them ("Monday", "mon-fri", "daily"), rows of hours as few as can be shown, and the stage's
schedule on disk: schedule.toml, written by the panel, or else the table [schedule] of stage.toml.
"""

from __future__ import annotations

import itertools
import re
import threading
import tomllib
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from datetime import date, datetime, timedelta
from datetime import time as time_of_day
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Final
from zoneinfo import ZoneInfo

from controller.core.errors import UsageError
from controller.core.files import read_text
from controller.core.storage import write_atomically
from controller.kiosk.values import IN_TURN, MIDNIGHT, Schedule, ScheduleRow

if TYPE_CHECKING:  # the models need pydantic, and `velatura --help` gets here
    from controller.config.models import ScheduleTable

WEEKDAYS: Final = ("mon", "tue", "wed", "thu", "fri", "sat", "sun")
_TIME: Final = re.compile(r"([01][0-9]|2[0-3]):[0-5][0-9]|24:00")
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


class _Day(str):
    """A day of a row that a person wrote, with the number of that row, from 1."""

    number: int = 0


def _day(text: str, number: int) -> _Day:
    day = _Day(text)
    day.number = number
    return day


def number_of(row: ScheduleRow) -> int:
    """Of the row that a person wrote; 0 where that is unknown."""
    return row.day.number if isinstance(row.day, _Day) else 0


def check_schedule(schedule: Schedule, appearances: Collection[str] | None = None) -> None:
    """Raises UsageError with the row's number. ``appearances``: the allowed names, None if they are not known."""
    zone_of(schedule.time_zone)
    if schedule.drift_check and not _TIME.fullmatch(schedule.drift_check):
        raise _wrong("The time of the drift check", schedule.drift_check, '"HH:MM", or empty')
    if len(schedule.rows) > MOST_ROWS:
        raise _wrong("The number of rows", str(len(schedule.rows)), f"at most {MOST_ROWS}")
    for place, row in enumerate(schedule.rows, 1):
        number = number_of(row) or place
        if row.day not in WEEKDAYS and _date(row.day) is None:
            raise _wrong(f"The day of row {number}", row.day, "mon to sun, or a date such as 2026-12-24")
        if bool(row.opens) != bool(row.closes):
            raise _wrong(
                f"The time span of row {number}", f"{row.opens}-{row.closes}", "both times, or neither (closed)"
            )
        for text in (row.opens, row.closes):
            if text and not _TIME.fullmatch(text):
                raise _wrong(f"A time of row {number}", text, '"HH:MM", from 00:00 to 24:00')
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
            rows = (
                " or ".join(f"row {number_of(row)}" for row in (one, other) if number_of(row)) or "one of the two rows"
            )
            raise UsageError(
                "schedule-overlap",
                what=f"Hours overlap ({name}): {one.opens}-{one.closes} and {other.opens}-{other.closes}.",
                remedy=f"Change {rows}, so that the first one closes before the other one opens.",
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
    if clock == MIDNIGHT:
        day, clock = day + timedelta(days=1), "00:00"
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


ALLOWED_DAYS: Final = "a weekday (Monday or mon), several (mon-fri or sat, sun), daily, or a date such as 2026-12-24"
MOST_DATES: Final = 100
"""Dates of one row."""
_NAMES: Final = ("monday", "tuesday", "wednesday", "thursday", "friday", "saturday", "sunday")
_GROUPS: Final = {
    "daily": WEEKDAYS, "every day": WEEKDAYS, "everyday": WEEKDAYS,
    "weekdays": WEEKDAYS[:5], "weekend": WEEKDAYS[5:], "weekends": WEEKDAYS[5:],
}  # fmt: skip
_BETWEEN: Final = re.compile(r"\s*(?:\bto\b|\buntil\b|\u2013|-)\s*")
_DATE: Final = r"20[0-9]{2}-[01][0-9]-[0-3][0-9]"
_DATES: Final = re.compile(rf"({_DATE})(?:\s*(?:to|until|\u2013|-)\s*({_DATE}))?")


def days_of(text: str) -> tuple[str, ...]:
    """The days that a text names, each "mon" to "sun" or "2026-12-24", in its order; empty if it names none."""
    found: list[str] = []
    for part in text.strip().lower().replace(" and ", ",").split(","):
        days = _part(part.strip())
        if not days:
            return ()
        found += days
    return tuple(dict.fromkeys(found))


def _part(text: str) -> Sequence[str]:
    if text in _GROUPS:
        return _GROUPS[text]
    if dates := _DATES.fullmatch(text):
        return _dates(dates[1], dates[2] or dates[1])
    ends = [_weekday(name) for name in _BETWEEN.split(text)]
    if not 1 <= len(ends) <= 2 or None in ends:
        return ()
    first, last = (number for number in (ends[0], ends[-1]) if number is not None)
    return [WEEKDAYS[(first + n) % 7] for n in range((last - first) % 7 + 1)]


def _weekday(text: str) -> int | None:
    """Its number from any beginning of at least three letters, with an s or a full stop behind it."""
    name = text.removesuffix(".")
    if len(name) < 3:
        return None
    return next((n for n, whole in enumerate(_NAMES) if whole.startswith(name) or name == f"{whole}s"), None)


def _dates(first: str, last: str) -> Sequence[str]:
    try:
        day, end = date.fromisoformat(first), date.fromisoformat(last)
    except ValueError:
        return ()
    if not 0 <= (end - day).days < MOST_DATES:
        return ()
    return [(day + timedelta(n)).isoformat() for n in range((end - day).days + 1)]


def expanded(rows: Sequence[ScheduleRow]) -> tuple[ScheduleRow, ...]:
    """A row for each day of each row. Raises UsageError("schedule-wrong") with the row's number."""
    result = []
    for number, row in enumerate(rows, 1):
        days = days_of(row.day)
        if not days:
            raise UsageError("schedule-wrong", what=f"The day of row {number} is {row.day[:64]!r}.",
                             remedy=f"Allowed: {ALLOWED_DAYS}.")  # fmt: skip
        result += [ScheduleRow(_day(day, number), row.opens, row.closes, row.appearance) for day in days]
    return tuple(result)


def grouped(rows: Sequence[ScheduleRow]) -> tuple[ScheduleRow, ...]:
    """The same hours in as few rows as possible: ``expanded`` makes the same days of them."""
    sets: dict[tuple[str, str, str, bool], list[str]] = {}
    result = []
    for row in rows:
        if days_of(row.day) == (row.day,):
            sets.setdefault((row.opens, row.closes, row.appearance, row.day in WEEKDAYS), []).append(row.day)
        else:
            # A damaged file; the page on which it is put right must show it.
            result.append(row)
    for (opens, closes, appearance, weekly), days in sets.items():
        texts = [_weekdays_text(days)] if weekly else _dates_texts(days)
        result += [ScheduleRow(text, opens, closes, appearance) for text in texts]
    return tuple(result)


def _weekdays_text(days: Sequence[str]) -> str:
    numbers = sorted({WEEKDAYS.index(day) for day in days})
    if len(numbers) == 7:
        return "daily"
    spans: list[list[int]] = []
    for number in numbers:
        if spans and spans[-1][-1] == number - 1:
            spans[-1].append(number)
        else:
            spans.append([number])
    return ", ".join(
        f"{WEEKDAYS[span[0]]}-{WEEKDAYS[span[-1]]}" if len(span) > 2 else ", ".join(WEEKDAYS[n] for n in span)
        for span in spans
    )


def _dates_texts(days: Sequence[str]) -> list[str]:
    spans: list[list[date]] = []
    for day in sorted({date.fromisoformat(one) for one in days}):
        if spans and spans[-1][-1] == day - timedelta(1) and len(spans[-1]) < MOST_DATES:
            spans[-1].append(day)
        else:
            spans.append([day])
    return [f"{span[0]} to {span[-1]}" if len(span) > 1 else str(span[0]) for span in spans]


FILE: Final = "schedule.toml"
_HEADING: Final = "# Opening hours, written by the panel. This file replaces [schedule] in stage.toml.\n\n"


def of_table(table: ScheduleTable) -> Schedule:
    """The days may be written as on the panel's page. Raises UsageError as ``expanded`` and ``check_schedule``."""
    rows = expanded([ScheduleRow(row.day, row.opens, row.closes, row.appearance) for row in table.hours])
    schedule = Schedule(table.time_zone, rows, table.drift_check)
    check_schedule(schedule)
    return schedule


def check(schedule: Schedule, appearances: Collection[str]) -> None:
    """What is refused before it is kept. Raises UsageError as ``check_schedule`` and ``check_overlaps``."""
    check_schedule(schedule, appearances)
    check_overlaps(schedule)


class ScheduleFile:
    """The current schedule; read once, changed by ``replace``. Thread-safe."""

    def __init__(self, stage: Path, table: ScheduleTable) -> None:
        self._path, self._lock = stage / FILE, threading.Lock()
        self._without_time = table.without_time
        self.problem: UsageError | None = None
        self._now = of_table(table)
        try:
            self._now = self._read() or self._now
        except UsageError as error:
            # A damaged file must not keep the stage dark; the hours of stage.toml apply until it is saved again.
            self.problem = error

    @property
    def now(self) -> Schedule:
        return self._now

    @property
    def open_without_time(self) -> bool:
        return self._without_time == "open"

    def replace(self, schedule: Schedule, appearances: Collection[str]) -> None:
        """Check it, write it, and use it. Raises as ``check``, WorkError("no-space")."""
        from controller.config.writer import toml_text

        check(schedule, appearances)
        hours = [
            {"day": row.day, "opens": row.opens, "closes": row.closes, "appearance": row.appearance}
            for row in schedule.rows
        ]
        content = {
            "time_zone": schedule.time_zone, "drift_check": schedule.drift_check,
            "without_time": self._without_time, "hours": hours,
        }  # fmt: skip
        with self._lock:
            write_atomically(self._path, (_HEADING + toml_text(content)).encode())
            self._now, self.problem = schedule, None

    def _read(self) -> Schedule | None:
        from controller.config.models import ScheduleTable

        try:
            content = tomllib.loads(read_text(self._path))
            table = ScheduleTable.model_validate(content)
        except FileNotFoundError:
            return None
        except (OSError, ValueError, RecursionError) as error:  # a ValidationError is a ValueError
            raise UsageError(
                "schedule-unreadable",
                what=f"{FILE} can't be read: {_reason(error)}.",
                remedy="Save the schedule again in the panel. Until then the hours in stage.toml apply.",
            ) from error
        self._without_time = table.without_time
        return of_table(table)


def _reason(error: Exception) -> str:
    return (error.strerror if isinstance(error, OSError) else None) or (str(error).splitlines() or ["it is not valid"])[
        0
    ]
