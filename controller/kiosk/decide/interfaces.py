"""What the conductor asks of the rest of the kiosk, and the values that pass between them."""

from __future__ import annotations

import enum
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, Protocol

from controller.kiosk.store.event_log import Decision
from hal.values import Power


class Condition(enum.Enum):
    """How a projector does, as far as its control line tells."""

    DARK = "dark"
    COOLING = "cooling"
    LIGHTING = "lighting"
    LIT = "lit"
    LOST = "lost"
    BROKEN = "broken"


@dataclass(frozen=True, slots=True)
class ProjectorView:
    """A projector as its keeper saw it last. ``maybe_lit``: was seen lit, or struck, and not seen off since."""

    name: str
    condition: Condition = Condition.LOST
    power: Power = Power.UNKNOWN
    stable_left_s: float = float("inf")
    maybe_lit: bool = False
    hours: float = 0.0
    strikes: int = 0
    counter_hours: int | None = None
    looked: bool = False
    problem: Decision | None = None

    @property
    def shines(self) -> bool:
        """Lit, or lit when its control line was last heard: a silent cable puts no lamp out."""
        return self.condition is Condition.LIT or (self.condition is Condition.LOST and self.maybe_lit)

    @property
    def coming(self) -> bool:
        """Waiting may bring its light."""
        return not self.looked or self.condition in (Condition.DARK, Condition.COOLING, Condition.LIGHTING)


class Keeper(Protocol):
    """Keeps one projector as it is wanted; see ``ProjectorKeeper``."""

    name: str
    want_lit: bool | None

    @property
    def view(self) -> ProjectorView: ...


@dataclass(frozen=True, slots=True)
class Showing:
    """What the player is to show: an appearance of a bundle. ``appearance`` empty: black."""

    bundle: Path | None
    appearance: str = ""


BLACK: Final = Showing(None)


@dataclass(frozen=True, slots=True)
class PlayerView:
    """``shown``: what the player showed when it was last asked; ``problem`` why it does not show what it should.

    ``warning``: what people must know although it plays: nobody signed its bundle.
    """

    shown: Showing | None = None
    problem: Decision | None = None
    restarts: int = 0
    warning: Decision | None = None


class PlayerPort(Protocol):
    """Keeps the player as it is wanted; ``want`` None: somebody else is using the display."""

    want: Showing | None

    @property
    def view(self) -> PlayerView: ...


class Stock(Protocol):
    """The bundles of the stage."""

    def bundle(self) -> Path | None:
        """The installed bundle, or None."""

    def names(self) -> Sequence[str]:
        """The appearances of the installed bundle."""

    def without(self, missing: Collection[str], appearance: str) -> Path | None:
        """The bundle that was solved for the stage without these projectors from the same calibration, or None.

        It holds ``appearance``; it need not hold all others of the installed bundle.
        """


@dataclass(frozen=True, slots=True)
class Request:
    """Work to be done: ``kind`` is "drift", "quick", "projector", "full", "compare", "publish", "takeover" or what
    a caller adds.

    ``light``: with all lamps lit and the display to itself; ``key``: the planner's task that this does;
    ``arguments`` are the kind's own; ``number``: the one that its job was promised, 0 for none
    """

    kind: str
    light: bool = False
    key: str = ""
    arguments: tuple[str, ...] = ()
    number: int = field(default=0, compare=False)


@dataclass(frozen=True, slots=True)
class Finished:
    """What came of a request. ``then``: what is to be done next because of it."""

    request: Request
    outcome: Decision
    failed: bool = False
    then: tuple[Request, ...] = ()


class Works(Protocol):
    """Does one request at a time."""

    def refusal(self, request: Request) -> Decision | None:
        """Why it can't be done now (no camera, nothing calibrated), or None. From memory."""

    def begin(self, request: Request) -> None: ...

    @property
    def running(self) -> Request | None: ...

    def finished(self) -> Finished | None:
        """The request that ended since the last call."""

    def cancel(self) -> None: ...
