"""Finding drivers: everything that a distribution lists under the entry-point group ``velatura.devices``."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any

from hal.deadline import Deadline
from hal.errors import PluginError

GROUP = "velatura.devices"
BENCH = "-bench"
"""How the names of entry points end that offer a bench."""
KINDS = ("projector", "camera", "display", "power_switch", "light_sensor", "button_panel", "bench")


@dataclass(frozen=True, slots=True)
class OpenContext:
    """What a driver may know of the stage: its folder (relative paths in settings start there), and where to log.

    ``transcripts``: folder for byte transcripts, or None to keep none. ``runtime``: short private folder for sockets.
    """

    stage: Path
    transcripts: Path | None = None
    runtime: Path | None = None


@dataclass(frozen=True, slots=True)
class Driver:
    """What an entry point names.

    ``open`` gets the device's table of stage.toml (without ``name`` and ``driver``), and returns an opened device of
    ``kind`` (see ``hal.interfaces``; for ``"bench"`` it is called with no settings and returns a ``Bench``).
    ``settings`` explains each key that ``open`` understands; keys in ``required`` must be there. ``check`` raises
    PluginError for values that ``open`` would refuse whatever is plugged in; it reads files at most, and no device.
    """

    kind: str
    name: str
    summary: str
    open: Callable[[Mapping[str, Any], OpenContext, Deadline], Any]
    settings: Mapping[str, str] = field(default_factory=dict)
    required: tuple[str, ...] = ()
    check: Callable[[Mapping[str, Any], OpenContext], None] | None = None


@dataclass(frozen=True, slots=True)
class BrokenPlugin:
    """An entry point that could not be used: its name and value, its distribution, and why."""

    entry_point: str
    distribution: str
    reason: str


@dataclass(frozen=True, slots=True)
class Drivers:
    """Every driver found, and every plugin that failed. Made by ``load_drivers``."""

    list: tuple[Driver, ...]
    broken: tuple[BrokenPlugin, ...] = ()

    def get(self, kind: str, name: str) -> Driver:
        """The driver ``name`` of ``kind``; PluginError("driver-unknown") says which there are."""
        for driver in self.list:
            if (driver.kind, driver.name) == (kind, name):
                return driver
        names = sorted(driver.name for driver in self.list if driver.kind == kind)
        broken = f" These plugins could not be loaded: {self._broken_sentence()}." if self.broken else ""
        raise PluginError(
            "driver-unknown",
            what=f"There is no {kind.replace('_', ' ')} driver {name!r}.{broken}",
            remedy=f"Use one of these: {', '.join(names)}." if names else f"Install a plugin that has a {kind} driver.",
        )

    def _broken_sentence(self) -> str:
        return "; ".join(f"{plugin.entry_point} of {plugin.distribution} ({plugin.reason})" for plugin in self.broken)


def load_drivers(found: Iterable[EntryPoint] | None = None, *, benches: bool = True) -> Drivers:
    """Load every entry point of the group ``velatura.devices`` (or the given ones).

    ``benches`` False: not those whose name ends in ``-bench``. A bench is asked for by name and never stands in
    stage.toml, and its optics take longer to load than everything that a stage needs.

    A plugin that cannot be imported, or is not a ``Driver``, is reported in ``broken`` and stops no other.
    Raises PluginError("driver-twice") when two plugins claim one kind and name: neither may win by chance.
    """
    drivers: dict[tuple[str, str], tuple[Driver, str]] = {}
    broken: list[BrokenPlugin] = []
    for entry in _distinct(entry_points(group=GROUP) if found is None else found):
        if not benches and entry.name.endswith(BENCH):
            continue
        where = f"{entry.name} = {entry.value}"
        owner = entry.dist.name if entry.dist is not None else "an unnamed distribution"
        loaded = _load(entry)
        if isinstance(loaded, str):
            broken.append(BrokenPlugin(where, owner, loaded))
            continue
        key = (loaded.kind, loaded.name)
        if key in drivers:
            raise PluginError(
                "driver-twice",
                what=f"The {loaded.kind} driver {loaded.name!r} comes from two plugins: {drivers[key][1]} and {owner}"
                f" ({where}).",
                remedy="Uninstall one of the two.",
            )
        drivers[key] = (loaded, f"{owner} ({where})")
    ordered = sorted(drivers)
    return Drivers(tuple(drivers[key][0] for key in ordered), tuple(broken))


def _distinct(found: Iterable[EntryPoint]) -> Iterable[EntryPoint]:
    """An installed and a source copy of one distribution list the same entry points: that is one plugin, not two."""
    seen: dict[tuple[str, str, str], EntryPoint] = {}
    for entry in found:
        owner = entry.dist.name.replace("_", "-").lower() if entry.dist is not None else ""
        seen.setdefault((owner, entry.name, entry.value), entry)
    return sorted(seen.values(), key=lambda entry: (entry.name, entry.value))


def _load(entry: EntryPoint) -> Driver | str:
    """The driver, or the reason why there is none."""
    try:
        driver = entry.load()
    except (Exception, SystemExit) as error:  # noqa: BLE001 - a plugin may raise anything, and must not stop the others
        return f"{type(error).__name__}: {error}"
    if not isinstance(driver, Driver):
        return f"it names a {type(driver).__name__}, not a hal.registry.Driver"
    if driver.kind not in KINDS:
        return f"its kind {driver.kind!r} is not one of {', '.join(KINDS)}"
    unexplained = [key for key in driver.required if key not in driver.settings]
    if unexplained:
        return f"it requires {', '.join(unexplained)} without explaining it in settings"
    return driver


def check_settings(driver: Driver, settings: Mapping[str, Any]) -> None:
    """Check the keys of a device's table against what its driver understands.

    Raises PluginError("setting-unknown") or PluginError("setting-missing"), naming the key and what is allowed. Values
    are checked by the driver when it opens.
    """
    for key in settings:
        if key not in driver.settings:
            near = difflib.get_close_matches(key, driver.settings, n=1)
            hint = f" Did you mean {near[0]!r}?" if near else ""
            raise PluginError(
                "setting-unknown",
                what=f"The {driver.kind} driver {driver.name!r} has no setting {key!r}.{hint}",
                remedy=f"It understands: {_explained(driver)}.",
            )
    for key in driver.required:
        if key not in settings:
            raise PluginError(
                "setting-missing",
                what=f"The {driver.kind} driver {driver.name!r} needs the setting {key!r}.",
                remedy=f"Add it: {key} ({driver.settings[key]}).",
            )


def open_device(driver: Driver, settings: Mapping[str, Any], context: OpenContext, deadline: Deadline) -> Any:
    """Check ``settings``, then open the device."""
    check_settings(driver, settings)
    return driver.open(settings, context, deadline)


def setting(settings: Mapping[str, Any], key: str, kind: type | tuple[type, ...], default: Any = None) -> Any:
    """The value of ``key``, or ``default``; PluginError("setting-wrong") if it is not of ``kind``."""
    value = settings.get(key, default)
    if key in settings and (not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool)):
        kinds = kind if isinstance(kind, tuple) else (kind,)
        raise PluginError(
            "setting-wrong",
            what=f"The setting {key!r} is {value!r}, which is not {' or '.join(k.__name__ for k in kinds)}.",
            remedy=f"Correct {key} in stage.toml.",
        )
    return value


def _explained(driver: Driver) -> str:
    return ", ".join(f"{key} ({text})" for key, text in driver.settings.items()) or "no settings at all"
