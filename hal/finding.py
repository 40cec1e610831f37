"""Finding devices: what `velatura doctor` asks of every bus, and how a bus answers. No I/O here but loading finders.

A finder looks at one bus, and changes nothing there: it lists, reads and asks; it lights no lamp and moves no relay.
Distributions name theirs under the entry-point group ``velatura.finders``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any, Final, cast

from hal.deadline import Deadline
from hal.driver_calls import Caller
from hal.errors import DeviceError

GROUP: Final = "velatura.finders"


@dataclass(frozen=True, slots=True)
class Problem:
    """Something that a person should mend: a stable ``code``, one sentence on what it is, one on what to do."""

    code: str
    what: str
    remedy: str

    @classmethod
    def of(cls, error: DeviceError) -> Problem:
        return cls(error.code, error.what, error.remedy)


@dataclass(frozen=True, slots=True)
class Found:
    """Something on a bus.

    ``address``: how a person finds it; ``what``: what it is, in a few words. ``kind`` and ``driver`` (see
    ``hal.registry``) are "" where nobody knows what would drive it; ``settings`` is then empty, else the table that
    the driver needs in stage.toml. ``identity`` is the same for the same device after it was plugged in elsewhere.
    """

    bus: str
    address: str
    what: str
    kind: str = ""
    driver: str = ""
    settings: Mapping[str, Any] = field(default_factory=dict)
    identity: str = ""
    problems: tuple[Problem, ...] = ()


@dataclass(frozen=True, slots=True)
class Known:
    """A device that stage.toml names: a finder looks there too, and need not guess what it is."""

    kind: str
    driver: str
    settings: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Wanted:
    """What to look for. ``stage``: relative paths start there; ``known``: the devices of its stage.toml.

    ``serial_ports``: the folder with stable names of serial ports; ``search``: (host, UDP port) to which the search
    for projectors goes, None: nowhere; ``listen``: (host, port) at which their answers arrive. ``answer_s``: how long
    an answer on a serial line is waited for; projectors that are well need a tenth of a second.
    """

    stage: Path
    known: tuple[Known, ...] = ()
    serial_ports: Path = Path("/dev/serial/by-id")
    system_ports: bool = True
    search: tuple[str, int] | None = ("255.255.255.255", 4352)
    listen: tuple[str, int] = ("", 4352)
    search_s: float = 10.0
    answer_s: float = 0.6

    def of(self, kind: str, driver: str) -> tuple[Mapping[str, Any], ...]:
        """The settings of every known device of this driver."""
        return tuple(one.settings for one in self.known if (one.kind, one.driver) == (kind, driver))


@dataclass(frozen=True, slots=True)
class Finder:
    """What an entry point names. ``find`` raises DeviceError where the bus itself can't be looked at, and Cancelled."""

    bus: str
    find: Callable[[Wanted, Deadline], Sequence[Found]]


def search_bus(finder: Finder, wanted: Wanted, deadline: Deadline) -> Sequence[Found]:
    """What ``finder`` finds. Raises as ``Finder.find``, and DriverFault for all else that it raises or returns."""
    caller = Caller(f"What looks for devices on {finder.bus}")
    return cast("Sequence[Found]", caller.call("find", finder.find, Sequence[Found], wanted, deadline))


def load_finders(found: Iterable[EntryPoint] | None = None) -> tuple[tuple[Finder, ...], tuple[Problem, ...]]:
    """Every finder that is installed (or of the given entry points), by bus; and what could not be loaded."""
    finders: dict[tuple[str, str], Finder] = {}
    problems = []
    for entry in sorted(entry_points(group=GROUP) if found is None else found, key=lambda one: (one.name, one.value)):
        try:
            loaded = entry.load()
        except (Exception, SystemExit) as error:  # noqa: BLE001 - a plugin may raise anything, and stops no other
            loaded = f"{type(error).__name__}: {error}"
        if isinstance(loaded, Finder):
            finders[loaded.bus, entry.value] = loaded
        else:
            problems.append(
                Problem(
                    "finder-broken",
                    what=f"What looks for devices under the name {entry.name} can't be used: {loaded}.",
                    remedy="Reinstall the distribution that it comes from.",
                )
            )
    return tuple(finders[key] for key in sorted(finders)), tuple(problems)
