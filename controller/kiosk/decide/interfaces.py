"""What the reconciler needs of the rest of the kiosk, and the values that they exchange."""

from __future__ import annotations

import enum
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, Protocol

from controller.kiosk.values import Turn
from hal.notices import Notice
from hal.values import Power

DISK_FULL: Final = "disk-full"
"""The code of the one problem that several devices may have because nothing can be written."""


NOT_YET: Final = "camera-not-yet"
"""The code of the refusal of work while it is unknown whether the camera is there: the kiosk has just started."""


class Condition(enum.Enum):
    """The state of a projector, as far as its control line shows it."""

    DARK = "dark"
    COOLING = "cooling"
    LIGHTING = "lighting"
    LIT = "lit"
    LOST = "lost"
    BROKEN = "broken"


@dataclass(frozen=True, slots=True)
class ProjectorView:
    """A projector as its supervisor saw it last. ``maybe_lit``: seen lit, or switched on, and not seen off since."""

    name: str
    condition: Condition = Condition.LOST
    power: Power = Power.UNKNOWN
    stable_left_s: float = float("inf")
    maybe_lit: bool = False
    hours: float = 0.0
    strikes: int = 0
    counter_hours: int | None = None
    looked: bool = False
    problem: Notice | None = None

    @property
    def shines(self) -> bool:
        """Lit, or lit at its last answer: a silent cable switches no lamp off."""
        return self.condition is Condition.LIT or (self.condition is Condition.LOST and self.maybe_lit)

    @property
    def coming(self) -> bool:
        """It may give light after a while."""
        return not self.looked or self.condition in (Condition.DARK, Condition.COOLING, Condition.LIGHTING)


class ProjectorPort(Protocol):
    """Brings one projector into the wanted state; see ``ProjectorSupervisor``."""

    name: str
    want_lit: bool | None

    @property
    def view(self) -> ProjectorView: ...


@dataclass(frozen=True, slots=True)
class Showing:
    """What the player is to show: an appearance of a bundle. ``appearance`` empty: black.

    ``in_turn``: what is shown in turn without end; ``appearance`` is the first of them then. ``fade_s``: for how long
    a single one, or black, comes in. ``brightness``: the share of the light that is shown, 0..1.
    """

    bundle: Path | None
    appearance: str = ""
    in_turn: tuple[Turn, ...] = ()
    fade_s: float = field(default=0.0, compare=False)
    brightness: float = 1.0


BLACK: Final = Showing(None)


@dataclass(frozen=True, slots=True)
class PlayerView:
    """``shown``: what the player showed at its last answer; ``problem``: why it does not show what it should.

    ``outputs``: that some of them get no picture, which is also part of ``problem``;
    ``warning``: what people must know although it plays, for example that its bundle is not signed.
    """

    shown: Showing | None = None
    problem: Notice | None = None
    restarts: int = 0
    warning: Notice | None = None
    outputs: Notice | None = None


class PlayerPort(Protocol):
    """Makes the player show ``want``; None: something else uses the display."""

    want: Showing | None

    @property
    def view(self) -> PlayerView: ...


class Bundles(Protocol):
    """The bundles of the stage."""

    def bundle(self) -> Path | None:
        """The installed bundle, or None."""

    def names(self) -> Sequence[str]:
        """The appearances of the installed bundle."""

    def playlist(self) -> Sequence[Turn]:
        """What the installed bundle suggests to show in turn; may be empty."""

    def without(self, missing: Collection[str], appearance: str) -> Path | None:
        """The bundle solved without these projectors from the same calibration, or None.

        It contains ``appearance``, and not always all others of the installed bundle.
        """


@dataclass(frozen=True, slots=True)
class Request:
    """A job to run: ``kind`` is "drift", "quick", "projector", "full", "compare", "publish", "takeover" or another
    one of the caller.

    ``light``: it needs all lamps lit and the display for itself; ``key``: the planner's task that it does;
    ``arguments`` depend on the kind; ``number``: the number reserved for its job, 0 for none
    """

    kind: str
    light: bool = False
    key: str = ""
    arguments: tuple[str, ...] = ()
    number: int = field(default=0, compare=False)


@dataclass(frozen=True, slots=True)
class Finished:
    """The result of a request. ``then``: the requests that follow from it."""

    request: Request
    outcome: Notice
    failed: bool = False
    then: tuple[Request, ...] = ()


TITLES: Final[Mapping[str, str]] = {
    "aim": "Test shots",
    "drift": "Drift check",
    "quick": "Quick recalibration",
    "projector": "Recalibration of projector",
    "full": "Full recalibration",
    "compare": "Photographing",
    "publish": "Publishing appearances",
    "compute": "New appearance",
    "report": "Report of",
    "takeover": "Frames without projector",
    "variants": "Frames for the loss of a projector",
}
BACKGROUND: Final = ("takeover", "variants", "report")
"""Kinds for which no one waits: they make way for what people ask, and are done afterwards."""


def title_of(request: Request) -> str:
    """The job's name in the panel and the log."""
    return " ".join((TITLES.get(request.kind, request.kind), *request.arguments))


class Jobs(Protocol):
    """Runs one request at a time."""

    def refusal(self, request: Request) -> Notice | None:
        """Why it can't run now (no camera, no calibration), or None. From memory."""

    def begin(self, request: Request) -> None: ...

    @property
    def running(self) -> Request | None: ...

    def finished(self) -> Finished | None:
        """The request that ended since the last call."""

    def cancel(self) -> None: ...
