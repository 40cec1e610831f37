"""The history of lamps for display: hours and strikes of each day."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from controller.kiosk.interface import EventRow, Lamp, LampDay

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
