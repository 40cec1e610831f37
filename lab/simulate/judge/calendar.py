"""Whether a stage is to be open, worked out a second time: from local dates and times as text, without the planner."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
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
