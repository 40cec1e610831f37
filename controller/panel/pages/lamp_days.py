"""The history of lamps as people read it: what each burnt on each day."""

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
class Burnt:
    """One day: ``hours`` and ``strikes`` of that day alone."""

    day: str
    hours: float
    strikes: int


@dataclass(frozen=True, slots=True)
class LampStory:
    """A lamp with its last days, newest first, and what the event log says of it, newest first."""

    lamp: Lamp
    days: tuple[Burnt, ...]
    events: tuple[EventRow, ...]

    @property
    def hours_a_strike(self) -> float | None:
        """Lamps age by strikes as well as by hours; a few minutes a strike wear one out. None before the first."""
        return self.lamp.hours / self.lamp.strikes if self.lamp.strikes else None

    @property
    def worn_by_strikes(self) -> bool:
        """Whether it was struck often, and burnt less than half an hour each time."""
        hours = self.hours_a_strike
        return hours is not None and hours < 0.5 and self.lamp.strikes >= OFTEN


def stories(lamps: Sequence[Lamp], history: Sequence[LampDay], events: Sequence[EventRow]) -> list[LampStory]:
    """One story a lamp, in the order of ``lamps``."""
    told = [row for row in events if row.code.startswith("lamp-")]
    longest_first = sorted((lamp.projector for lamp in lamps), key=len, reverse=True)
    named = [(row, _named(row.text, longest_first)) for row in told]
    return [_story(lamp, history, [row for row, names in named if lamp.projector in names]) for lamp in lamps]


def _named(text: str, longest_first: Sequence[str]) -> set[str]:
    """The projectors of which a text speaks; "left" is not meant where it says "far left"."""
    found = set()
    for name in longest_first:
        whole = re.compile(rf"(?<![^\s,]){re.escape(name)}(?![^\s,.;:])")
        if whole.search(text):
            found.add(name)
            text = whole.sub("\x00", text)
    return found


def _story(lamp: Lamp, history: Sequence[LampDay], told: Sequence[EventRow]) -> LampStory:
    own = [one for one in history if one.projector == lamp.projector]
    burnt = [
        # A counter that went back was set back with a new lamp.
        Burnt(now.day, max(0.0, now.hours - then.hours), max(0, now.strikes - then.strikes))
        for then, now in zip([LampDay(lamp.projector, "", 0.0, 0), *own], own, strict=False)
    ]
    if len(own) > 0 and own[0].strikes > 1:
        # What the counter held before the history began belongs to no day.
        burnt = burnt[1:]
    return LampStory(lamp, tuple(burnt[::-1][:SHOWN_DAYS]), tuple(told[::-1][:SHOWN_EVENTS]))
