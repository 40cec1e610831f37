"""Finding devices: the interface between `velatura doctor` and the finders of each bus. No I/O except loading finders.

A finder searches one bus without changing anything: it lights no lamp and moves no relay.
Distributions list theirs under the entry-point group ``velatura.finders``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any, Final, cast

from hal.deadline import Deadline
from hal.driver_calls import Caller
from hal.notices import Notice

GROUP: Final = "velatura.finders"


@dataclass(frozen=True, slots=True)
class Found:
    """A device on a bus.

    ``address``: its place, for people; ``what``: a short description. ``kind`` and ``driver`` (see
    ``hal.registry``) are "" if the driver is unknown; ``settings`` is then empty, else the driver's table for
    stage.toml. ``identity`` stays the same after the device was plugged in elsewhere.
    """

    bus: str
    address: str
    what: str
    kind: str = ""
    driver: str = ""
    settings: Mapping[str, Any] = field(default_factory=dict)
    identity: str = ""
    problems: tuple[Notice, ...] = ()


@dataclass(frozen=True, slots=True)
class Known:
    """A device of stage.toml: a finder also searches at its address, and knows its kind."""

    kind: str
    driver: str
    settings: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class SearchScope:
    """Where to search. ``stage``: relative paths start there; ``known``: the devices of its stage.toml.

    ``serial_ports``: the folder with stable names of serial ports; ``search``: (host, UDP port) of the search
    for projectors, None (the default): nothing is sent to a network; ``listen``: (host, port) for their answers.
    ``answer_s``: time limit for an answer on a serial line; healthy projectors need a tenth of a second.
    """

    stage: Path
    known: tuple[Known, ...] = ()
    serial_ports: Path = Path("/dev/serial/by-id")
    system_ports: bool = True
    search: tuple[str, int] | None = None
    listen: tuple[str, int] = ("", 4352)
    search_s: float = 10.0
    answer_s: float = 0.6

    def of(self, kind: str, driver: str) -> tuple[Mapping[str, Any], ...]:
        """The settings of every known device of this driver."""
        return tuple(device.settings for device in self.known if (device.kind, device.driver) == (kind, driver))


@dataclass(frozen=True, slots=True)
class Finder:
    """The object of an entry point. ``find`` raises DeviceError if the bus itself can't be searched, and Cancelled."""

    bus: str
    find: Callable[[SearchScope, Deadline], Sequence[Found]]


def search_bus(finder: Finder, wanted: SearchScope, deadline: Deadline) -> Sequence[Found]:
    """The devices of ``finder``. Raises as ``Finder.find``, and DriverFault for other errors or wrong results."""
    caller = Caller(f"The finder for {finder.bus}")
    return cast("Sequence[Found]", caller.call("find", finder.find, Sequence[Found], wanted, deadline))


def load_finders(found: Iterable[EntryPoint] | None = None) -> tuple[tuple[Finder, ...], tuple[Notice, ...]]:
    """Every installed finder (or those of the given entry points), by bus; and the problems of loading."""
    finders: dict[tuple[str, str], Finder] = {}
    problems = []
    for entry in sorted(
        entry_points(group=GROUP) if found is None else found, key=lambda entry: (entry.name, entry.value)
    ):
        try:
            loaded = entry.load()
        except (Exception, SystemExit) as error:  # noqa: BLE001 - a plugin may raise anything, and stops no other
            loaded = f"{type(error).__name__}: {error}"
        if isinstance(loaded, Finder):
            finders[loaded.bus, entry.value] = loaded
        else:
            problems.append(
                Notice.warning(
                    "finder-broken",
                    what=f"The finder {entry.name} can't be used: {loaded}.",
                    remedy="Reinstall its Python package.",
                )
            )
    return tuple(finders[key] for key in sorted(finders)), tuple(problems)
