"""Checks the invariants of lamps: how often they are struck, and that they burn only when they may."""

from __future__ import annotations

from typing import Final

from controller.kiosk.decide.interfaces import Condition
from controller.kiosk.service import Service
from controller.kiosk.state import EventRow
from lab.simulate.monitors.invariants import Violation
from lab.simulate.world import SimulatedWorld

BACK_S: Final = 15.0
MOST_STRIKES: Final = 5
STAYS_S: Final = 120.0
LOOKED_S: Final = 300.0
_SEEN: Final = (Condition.LIT, Condition.DARK, Condition.COOLING)


class LampMonitor:
    """``stays_lit``: lamps that a restart must leave lit, and since when they are."""

    def __init__(self, world: SimulatedWorld) -> None:
        self._world = world
        self._strikes_since: dict[str, int] = {}
        self._uncounted: dict[str, int] = {}
        self.stays_lit: dict[str, float | None] = {}

    def lit(self) -> dict[str, float | None]:
        """Those that give light, and since when they are lit."""
        return {name: lamp.lit_at_s for name, lamp in self._world.lamps.items() if lamp.shines}

    def forgive(self) -> None:
        """Lamps may be tried again."""
        self._strikes_since = {name: lamp.strikes for name, lamp in self._world.lamps.items()}

    def needed(self) -> None:
        """Work, or a person, needs light of a dark stage: one strike more of each lamp, and no more than that."""
        since = self._strikes_since
        self._strikes_since = {
            name: min(lamp.strikes, since.get(name, 0) + 1) for name, lamp in self._world.lamps.items()
        }

    def ledger_lost(self) -> None:
        """The counts of strikes start again."""
        self.forgive()
        self._uncounted = {
            name: line.lamp.strikes - line.lamp.doubled + line.delayed for name, line in self._world.lines.items()
        }

    # -- checks

    def check(self, service: Service, *, serving_s: float, open_surely: bool) -> None:
        """After a step, ``serving_s`` after the service's start. Raises Violation."""
        for lamp in self._world.lamps.values():
            if lamp.violations:
                raise Violation("lamp rules", lamp.violations[0])
        self._strikes(service)
        self._may_burn(service)
        self._stay_lit(due=open_surely and serving_s <= STAYS_S)

    def off(self, row: EventRow) -> None:
        """The stage says that it is off. Raises Violation."""
        for name, line in self._world.lines.items():
            # A look is some seconds old; a command that was under way may have struck it since.
            seen = self._world.scheduler.now_s - line.lamp.struck_at_s > BACK_S
            known = line.lamp.lit and not line.lamp.by_hand and not line.lamp.late
            if known and seen and row.text.startswith("The stage is off: every lamp"):
                raise Violation("off is off", f"the lamp of {name} burns")

    def _may_burn(self, service: Service) -> None:
        """Whether each lamp that burns behind a broken line counts as one that may."""
        for supervisor in service.devices.projectors:
            lamp, view = self._world.lamps[supervisor.name], supervisor.view
            dark = view.condition is Condition.LOST and view.looked and not view.maybe_lit
            # No one can know of one that somebody else switched on, or a command that was taken for lost.
            known = lamp.lit and not lamp.by_hand and not lamp.late
            if dark and known and self._world.scheduler.now_s - lamp.struck_at_s > BACK_S:
                raise Violation("may burn", f"the lamp of {supervisor.name} burns, and counts as dark")

    def _strikes(self, service: Service) -> None:
        for supervisor in service.devices.projectors:
            lamp, view = self._world.lamps[supervisor.name], supervisor.view
            # A look at it after the strike has ended.
            seen = view.condition in _SEEN and self._world.scheduler.now_s - lamp.struck_at_s > LOOKED_S
            # No one can count a strike by the second of one command, after the first one's light went out.
            commanded = lamp.strikes - lamp.doubled
            if seen and view.strikes < commanded - self._uncounted.get(lamp.name, 0):
                raise Violation("strikes counted", f"{view.strikes} instead of {commanded} for {lamp.name}")
        for name, lamp in self._world.lamps.items():
            if lamp.strikes - self._strikes_since.get(name, 0) > MOST_STRIKES and lamp.bad:
                raise Violation("few strikes", f"the lamp of {name} was struck {MOST_STRIKES + 1} times without light")
            if not lamp.bad:
                self._strikes_since[name] = lamp.strikes

    def _stay_lit(self, *, due: bool) -> None:
        if not due:
            self.stays_lit = {}
        for name, since_s in self.stays_lit.items():
            if self._world.lamps[name].lit_at_s != since_s:
                raise Violation("lit through a restart", f"the lamp of {name} went off")
