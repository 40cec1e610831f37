"""What people want of a stage beside its schedule: open or closed for now, and which appearance."""

from __future__ import annotations

import json
from collections.abc import Sequence

from controller.serve.eventlog import Decision, EventLog
from controller.serve.planner import Plan


class Wishes:
    """Kept in the event log's file, so that a restart forgets none. ``without_time``: open while nobody knows it."""

    def __init__(self, log: EventLog, *, without_time: bool) -> None:
        self._log = log
        self._without_time = without_time
        self._override: tuple[bool, bool] | None = _pair(log.value("override"))
        self._chosen = log.value("chosen") or ""
        self._scheduled = log.value("scheduled") or ""

    def open(self, plan: Plan) -> bool:
        return self._override[0] if self._override is not None else self._says(plan)

    def override(self, wanted: bool, plan: Plan) -> None:
        """Open or closed until the schedule's own opinion changes the next time."""
        self._set((wanted, self._says(plan)) if wanted is not self._says(plan) else None)
        word = "open" if wanted else "closed"
        self._log.tell(Decision("asked", f"Somebody asked for the stage to be {word}."))

    def follow(self, plan: Plan) -> None:
        """The schedule's opinion has been worked out anew."""
        if self._override is not None and self._override[1] is not self._says(plan):
            self._set(None)
            self._log.tell(Decision("schedule-rules", "The schedule decides again."))
        if plan.appearance != self._scheduled:
            self._scheduled = plan.appearance
            self._log.keep("scheduled", plan.appearance)
            if plan.appearance:
                self._choose(plan.appearance)

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

    def _set(self, override: tuple[bool, bool] | None) -> None:
        self._override = override
        self._log.keep("override", json.dumps(override))


def _pair(text: str | None) -> tuple[bool, bool] | None:
    try:
        wanted, said = json.loads(text or "null") or (None, None)
    except (ValueError, TypeError):
        return None
    return (wanted, said) if isinstance(wanted, bool) and isinstance(said, bool) else None
