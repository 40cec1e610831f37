"""Finds drivers in the entry-point group ``velatura.devices``."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any, Final

from hal.deadline import Deadline
from hal.driver_calls import Caller, closed_quietly, mismatch
from hal.errors import PluginError
from hal.escapes import toml_value
from hal.secret_words import HIDDEN, is_secret
from hal.tape import Tape, Transcript

GROUP = "velatura.devices"
BENCH = "-bench"
"""Suffix of the entry points of a bench."""
KINDS = ("projector", "camera", "display", "power_switch", "douser", "light_sensor", "button_panel", "bench")


_KIND_WORDS: Final[Mapping[type, str]] = {
    str: "text in quotes", int: "a whole number", float: "a number", bool: "true or false", list: "a list",
    dict: "a table",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class OpenContext:
    """The stage's folders for a driver: relative paths in settings start at the stage's folder.

    ``runtime``: short private folder for sockets. ``tape``: records the traffic of all devices. ``checked``: whether
    calls of drivers are checked, on threads of their own (``hal.driver_calls``).
    """

    stage: Path
    runtime: Path | None = None
    tape: Tape | None = None
    checked: bool = True

    def transcript(self, kind: str, address: str, *, secret: str = "") -> Transcript | None:
        """Where a driver records its bytes; None to record none.

        ``kind``: "serial", "tcp", "pjlink", "ptp" or "hid"; ``secret``: a password, which is not recorded.
        """
        if self.tape is None:
            return None
        return self.tape.track(kind, address, secrets=(secret.encode(),) if secret else ())


@dataclass(frozen=True, slots=True)
class Driver:
    """The object of an entry point.

    ``open`` gets the device's table of stage.toml (without ``name`` and ``driver``), and returns an opened device of
    ``kind`` (see ``hal.interfaces``; for ``"bench"`` it is called with no settings and returns a ``Bench``).
    ``settings`` explains each key of ``open``; keys in ``required`` must be given. ``check`` raises
    PluginError for values that ``open`` would always refuse; it may read files, but uses no device.
    """

    kind: str
    name: str
    summary: str
    open: Callable[[Mapping[str, Any], OpenContext, Deadline], Any]
    settings: Mapping[str, str] = field(default_factory=dict)
    required: tuple[str, ...] = ()
    check: Callable[[Mapping[str, Any], OpenContext], object] | None = None


@dataclass(frozen=True, slots=True)
class BrokenPlugin:
    """An entry point that can't be used: its name and value, its distribution, the reason, and the remedy.

    ``claims``: the kind and name of two plugins, of which neither is used; None for another reason.
    ``missing``: the missing Python module, if that is the reason.
    """

    entry_point: str
    distribution: str
    reason: str
    remedy: str = "Reinstall its Python package."
    claims: tuple[str, str] | None = None
    missing: str = ""


@dataclass(frozen=True, slots=True)
class Drivers:
    """All drivers, and all plugins that failed. Created by ``load_drivers``."""

    list: tuple[Driver, ...]
    broken: tuple[BrokenPlugin, ...] = ()

    def get(self, kind: str, name: str) -> Driver:
        """The driver ``name`` of ``kind``.

        Raises PluginError("driver-unknown"), which lists the available ones, and PluginError("driver-twice") if two
        plugins have this kind and name: the choice must not be random.
        """
        for driver in self.list:
            if (driver.kind, driver.name) == (kind, name):
                return driver
        if claimed := [plugin for plugin in self.broken if plugin.claims == (kind, name)]:
            raise PluginError(
                "driver-twice",
                what=f"The {kind.replace('_', ' ')} driver {name!r} comes from more than one plugin: "
                f"{', '.join(f'{plugin.distribution} ({plugin.entry_point})' for plugin in claimed)}.",
                remedy=claimed[0].remedy,
            )
        names = sorted(driver.name for driver in self.list if driver.kind == kind)
        broken = f" These plugins could not be loaded: {self._broken_sentence()}." if self.broken else ""
        raise PluginError(
            "driver-unknown",
            what=f"There is no {kind.replace('_', ' ')} driver {name!r}.{broken}",
            remedy=f"Use one of these: {', '.join(names)}." if names else f"Install a plugin that has a {kind} driver.",
        )

    def missing_for(self, name: str) -> str:
        """The missing Python module that the driver ``name`` needs; "" if there is none."""
        return next((plugin.missing for plugin in self.broken if plugin.entry_point.startswith(name)), "")

    def _broken_sentence(self) -> str:
        return "; ".join(f"{plugin.entry_point} of {plugin.distribution} ({plugin.reason})" for plugin in self.broken)


def load_drivers(found: Iterable[EntryPoint] | None = None, *, benches: bool = True) -> Drivers:
    """Load every entry point of the group ``velatura.devices`` (or the given ones).

    ``benches`` False: not those whose name ends in ``-bench``. A bench is loaded by name, is never in
    stage.toml, and its optics take longer to load than everything else.

    A plugin that can't be imported, or is not a ``Driver``, is reported in ``broken``; so are all
    plugins with the same kind and name. Other plugins are still loaded.
    """
    claims: dict[tuple[str, str], list[tuple[Driver, BrokenPlugin]]] = {}
    broken: list[BrokenPlugin] = []
    for entry in _distinct(entry_points(group=GROUP) if found is None else found):
        if not benches and entry.name.endswith(BENCH):
            continue
        where = f"{entry.name} = {entry.value}"
        owner = entry.dist.name if entry.dist is not None else "an unnamed distribution"
        loaded = _load(entry)
        if isinstance(loaded, ModuleNotFoundError):
            broken.append(BrokenPlugin(where, owner, f"ModuleNotFoundError: {loaded}", missing=loaded.name or ""))
            continue
        if isinstance(loaded, str):
            broken.append(BrokenPlugin(where, owner, loaded))
            continue
        key = (loaded.kind, loaded.name)
        reason = f"another plugin has a {loaded.kind.replace('_', ' ')} driver {loaded.name!r} too"
        twice = BrokenPlugin(where, owner, reason, "Uninstall all but one of them.", key)
        claims.setdefault(key, []).append((loaded, twice))
    usable = [plugins[0][0] for _, plugins in sorted(claims.items()) if len(plugins) == 1]
    broken += [twice for _, plugins in sorted(claims.items()) if len(plugins) > 1 for _, twice in plugins]
    return Drivers(tuple(usable), tuple(broken))


def _distinct(found: Iterable[EntryPoint]) -> Iterable[EntryPoint]:
    """Without duplicates: an installed and a source copy of one distribution list the same entry points."""
    seen: dict[tuple[str, str, str], EntryPoint] = {}
    # A distribution's name is parsed out of its description each time, and one of them has most entry points.
    owners: dict[int, str] = {id(None): ""}
    for entry in (found := list(found)):
        if id(entry.dist) not in owners and entry.dist is not None:
            owners[id(entry.dist)] = entry.dist.name.replace("_", "-").lower()
        owner = owners[id(entry.dist)]
        seen.setdefault((owner, entry.name, entry.value), entry)
    return sorted(seen.values(), key=lambda entry: (entry.name, entry.value))


def _load(entry: EntryPoint) -> Driver | ModuleNotFoundError | str:
    """The driver, or the reason why it can't be used."""
    try:
        driver = entry.load()
    except ModuleNotFoundError as error:
        return error
    except (Exception, SystemExit) as error:  # noqa: BLE001 - a plugin may raise anything, and must not stop the others
        return f"{type(error).__name__}: {error}"
    return _problem_of(driver) or driver


