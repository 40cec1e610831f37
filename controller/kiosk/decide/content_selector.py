"""What to show: the chosen appearance, in the frames that were solved for the projectors that give light."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from controller.kiosk.decide.interfaces import Bundles, Request, Showing
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
        name, bundle = self._overrides.appearance(plan, self._bundles.names()), self._bundles.bundle()
        if not missing:
            return Showing(bundle, name)
        failover = self._bundles.without(missing, name)
        if failover is not None:
            return Showing(failover, name)
        # Until then the frames of the whole stage stay: dimmer than they should be, but visible.
        request = Request("takeover", arguments=tuple(sorted(missing)))
        if (bundle, missing) not in self._asked_for and self._queue.offer(request):
            self._asked_for.add((bundle, missing))
        return Showing(bundle, name)


_EMPTY: Final = Decision(
    "nothing-installed", "The stage should be open, but no bundle is installed.",
    "Calibrate the stage and compute appearances. The lamps stay off until then.", "error",
)  # fmt: skip
