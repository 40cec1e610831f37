"""What to show: the chosen appearance, in the frames that were solved for the projectors that give light."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Final

from controller.kiosk.decide.interfaces import BLACK, IN_TURN, Bundles, Request, Showing
from controller.kiosk.decide.job_queue import JobQueue
from controller.kiosk.decide.live_changes import LiveChangesKept
from controller.kiosk.decide.operator_overrides import OperatorOverrides
from controller.kiosk.decide.planner import Plan
from controller.kiosk.store.event_log import Decision, EventLog


class ContentSelector:
    """Call it only with the reconciler's lock held."""

    def __init__(
        self, bundles: Bundles, overrides: OperatorOverrides, live: LiveChangesKept, queue: JobQueue, log: EventLog
    ) -> None:
        self._bundles, self._overrides, self._queue, self._log = bundles, overrides, queue, log
        self._live = live
        self._empty = False
        self._asked_for: set[tuple[Path | None, frozenset[str]]] = set()

    def something(self, wanted: bool) -> bool:
        """Whether the stage is ``wanted`` open and has a bundle to play; a missing bundle is logged once."""
        installed = self._bundles.bundle() is not None
        if wanted and not installed and not self._empty:
            self._log.add(_EMPTY)
        self._empty = wanted and not installed
        return wanted and installed

    def of(self, plan: Plan, missing: frozenset[str]) -> Showing:
        """What to show without the projectors ``missing``; missing frames are requested once per bundle."""
        live = self._live.now
        if live.black:
            return replace(BLACK, fade_s=live.fade_s or 0.0)
        wanted = self._wanted(self._chosen(plan))
        wanted = replace(wanted, brightness=live.brightness)
        if live.fade_s is not None:
            wanted = replace(wanted, fade_s=live.fade_s)
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

    def _chosen(self, plan: Plan) -> str:
        names = self._bundles.names()
        held = self._live.now.held
        return held if held in names else self._overrides.appearance(plan, names)

    def after(self, plan: Plan, shown: str) -> tuple[str, bool]:
        """The appearance that follows ``shown``, and whether they are shown in turn; empty if nothing is installed."""
        names = list(self._bundles.names())
        turns = [name for name, _, _ in self._bundles.playlist()]
        in_turn = self._overrides.appearance(plan, names) == IN_TURN and len(turns) > 1 and not self._live.now.held
        order = list(dict.fromkeys(turns)) if shown in turns or in_turn else names
        if not order:
            return "", False
        return order[(order.index(shown) + 1) % len(order) if shown in order else 0], in_turn

    def _wanted(self, name: str) -> Showing:
        """``name``, or the bundle's playlist, as the whole stage shows it."""
        bundle, names, turns = self._bundles.bundle(), self._bundles.names(), tuple(self._bundles.playlist())
        if name == IN_TURN and len(turns) > 1:
            first = next((at for at, turn in enumerate(turns) if turn[0] == self._live.now.first), 0)
            turns = turns[first:] + turns[:first]
            return Showing(bundle, turns[0][0], turns, fade_s=turns[0][2])
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