def _problem_of(driver: Any) -> str:
    """Why the object of an entry point can't be used; empty if it can."""
    if not isinstance(driver, Driver):
        return f"it names a {type(driver).__name__}, not a hal.registry.Driver"
    if driver.kind not in KINDS:
        return f"its kind {driver.kind!r} is not one of {', '.join(KINDS)}"
    if problem := mismatch(driver, Driver):
        return f"its Driver is wrong: {problem}"
    unexplained = [key for key in driver.required if key not in driver.settings]
    return f"it requires {', '.join(unexplained)} without explaining it in settings" if unexplained else ""


def check_settings(driver: Driver, settings: Mapping[str, Any]) -> None:
    """Check the keys of a device's table against the driver's settings.

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
                remedy=f"Its settings: {_explained(driver)}.",
            )
    for key in driver.required:
        if key not in settings:
            raise PluginError(
                "setting-missing",
                what=f"The {driver.kind} driver {driver.name!r} needs the setting {key!r}.",
                remedy=f"Add it: {key} ({driver.settings[key]}).",
            )


def check_device(driver: Driver, settings: Mapping[str, Any], context: OpenContext, *, name: str = "") -> None:
    """Check ``settings`` as ``check_settings``, then by the driver's own ``check``. Raises as ``open_device``."""
    check_settings(driver, settings)
    if driver.check is not None:
        _caller(driver, name).call("check", driver.check, Any, settings, context)


def open_device(
    driver: Driver, settings: Mapping[str, Any], context: OpenContext, deadline: Deadline, *, name: str = ""
) -> Any:
    """Check ``settings``, then open the device. ``name``: its name in the stage, for messages.

    Later calls of the device are checked, too (see ``hal.driver_calls``). Raises PluginError for the
    settings, the driver's own DeviceError, DriverFault("driver-fault") for other errors or wrong results, and
    DriverFault("driver-stuck") where it does not return; what it opens later is closed.
    """
    check_settings(driver, settings)
    if not context.checked:
        return driver.open(settings, context, deadline)
    caller = _caller(driver, name)
    made = caller.call("open", driver.open, Any, settings, context, deadline, late=closed_quietly)
    return caller.device(driver.kind, made)


def _caller(driver: Driver, name: str) -> Caller:
    device = f"{driver.kind.replace('_', ' ')} {name}" if name else f"the {driver.kind.replace('_', ' ')}"
    return Caller(f"The driver {driver.name!r} of {device}")


def setting(settings: Mapping[str, Any], key: str, kind: type | tuple[type, ...], default: Any = None) -> Any:
    """The value of ``key``, or ``default``; PluginError("setting-wrong") if it is not of ``kind``."""
    value = settings.get(key, default)
    if key in settings and (not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool)):
        kinds = kind if isinstance(kind, tuple) else (kind,)
        shown = HIDDEN if is_secret(key) else toml_value(value)
        raise PluginError(
            "setting-wrong",
            what=f"The setting '{key}' is {shown}, not {' or '.join(_KIND_WORDS[k] for k in kinds)}.",
            remedy=f"Correct {key} in stage.toml.",
        )
    return value


def _explained(driver: Driver) -> str:
    return ", ".join(f"{key} ({text})" for key, text in driver.settings.items()) or "none"
