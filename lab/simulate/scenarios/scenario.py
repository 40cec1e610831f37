"""A scenario: the incidents of one life, drawn from the seed before it begins, so that it can be shortened."""

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


def event_name(code: str, text: str) -> str:
    """The name by which an incident waits for an event: its code, or the state that the stage comes to."""
    return text.removeprefix("The stage is ").partition(":")[0].rstrip(".") if code == "state" else code


@dataclass(frozen=True, slots=True)
class Incident:
    """One fault, command or other event from outside. Begins ``at_s`` and lasts ``duration_s`` (0: no own end).

    ``target``: a projector, a file or an operation; ``variant``: which fault of this ``kind``; ``magnitude``: its size;
    ``arguments``: of an operation. With ``after_event`` it waits from ``at_s`` on, for a day at most, until the kiosk's
    log has this event, and begins ``delay_s`` later.
    """

    at_s: float
    kind: str
    target: str = ""
    variant: str = ""
    duration_s: float = 0.0
    magnitude: float = 0.0
    arguments: str = ""
    after_event: str = ""
    delay_s: float = 0.0

    @property
    def line(self) -> str:
        """It in words."""
        words = " ".join(word for word in (self.kind, self.target, self.variant, self.arguments) if word)
        lasts = f" for {self.duration_s:.0f} s" if self.duration_s else ""
        size = f" ({self.magnitude:g})" if self.magnitude else ""
        waits = f", {self.delay_s:.1f} s after the next {self.after_event}" if self.after_event else ""
        return f"{self.at_s / DAY_S:7.3f} d  {words}{size}{lasts}{waits}"


@dataclass(frozen=True, slots=True)
class Site:
    """A kiosk's place and computer: ``begins_unix_s``, time ``zone``, opening ``rows``, ``drift_check``.

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


def to_json(site: Site, incidents: Sequence[Incident]) -> str:
    """A scenario with its site as text, one incident a line. It stays the same when sites are drawn in another way."""
    lines = ",\n".join(json.dumps(asdict(incident)) for incident in incidents)
    return f'{{"site": {json.dumps(asdict(site))},\n"incidents": [\n{lines}\n]}}\n'


def from_json(text: str) -> tuple[Site, list[Incident]]:
    """As ``to_json``. Raises ValueError, TypeError and KeyError."""
    values = json.loads(text)
    return Site(**values["site"]), [Incident(**incident) for incident in values["incidents"]]
