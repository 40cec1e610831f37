"""What operators set against the schedule: open or closed for now, and the appearance."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from datetime import datetime
from typing import Any, Final

from controller.kiosk.decide.planner import Plan, plan
from controller.kiosk.schedule import openings, zone_of
from controller.kiosk.store.event_log import EventLog
from controller.kiosk.values import IN_TURN, Schedule
from hal.notices import Notice

KEY: Final = "live-changes"


@dataclass(frozen=True, slots=True)
class LiveChanges:
    """``held``: the appearance at which the list is paused, or empty; ``first``: where the list begins, or empty;
    ``fade_s``: how long the next picture fades in, None: as the list says; ``brightness``: 0..1.
    """

    black: bool = False
    held: str = ""
    first: str = ""
    brightness: float = 1.0
    fade_s: float | None = None


class LiveChangesKept:
    """They are stored in the event log's file, to survive a restart."""

    def __init__(self, log: EventLog) -> None:
        self._log = log
        self.now = _read(log.value(KEY))

    def change(self, **values: Any) -> None:
        self._set(replace(self.now, **values))

    def end(self) -> None:
        """Back to the usual, as when the stage closes."""
        self._set(LiveChanges())

    def _set(self, changes: LiveChanges) -> None:
        if changes != self.now:
            self.now = changes
            self._log.keep(KEY, json.dumps(asdict(changes)))


def _read(text: str | None) -> LiveChanges:
    """A damaged entry only ends the changes."""
    try:
        stored: Any = json.loads(text or "{}")
    except (ValueError, RecursionError):
        return LiveChanges()
    usual = LiveChanges()
    if not isinstance(stored, dict) or set(stored) != {field.name for field in fields(LiveChanges)}:
        return usual
    brightness, fade_s = stored["brightness"], stored["fade_s"]
    right = isinstance(stored["black"], bool) and isinstance(stored["held"], str) and isinstance(stored["first"], str)
    right = right and isinstance(brightness, int | float) and 0 <= brightness <= 1
    right = right and (fade_s is None or (isinstance(fade_s, int | float) and 0 <= fade_s <= 600))
    return LiveChanges(**stored) if right else usual


@dataclass(frozen=True, slots=True)
class Override:
    """An operator ``wanted`` the stage open (or closed) while the schedule ``said`` otherwise.

    ``said``: None while the time was unknown; ``until_s``: the next scheduled change, as last computed; None if there
    was none.
    """

    wanted: bool
    said: bool | None
    until_s: float | None = None


class OperatorOverrides:
    """Stored in the event log's file, to survive a restart. ``without_time``: open while the time is unknown."""

    def __init__(self, log: EventLog, *, without_time: bool) -> None:
        self._log = log
        self._without_time = without_time
        self._override = _override_in(log.value("override"))
        self._missed = self._override is not None
        """Whether scheduled changes may have passed unseen."""
        self._chosen = log.value("chosen") or ""
        self._scheduled = log.value("scheduled") or ""

    def open(self, plan: Plan) -> bool:
        return self._override.wanted if self._override is not None else self._says(plan)

    def would_be_open(self, plan: Plan) -> bool:
        """As ``open``, if this were the plan: an operator's request ends when the schedule says something new."""
        override, says = self._override, self._says(plan)
        return override.wanted if override is not None and override.said in (None, says) else says

    def override(self, wanted: bool, plan: Plan) -> None:
        """Open or closed until the next scheduled change. Without the time: until the first one after it is known."""
        self._set(Override(wanted, plan.open, plan.changes_s) if wanted is not plan.open else None)
        action = "open" if wanted else "close"
        self._log.add(Notice("asked", f"An operator asked to {action} the stage."))

    def follow(self, plan: Plan) -> None:
        """Apply the newest plan of the schedule."""
        if self._override is not None:
            self._follow(self._override, plan)
        # While the time is unknown, the schedule says nothing new.
        if plan.open is not None and plan.appearance != self._scheduled:
            self._scheduled = plan.appearance
            self._log.keep("scheduled", plan.appearance)
            if plan.appearance:
                self._choose(plan.appearance)

    def _follow(self, override: Override, plan: Plan) -> None:
        if plan.open is None:
            self._missed = True
            return
        # Without power, or without the time, two changes that cancel each other out may have been missed.
        now_s, then_s = plan.changes_s, override.until_s
        missed = self._missed and now_s is not None and then_s is not None and now_s > then_s
        self._missed = False
        needless = override.said is None and override.wanted is plan.open
        if needless or missed or override.said not in (None, plan.open):
            self._set(None)
            self._log.add(Notice("schedule-rules", "The stage follows the schedule again."))
        elif (override.said, override.until_s) != (plan.open, plan.changes_s):
            self._set(replace(override, said=plan.open, until_s=plan.changes_s))

    def choose(self, appearance: str, plan: Plan) -> None:
        self._choose(appearance)
        what = "all appearances in turn" if appearance == IN_TURN else f"the appearance {appearance}"
        self._log.add(Notice("asked", f"An operator chose {what}."))

    def appearance(self, plan: Plan, names: Sequence[str]) -> str:
        """The chosen one if the bundle has it, else the scheduled one, else ``IN_TURN``; empty if there is none."""
        if not names:
            return ""
        return next((name for name in (self._chosen, plan.appearance) if name in (*names, IN_TURN)), IN_TURN)

    def _choose(self, appearance: str) -> None:
        self._chosen = appearance
        self._log.keep("chosen", appearance)

    def _says(self, plan: Plan) -> bool:
        return self._without_time if plan.open is None else plan.open

    def _set(self, override: Override | None) -> None:
        self._override = override
        kept = None if override is None else (override.wanted, override.said, override.until_s)
        self._log.keep("override", json.dumps(kept))


def _override_in(text: str | None) -> Override | None:
    try:
        stored: Any = json.loads(text or "null")
    except (ValueError, RecursionError):
        return None
    match stored:
        case [bool(wanted), bool() | None as said, int() | float() as until_s]:
            return Override(wanted, said, float(until_s))
        case [bool(wanted), bool() | None as said, *_] if len(stored) <= 3:
            return Override(wanted, said)
    return None


def effect(schedule: Schedule, overrides: OperatorOverrides, now: Plan, now_s: float) -> str:
    """That the hours close an open stage, in sentences; empty if they do not. ``now``: the plan in use.

    ``schedule`` must be checked. While the time is unknown (``now.open`` None), hours close nothing.
    """
    if now.open is None or not overrides.open(now):
        return ""
    if overrides.would_be_open(plan(now_s, schedule, (), since_s=now_s)):
        return ""
    zone = zone_of(schedule.time_zone)
    moment = datetime.fromtimestamp(now_s, zone)
    later = next((one.begins_s for one in openings(schedule, now_s) if one.begins_s > now_s), None)
    again = "" if later is None else f" It opens again on {datetime.fromtimestamp(later, zone):%A at %H:%M}."
    return (
        f"The stage closes at once, and its lamps cool down: it is {moment:%A, %H:%M} in {schedule.time_zone}, "
        f"outside these hours.{again}"
    )
