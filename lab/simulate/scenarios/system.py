"""The system under test: a life, as far as incidents have to know it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from controller.kiosk.service import Service
from lab.simulate.monitors.monitor import KioskMonitor
from lab.simulate.scenarios.scenario import Incident, Site
from lab.simulate.scheduler import Event
from lab.simulate.world import SimulatedWorld


class SystemUnderTest(Protocol):
    """What incidents need of ``life.Life``."""

    site: Site
    world: SimulatedWorld
    monitor: KioskMonitor
    service: Service | None
    damaged: set[str]
    unreadable: set[str]
    originals: dict[str, bytes]
    repaired_s: float
    doubtful_hours: Incident | None
    news: Event

    def later(self, seconds: float, repair: Callable[[], None]) -> None: ...

    def boot(self) -> None: ...

    def end_of_program(self) -> None: ...

    def end(self, *, lit: bool) -> None: ...

    def restart(self, *, lit: bool) -> None: ...

    def command(self, incident: Incident) -> None: ...
