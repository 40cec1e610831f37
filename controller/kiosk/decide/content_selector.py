"""Which picture is wanted: the chosen appearance, in the frames that were solved for the projectors that give light."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from controller.kiosk.decide.interfaces import Request, Showing, Stock
from controller.kiosk.decide.job_queue import Agenda
from controller.kiosk.decide.operator_overrides import Wishes
from controller.kiosk.decide.planner import Plan
from controller.kiosk.store.event_log import Decision, EventLog


class Pictures:
    """For the holder of the conductor's lock."""

    def __init__(self, stock: Stock, wishes: Wishes, agenda: Agenda, log: EventLog) -> None:
        self._stock, self._wishes, self._agenda, self._log = stock, wishes, agenda, log
        self._empty = False
        self._asked_for: set[tuple[Path | None, frozenset[str]]] = set()

    def something(self, wanted: bool) -> bool:
        """Whether the stage is ``wanted`` to be open and has something to play; told once where it has not."""
        found = self._stock.bundle() is not None
        if wanted and not found and not self._empty:
            self._log.tell(_EMPTY)
        self._empty = wanted and not found
        return wanted and found

    def of(self, plan: Plan, missing: frozenset[str]) -> Showing:
        """What to show without the light of ``missing``; frames that there are not yet are asked for, once a bundle."""
        name, bundle = self._wishes.appearance(plan, self._stock.names()), self._stock.bundle()
        if not missing:
            return Showing(bundle, name)
        instead = self._stock.without(missing, name)
        if instead is not None:
            return Showing(instead, name)
        # The whole stage's frames go on meanwhile: dimmer, but there.
        request = Request("takeover", arguments=tuple(sorted(missing)))
        if (bundle, missing) not in self._asked_for and self._agenda.offer(request):
            self._asked_for.add((bundle, missing))
        return Showing(bundle, name)


_EMPTY: Final = Decision(
    "nothing-installed", "The stage should be open, and no bundle is installed.",
    "Calibrate the stage and compute appearances; the lamps stay off until then.", "error",
)  # fmt: skip
