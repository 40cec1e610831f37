"""What operators set against the schedule: open or closed for now, and the appearance."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from controller.kiosk.decide.interfaces import IN_TURN
from controller.kiosk.decide.planner import Plan
from controller.kiosk.store.event_log import Decision, EventLog


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
        """As ``open``, if this were the plan: an operator's wish ends when the schedule says something new."""
        override, says = self._override, self._says(plan)
        return override.wanted if override is not None and override.said in (None, says) else says

    def override(self, wanted: bool, plan: Plan) -> None:
        """Open or closed until the next scheduled change. Without the time: until the first one after it is known."""
        self._set(Override(wanted, plan.open, plan.changes_s) if wanted is not plan.open else None)
        action = "open" if wanted else "close"
        self._log.add(Decision("asked", f"An operator asked to {action} the stage."))

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
            self._log.add(Decision("schedule-rules", "The stage follows the schedule again."))
        elif (override.said, override.until_s) != (plan.open, plan.changes_s):
            self._set(replace(override, said=plan.open, until_s=plan.changes_s))

    def choose(self, appearance: str, plan: Plan) -> None:
        self._choose(appearance)
        what = "all appearances in turn" if appearance == IN_TURN else f"the appearance {appearance}"
        self._log.add(Decision("asked", f"An operator chose {what}."))

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
    if not isinstance(stored, list) or len(stored) not in (2, 3):
        return None
    wanted, said, until_s = (*stored, None)[:3]
    if not isinstance(wanted, bool) or not isinstance(said, bool | None):
        return None
    return Override(wanted, said, float(until_s) if isinstance(until_s, int | float) else None)
