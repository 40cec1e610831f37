"""Scripts that turn the knobs of emulated devices' wires, as TOML.

seed = 7
[[event]]
do = "unplug"          # comes back after for_s, at another path
at_s = 20.0            # seconds since the device started, or
for_s = 3.0
[[event]]
do = "garbage"
probability = 0.01     # of every message that it hears; or on_message = 12, or on_byte = 1000
"""

from __future__ import annotations

import random
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final, Protocol

from hal.errors import DeviceError
from hal.runtime.files import read_text
from lab.emulated.projectors.boards import Wire
from plugins.emulated.core.tables import Between, load

_WIRE: Final[dict[str, tuple[dict[str, Any], dict[str, Any], dict[str, Any]]]] = {
    "silence": ({"silent": True}, {"silent": False}, {"drop": 1}),
    "garbage": ({"garbage": True}, {"garbage": False}, {"garble": 1}),
    "cut": ({"cut": 1_000_000_000}, {"cut": 0}, {"cut": 1}),
    "busy": ({"busy": True}, {"busy": False}, {}),
}
"""What to set at the beginning and at the end of an event, and for an event of a single answer."""
LAMP_ACTIONS: Final = ("lamp-failure", "overheat")
ONCE: Final = (*(deed for deed, (_, _, once) in _WIRE.items() if once), "slow")
"""What affects a single answer where an event does not give a duration."""
ACTIONS: Final = (*_WIRE, "slow", *LAMP_ACTIONS, "unplug")
_NEVER: Final = -1.0


@dataclass(frozen=True, slots=True)
class FaultEvent:
    """One fault. ``do`` is one of ``ACTIONS``, ``device`` the name of one of the bench's ("": each of them).

    When: ``at_s`` since the start, at the ``on_byte``-th byte or ``on_message``-th message that it hears (from 1), or
    with ``probability`` at each message. How long: ``for_s`` seconds; 0 is one answer (silence, garbage, cut, slow),
    else for good. ``delay_s``: how slow.
    """

    do: str
    device: str = ""
    at_s: Annotated[float, Between(-1.0, 1e7)] = _NEVER
    on_byte: Annotated[int, Between(0, 1e15)] = 0
    on_message: Annotated[int, Between(0, 1e12)] = 0
    probability: Annotated[float, Between(0.0, 1.0)] = 0.0
    for_s: Annotated[float, Between(0.0, 1e7)] = 0.0
    delay_s: Annotated[float, Between(0.0, 3600.0)] = 1.0


@dataclass(frozen=True, slots=True)
class Scenario:
    """A script of faults; the same ``seed`` rolls the same dice."""

    event: tuple[FaultEvent, ...]
    seed: Annotated[int, Between(0, 2**63 - 1)] = 1


class Knobs(Protocol):
    """What has the knobs of ``WireFaults``."""

    def set(self, **knobs: Any) -> None: ...


class FailingLamp(Protocol):
    """What can burst or become too hot."""

    def fail(self) -> None: ...

    def overheat(self) -> None: ...

    def repair(self) -> None: ...


class UsbPort(Protocol):
    """What can be unplugged."""

    def unplug(self) -> None: ...

    def replug(self) -> None: ...


def parse_scenario(text: str, *, file: str) -> Scenario:
    """Read a scenario. Raises DeviceError as ``tables.load``, or ``scenario-wrong`` for an event that can't happen."""
    scenario = load(text, Scenario, file=file)
    for number, event in enumerate(scenario.event, start=1):
        if event.do not in ACTIONS:
            raise _wrong(file, number, f"{event.do!r} is not one of {', '.join(ACTIONS)}")
        whens = (event.at_s >= 0.0, event.on_byte > 0, event.on_message > 0, event.probability > 0.0)
        if sum(whens) != 1:
            raise _wrong(file, number, "it needs exactly one of at_s, on_byte, on_message, probability")
    return scenario


