"""What to show: the chosen appearance, in the frames that were solved for the projectors that give light."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Final

from controller.kiosk.decide.interfaces import IN_TURN, Bundles, Request, Showing
from controller.kiosk.decide.job_queue import JobQueue
from controller.kiosk.decide.operator_overrides import OperatorOverrides
from controller.kiosk.decide.planner import Plan
from controller.kiosk.store.event_log import Decision, EventLog


class ContentSelector:
    """Call it only with the reconciler's lock held."""

    def __init__(self, bundles: Bundles, overrides: OperatorOverrides, queue: JobQueue, log: EventLog) -> None:
        self._bundles, self._overrides, self._queue, self._log = bundles, overrides, queue, log
        self._empty = False
        self._asked_for: set[tuple[Path | None, frozenset[str]]] = set()

    def something(self, wanted: bool) -> bool:
        """Whether the stage is ``wanted`` open and has a bundle to play; a missing bundle is logged once."""
        installed = self._bundles.bundle() is not None
        if wanted and not installed and not self._empty:
            self._log.tell(_EMPTY)
        self._empty = wanted and not installed
        return wanted and installed

    def of(self, plan: Plan, missing: frozenset[str]) -> Showing:
        """What to show without the projectors ``missing``; missing frames are requested once per bundle."""
        wanted = self._wanted(self._overrides.appearance(plan, self._bundles.names()))
        if not missing:
            return wanted
        failover = self._without(wanted, missing)
        if failover is not None:
            return replace(wanted, bundle=failover)
        # Until then the frames of the whole stage stay: dimmer than they should be, but visible.
        request = Request("takeover", arguments=tuple(sorted(missing)))
        if (wanted.bundle, missing) not in self._asked_for and self._queue.offer(request):
            self._asked_for.add((wanted.bundle, missing))
        return wanted

    def _wanted(self, name: str) -> Showing:
        """``name``, or the bundle's playlist, as the whole stage shows it."""
        bundle, names, turns = self._bundles.bundle(), self._bundles.names(), tuple(self._bundles.playlist())
        if name == IN_TURN and len(turns) > 1:
            return Showing(bundle, turns[0][0], turns)
        if name == IN_TURN:
            name = turns[0][0] if turns else names[0] if names else ""
        return Showing(bundle, name, fade_s=next((fade_s for other, _, fade_s in turns if other == name), 0.0))

    def _without(self, wanted: Showing, missing: frozenset[str]) -> Path | None:
        """The bundle for the other projectors, if it has all that is wanted."""
        names = dict.fromkeys([wanted.appearance, *(name for name, _, _ in wanted.in_turn)])
        found = {self._bundles.without(missing, name) for name in names}
        return found.pop() if len(found) == 1 else None


_EMPTY: Final = Decision(
    "nothing-installed", "The stage should be open, but no bundle is installed.",
    "Calibrate the stage and compute appearances. The lamps stay off until then.", "error",
)  # fmt: skip
