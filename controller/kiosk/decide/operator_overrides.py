"""What people want of a stage beside its schedule: open or closed for now, and which appearance."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from controller.kiosk.decide.planner import Plan
from controller.kiosk.store.event_log import Decision, EventLog


@dataclass(frozen=True, slots=True)
class Override:
    """Somebody ``wanted`` the stage open (or closed) while the schedule ``said`` otherwise.

    ``until_s``: when the schedule's opinion changes the next time, as it stood last; None where that was not in sight.
    """

    wanted: bool
    said: bool
    until_s: float | None = None


class Wishes:
    """Kept in the event log's file, so that a restart forgets none. ``without_time``: open while nobody knows it."""

    def __init__(self, log: EventLog, *, without_time: bool) -> None:
        self._log = log
        self._without_time = without_time
        self._override = _override_in(log.value("override"))
        self._restored = self._override is not None
        self._chosen = log.value("chosen") or ""
        self._scheduled = log.value("scheduled") or ""

    def open(self, plan: Plan) -> bool:
        return self._override.wanted if self._override is not None else self._says(plan)

    def override(self, wanted: bool, plan: Plan) -> None:
        """Open or closed until the schedule's own opinion changes the next time."""
        self._set(Override(wanted, self._says(plan), plan.changes_s) if wanted is not self._says(plan) else None)
        word = "open" if wanted else "closed"
        self._log.tell(Decision("asked", f"Somebody asked for the stage to be {word}."))

    def follow(self, plan: Plan) -> None:
        """The schedule's opinion has been worked out anew."""
        if self._override is not None:
            self._follow(self._override, plan)
        # A clock that is lost for a while is no new opinion.
        if plan.open is not None and plan.appearance != self._scheduled:
            self._scheduled = plan.appearance
            self._log.keep("scheduled", plan.appearance)
            if plan.appearance:
                self._choose(plan.appearance)

    def _follow(self, override: Override, plan: Plan) -> None:
        # A stage that stood without power while its hours began and ended, or ended and began, did not see that.
        now_s, then_s = plan.changes_s, override.until_s
        slept = self._restored and now_s is not None and then_s is not None and now_s > then_s
        if override.said is not self._says(plan) or slept:
            self._set(None)
            self._log.tell(Decision("schedule-rules", "The schedule decides again."))
        elif plan.open is not None:
            self._restored = False
            if plan.changes_s != override.until_s:
                self._set(replace(override, until_s=plan.changes_s))

    def choose(self, appearance: str, plan: Plan) -> None:
        self._choose(appearance)
        self._log.tell(Decision("asked", f"Somebody asked for the appearance {appearance}."))

    def appearance(self, plan: Plan, names: Sequence[str]) -> str:
        """The chosen one if the bundle has it, else its first; empty where it has none."""
        if self._chosen in names:
            return self._chosen
        return plan.appearance if plan.appearance in names else names[0] if names else ""

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
        found: Any = json.loads(text or "null")
    except (ValueError, RecursionError):
        return None
    if not isinstance(found, list) or len(found) not in (2, 3):
        return None
    wanted, said, until_s = (*found, None)[:3]
    if not isinstance(wanted, bool) or not isinstance(said, bool):
        return None
    return Override(wanted, said, float(until_s) if isinstance(until_s, int | float) else None)