def read_scenario(path: Path) -> Scenario:
    """Read a scenario file. Raises as ``parse_scenario``, or DeviceError("scenario-missing")."""
    try:
        return parse_scenario(read_text(path), file=str(path))
    except (OSError, UnicodeDecodeError) as error:
        raise DeviceError(
            "scenario-missing",
            what=f"The scenario {path} can't be read.",
            remedy="Correct scenario in bench.toml, or remove it.",
        ) from error


def _wrong(file: str, number: int, why: str) -> DeviceError:
    return DeviceError(
        "scenario-wrong", what=f"{file}: event {number} is wrong: {why}.", remedy="Correct that event of the scenario."
    )


class ScenarioPlayer:
    """Plays the events of one device. Its emulator calls ``tick`` often, and ``heard`` for every message.

    ``happened``: what happened, as (seconds since the start, deed).
    """

    def __init__(
        self,
        scenario: Scenario,
        *,
        device: str,
        faults: Knobs,
        lamp: FailingLamp | None = None,
        plug: UsbPort | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._events = [event for event in scenario.event if event.device in ("", device)]
        self._dice = random.Random(f"{scenario.seed} {device}")
        self._faults, self._lamp, self._plug = faults, lamp, plug
        self._clock = clock
        self._began_s = clock()
        self._bytes = self._messages = 0
        self._timed = [event for event in self._events if event.at_s >= 0.0]
        self._ends: list[tuple[float, Callable[[], None]]] = []
        self.happened: list[tuple[float, str]] = []

    def tick(self) -> None:
        """Begin and end what is due by the clock."""
        now_s = self._clock() - self._began_s
        for event in [event for event in self._timed if event.at_s <= now_s]:
            self._timed.remove(event)
            self._begin(event, now_s)
        for end in [end for end in self._ends if end[0] <= now_s]:
            self._ends.remove(end)
            end[1]()

    def heard(self, count: int) -> None:
        """A message of ``count`` bytes came in and is about to be answered."""
        first, self._bytes = self._bytes, self._bytes + count
        self._messages += 1
        now_s = self._clock() - self._began_s
        for event in self._events:
            due = first < event.on_byte <= self._bytes or self._messages == event.on_message
            if due or (event.probability and self._dice.random() < event.probability):
                self._begin(event, now_s)

    def _begin(self, event: FaultEvent, now_s: float) -> None:
        self.happened.append((now_s, event.do))
        begin, end = self._deed(event)
        begin()
        if event.for_s and end is not None:
            self._ends.append((now_s + event.for_s, end))

    def _deed(self, event: FaultEvent) -> tuple[Callable[[], None], Callable[[], None] | None]:
        """How an event begins and ends."""
        if event.do in LAMP_ACTIONS:
            if self._lamp is None:
                return (lambda: None), None
            return (self._lamp.fail if event.do == "lamp-failure" else self._lamp.overheat), self._lamp.repair
        if event.do == "unplug":
            return (self._plug.unplug, self._plug.replug) if self._plug is not None else (lambda: None, None)
        if event.do == "slow":
            return self._knobs({"slow_s" if event.for_s else "late_s": event.delay_s}), self._knobs({"slow_s": 0.0})
        lasting, over, once = _WIRE[event.do]
        return self._knobs(lasting if event.for_s or not once else once), self._knobs(over)

    def _knobs(self, knobs: dict[str, Any]) -> Callable[[], None]:
        return lambda: self._faults.set(**knobs)


def scripted(path: Path) -> Callable[[str, Wire], ScenarioPlayer]:
    """Makes the players of a scenario file, for projectors by their names. Raises as ``read_scenario``."""
    scenario = read_scenario(path)

    def player(name: str, projector: Wire) -> ScenarioPlayer:
        return ScenarioPlayer(scenario, device=name, faults=projector.faults, lamp=projector.lamp, plug=projector)

    return player
