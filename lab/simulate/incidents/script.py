"""What happens to a kiosk from outside in one life: drawn from the seed before it begins, so it can be shortened."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass

from lab.simulate.scheduler import DAY_S

STOPPED = "stopped"
"""As the arguments of a damaged file: the service ended as it should before; without it, it was killed."""
WRITTEN_LAST = 1.0
"""The least size of a damage to what was written last, and not anywhere in a file."""
POWER_CUT = "power cut"
"""As the arguments of a damaged bundle: with the computer's power; without it, only the player died."""

DIED = "the player died"
"""As the arguments of bundles that can't be read: a disk with errors takes programs with it."""


def moment_of(code: str, text: str) -> str:
    """What an item may wait for: the code of an event, or the state that the stage comes to."""
    return text.removeprefix("The stage is ").partition(":")[0].rstrip(".") if code == "state" else code


@dataclass(frozen=True, slots=True)
class Item:
    """One thing that happens ``at_s``; ``for_s``: how long it lasts, 0: it has no end of its own.

    ``who``: a projector, a file, an operation; ``how``: which trouble; ``number``: its size; ``arguments``: of an
    operation. With a ``moment`` it waits from ``at_s`` on, for a day at most, until the kiosk's
    log says that, and happens ``after_s`` later.
    """

    at_s: float
    what: str
    who: str = ""
    how: str = ""
    for_s: float = 0.0
    number: float = 0.0
    arguments: str = ""
    moment: str = ""
    after_s: float = 0.0

    @property
    def line(self) -> str:
        """It in words."""
        said = " ".join(word for word in (self.what, self.who, self.how, self.arguments) if word)
        lasts = f" for {self.for_s:.0f} s" if self.for_s else ""
        size = f" ({self.number:g})" if self.number else ""
        waits = f", {self.after_s:.1f} s after the next {self.moment}" if self.moment else ""
        return f"{self.at_s / DAY_S:7.3f} d  {said}{size}{lasts}{waits}"


@dataclass(frozen=True, slots=True)
class Setting:
    """Where and when a life takes place: ``begins_unix_s``, time ``zone``, opening ``rows``, ``drift_check``.

    ``bundles``: so many were published before: with the second, there is an older one to go back to. ``logged``: so
    many events are in the log of the months before. ``lingers_s``: a projector takes no new connection for so long
    after the end of a program that did not close its own. ``display_after_s``: so long after its power, the computer's
    display is there. ``is_small``: the computer's player answers late while it works. ``no_time_s``: so long after its
    power the computer has no time, because its clock has no battery.
    """

    begins_unix_s: float
    zone: str
    rows: list[dict[str, str]]
    drift_check: str
    bundles: int = 1
    logged: int = 0
    lingers_s: float = 0.0
    display_after_s: float = 0.0
    is_small: bool = False
    no_time_s: float = 0.0


def to_json(place: Setting, items: Sequence[Item]) -> str:
    """A script with its setting as text, one item a line: it stays the same when settings are drawn in another way."""
    lines = ",\n".join(json.dumps(asdict(item)) for item in items)
    return f'{{"setting": {json.dumps(asdict(place))},\n"items": [\n{lines}\n]}}\n'


def from_json(text: str) -> tuple[Setting, list[Item]]:
    """As ``to_json``. Raises ValueError, TypeError and KeyError."""
    values = json.loads(text)
    return Setting(**values["setting"]), [Item(**item) for item in values["items"]]
