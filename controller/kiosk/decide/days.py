"""Days as people write them ("Monday", "mon-fri", "daily"), and rows of hours as few as can be shown."""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import date, timedelta
from typing import Final

from controller.core.errors import UsageError
from controller.kiosk.decide.hours import WEEKDAYS
from controller.kiosk.interface import ScheduleRow

ALLOWED: Final = "a weekday (Monday or mon), several (mon-fri or sat, sun), daily, or a date such as 2026-12-24"
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
            raise UsageError(
                "schedule-wrong", what=f"The day of row {number} is {row.day[:64]!r}.", remedy=f"Allowed: {ALLOWED}."
            )
        result += [ScheduleRow(day, row.opens, row.closes, row.appearance) for day in days]
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
