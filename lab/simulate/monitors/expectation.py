"""Whether a stage is to be open: by its hours, and by what people said. And whether that can be known from outside."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from datetime import datetime, timedelta
from typing import Final
from zoneinfo import ZoneInfo

_DAYS: Final = ("mon", "tue", "wed", "thu", "fri", "sat", "sun")
_FAR_S: Final = 9 * 86_400.0


class Calendar:
    """Opening hours of a zone; ``rows`` have day, opens and closes."""

    def __init__(self, zone: str, rows: Sequence[Mapping[str, str]]) -> None:
        self._zone, self._hours = ZoneInfo(zone), {row["day"]: (row["opens"], row["closes"]) for row in rows}

    def open(self, unix_s: float) -> bool:
        now = datetime.fromtimestamp(unix_s, self._zone)
        later = now
        while later.fold:
            # Of times that come twice, the first counts: in the second pass all of them are over.
            unix_s += 60
            now, later = later, datetime.fromtimestamp(unix_s, self._zone)
        clock, today = now.strftime("%H:%M"), self._span(now)
        if today is not None:
            opens, closes = today
            if clock >= opens and (closes <= opens or clock < closes):
                return True
        before = self._span(now - timedelta(days=1))
        return before is not None and before[1] <= before[0] and clock < before[1]

    def changes_s(self, unix_s: float) -> float:
        """When this changes next, to the second; infinite without hours. Minutes are whole in every zone."""
        was, at_s = self.open(unix_s), unix_s - unix_s % 60
        while at_s < unix_s + _FAR_S:
            # A quarter of an hour, then minutes: hours are of at least an hour.
            if self.open(at_s + 900) is not was:
                return next(at_s + 60 * minute for minute in range(1, 16) if self.open(at_s + 60 * minute) is not was)
            at_s += 900
        return float("inf")

    def _span(self, day: datetime) -> tuple[str, str] | None:
        return self._hours.get(_DAYS[day.weekday()])


SETTLING_S: Final = 200.0
"""After a change of any kind, the stage may be between what it did and what it has to do: warm-up, rests, cooling."""
FAR_S: Final = 9 * 86_400.0


class OpeningExpectation:
    """``truth``: Unix seconds as they are.

    What people say lasts until the hours change next. While the kiosk has no time, that is the first change after it
    has one again. A kiosk whose time or hours are wrong ends it at another moment, which is not worked out here: then
    no one is ``sure`` until the first change after both are right.
    """

    def __init__(self, calendar: Calendar, truth: Callable[[], float]) -> None:
        self._calendar, self._truth = calendar, truth
        self._edge_s, self._open = -1.0, False
        self._said: tuple[bool, float | None] | None = None
        """What people said, and until when (Unix seconds); None: until the first change after the time is known."""
        self.unknown = False
        """Whether the kiosk has no time. Then it is closed, unless people say something else."""
        self._wrong_until_s = self._unsure_until_s = 0.0
        self._forgotten = False
        self._ran_s = 0.0
        """When the kiosk was last seen to run with a time, and with a disk that takes what it has to remember."""
        self._ended_s = -1.0
        """When what people said ended last."""

    def open(self) -> bool:
        """Whether it is to be open now."""
        truth_s = self._truth()
        if truth_s >= self._edge_s:
            self._open, self._edge_s = self._calendar.open(truth_s), self._calendar.changes_s(truth_s)
        report = self._said
        if report is not None and not self.unknown and report[1] is not None and truth_s >= report[1]:
            self._ended_s, report, self._said = report[1], None, None
        return report[0] if report is not None else self._open and not self.unknown

    def edge_s(self) -> float:
        """When hours change next (Unix seconds)."""
        self.open()
        return self._edge_s

    @property
    def sure(self) -> bool:
        """Whether the kiosk has to take itself for open exactly when ``open`` says so."""
        return self._truth() > max(self._wrong_until_s, self._unsure_until_s) and not (self.unknown and self._forgotten)

    # -- incidents

    def ran(self, *, remembers: bool) -> None:
        """The kiosk runs now. ``remembers``: its disk takes what it has to know after a restart."""
        if not self.unknown and remembers:
            self._ran_s = self._truth()

    def say(self, wanted: bool) -> None:
        """A person opened or closed the stage."""
        self._said = (wanted, None) if self.unknown else None
        if self.open() is not wanted:
            self._said = (wanted, self._edge_s)
        if self._truth() <= self._wrong_until_s:
            self.unsure_until_hours()

    def use(self, calendar: Calendar) -> None:
        """New hours: what a person said stays, until they change next, if they say the same as the old ones."""
        truth_s = self._truth()
        before, self._calendar, self._edge_s = self._calendar.open(truth_s), calendar, -1.0
        if not self.sure or (self.unknown and self._said is not None and self._said[1] is not None):
            self.unsure_until_hours()
        elif self._said is not None and not self.unknown:
            same = calendar.open(truth_s) is before
            self._said = (self._said[0], calendar.changes_s(truth_s)) if same else None
        self.open()

    def lose_time(self) -> None:
        """The kiosk knows that it has no time. For one of which everything is sure.

        But what people said may still hold, if it had no power, or nothing could be written, when that was to end.
        """
        self.unknown = True
        unsure = self._forgotten and self._ran_s <= self._unsure_until_s
        self._forgotten = unsure or self._ran_s <= self._ended_s

    def find_time(self) -> None:
        """It has the right one again."""
        self.unknown = False
        if self._forgotten:
            self.unsure_until_hours()
        elif self._said is not None and self._said[1] is None:
            self.say(self._said[0])

    def wrong(self, duration_s: float, *, has_time: bool = False) -> None:
        """For so long its time or its hours may be wrong. ``has_time``: it has a time now, if it had none."""
        truth_s = self._truth()
        doubtful = self.unknown or self._said is not None or truth_s <= self._unsure_until_s
        self.unknown = self.unknown and not has_time
        self._wrong_until_s = max(self._wrong_until_s, truth_s + duration_s)
        if doubtful:
            self.unsure_until_hours()

    def unsure_until_hours(self) -> None:
        """What people said may have ended, or not."""
        self._said, self._forgotten = None, True
        from_s = max(self._truth(), self._wrong_until_s)
        edge_s = min(self._calendar.changes_s(from_s), from_s + FAR_S)
        self._unsure_until_s = max(self._unsure_until_s, edge_s + SETTLING_S)
