"""A life, as far as what happens to it has to know it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from controller.kiosk.service import Service
from lab.simulate.incidents.script import Item, Setting
from lab.simulate.judge.witness import Witness
from lab.simulate.scheduler import Event
from lab.simulate.world import SimulatedWorld


class Living(Protocol):
    """A life, as far as it is needed here; see ``life.Life``."""

    place: Setting
    world: SimulatedWorld
    witness: Witness
    service: Service | None
    damaged: set[str]
    unreadable: set[str]
    sound: dict[str, bytes]
    repaired_s: float
    doubtful_hours: Item | None
    news: Event

    def later(self, seconds: float, repair: Callable[[], None]) -> None: ...

    def boot(self) -> None: ...

    def end_of_program(self) -> None: ...

    def end(self, *, lit: bool) -> None: ...

    def restart(self, *, lit: bool) -> None: ...

    def command(self, item: Item) -> None: ...
