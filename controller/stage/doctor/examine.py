"""Searches every bus, tests the stage's own devices, and compares. No lamp, relay or camera is operated."""

from __future__ import annotations

import contextlib
import fcntl
import socket
import struct
import threading
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, cast

from controller.config.loader import FILE
from controller.config.models import ONLY_CAMERA
from controller.core.errors import UsageError
from controller.core.storage import exclusive
from controller.optics.solve.engines import graphics_sentence
from controller.run.progress import Reporter
from controller.stage.doctor.values import DeviceResult, Examination
from controller.stage.doctor.writing import write
from controller.stage.rig.lamp_guard import fatal_faults, faulty
from controller.stage.sessions.check import Checked, check_stage
from controller.stage.sessions.run import LOCK, open_context
from hal.deadline import Cancelled, Deadline, in_seconds
from hal.errors import DeviceError
from hal.finding import Finder, Found, Known, SearchScope, load_finders, search_bus
from hal.interfaces import ButtonPanel, Camera, Douser, LightSensor, PowerSwitch, Projector, WatchedProjector
from hal.notices import Notice
from hal.registry import Driver, Drivers, load_drivers, open_device
from hal.values import Power

OPEN_S = 15.0


_DOUSER: Final = {True: "closed", False: "open", None: "not moved yet"}


@dataclass(frozen=True, slots=True)
class Device:
    """A device of the stage: its name for people, and how to open it."""

    name: str
    kind: str
    driver: Driver
    settings: Mapping[str, Any]

    @property
    def title(self) -> str:
        """Its name in stage.toml, or "" for a kind of which a stage has at most one."""
        is_one_of_many = self.kind in ("projector", "power_switch") or (
            self.kind == "camera" and self.name != ONLY_CAMERA
        )
        return self.name if is_one_of_many else ""

    @property
    def place(self) -> str:
        """Its address in its table."""
        return str(self.settings.get("port") or self.settings.get("address") or self.settings.get("serial") or "")


def devices_of(checked: Checked) -> Iterator[Device]:
    """Relays first, because a projector without mains does not answer. The display is not tested: it is our own."""
    tables = checked.stage.tables
    for relays, (driver, settings) in zip(tables.relays, checked.relays, strict=True):
        yield Device(relays.name, "power_switch", driver, settings)
    for projector, (driver, settings) in zip(tables.projectors, checked.projectors, strict=True):
        yield Device(projector.name, "projector", driver, settings)
    for projector, douser in zip(tables.projectors, checked.dousers, strict=True):
        if douser is not None:
            yield Device(f"{projector.name} (douser)", "douser", *douser)
    for (name, _), (driver, settings) in zip(tables.views, checked.cameras, strict=True):
        yield Device(name, "camera", driver, settings)
    if checked.light_sensor is not None:
        yield Device("light sensor", "light_sensor", *checked.light_sensor)
    if checked.key_panel is not None:
        yield Device("key panel", "button_panel", *checked.key_panel)


class DeviceSurvey:
    """Tests one device after the other, and remembers which relays are open."""

    def __init__(self, checked: Checked, deadline: Deadline) -> None:
        self._checked = checked
        self._deadline = deadline
        self._dark: dict[str, str] = {}

    def results(self, failed: Mapping[str, Notice]) -> Iterator[tuple[DeviceResult, Notice | None]]:
        """Test every device, except those whose address has ``failed`` already."""
        for device in devices_of(self._checked):
            problem = failed.get(device.place)
            answer = None
            if problem is None:
                try:
                    answer = self._answer_of(device)
                except DeviceError as error:
                    problem = Notice.of(error)
            if problem is not None and device.name in self._dark:
                problem = Notice.warning(
                    "mains-off",
                    f"Projector {device.name} does not answer, and its mains relay {self._dark[device.name]} is open.",
                    "A run closes it automatically. To test it now, switch the relay on by hand (usbrelay).",
                )
            yield DeviceResult(device.name, device.kind, answer), problem and replace(problem, about=device.name)

    def _answer_of(self, device: Device) -> str:
        context = open_context(self._checked.stage.folder)
        until = self._deadline.within(OPEN_S)
        opened = open_device(device.driver, device.settings, context, until, name=device.title)
        with contextlib.closing(opened):
            identity = opened.identity(deadline=self._deadline.within(OPEN_S))
            says = f"{identity.maker} {identity.model}" + (f", number {identity.serial}" if identity.serial else "")
            return f"{says}: {self._state(device, opened)}"

    def _state(self, device: Device, opened: object) -> str:
        until = self._deadline.within(OPEN_S)
        match device.kind:
            case "projector":
                return self._projector(device.name, cast("Projector", opened))
            case "power_switch":
                return self._relays(device.name, cast("PowerSwitch", opened))
            case "douser":
                return _DOUSER[cast("Douser", opened).closed(deadline=until)]
            case "light_sensor":
                return f"{cast('LightSensor', opened).illuminance_lux(deadline=until):.2f} lux"
            case "button_panel":
                return f"{cast('ButtonPanel', opened).capabilities.keys} keys"
        can = cast("Camera", opened).capabilities
        formats = [word for word, has in (("RAW", can.raw), ("JPEG", can.jpeg)) if has]
        return f"{' and '.join(formats) or 'no format'}, {len(can.exposures_s)} exposure times"

    def _projector(self, name: str, projector: Projector) -> str:
        can = projector.capabilities
        status = projector.status(deadline=self._deadline.within(max(OPEN_S, can.answer_s)))
        if status.power is Power.FAULT or fatal_faults(status):
            raise faulty(name, status)
        hours = "" if status.lamp_hours is None else f", {status.lamp_hours} lamp hours"
        warned = f", {', '.join(status.faults)}" if status.faults else ""
        by_hand = "" if can.power else ", must be switched by hand"
        notices = projector.notices() if isinstance(projector, WatchedProjector) else []
        return " ".join([f"{status.power.value}{hours}{warned}{by_hand}", *(f"({notice.what})" for notice in notices)])

    def _relays(self, name: str, board: PowerSwitch) -> str:
        until = self._deadline.within(OPEN_S)
        closed = [board.state(channel, deadline=until) for channel in range(1, board.channels(deadline=until) + 1)]
        for table in self._checked.stage.tables.relays:
            for mains in table.mains if table.name == name else ():
                if mains.channel <= len(closed) and not closed[mains.channel - 1]:
                    self._dark.update(dict.fromkeys(mains.feeds, f"{name} {mains.channel}"))
        return ", ".join(f"relay {n} {'closed' if shut else 'open'}" for n, shut in enumerate(closed, 1))


ALL: Final = "all"
EVERYWHERE: Final = "255.255.255.255"
PJLINK: Final = 4352
_SIOCGIFBRDADDR: Final = 0x8919
_LONGEST: Final = 15


def search_address(interface: str) -> str:
    """The broadcast address of ``interface``, or of all for "all". Raises UsageError("interface-unknown")."""
    if interface == ALL:
        return EVERYWHERE
    names = sorted(name for _, name in socket.if_nameindex())
    if interface in names and len(interface) <= _LONGEST:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_socket:
            try:
                reply = fcntl.ioctl(any_socket, _SIOCGIFBRDADDR, struct.pack("256s", interface.encode()))
            except OSError:
                reply = b""
        if reply and reply[20:24] != bytes(4):
            return socket.inet_ntoa(reply[20:24])
        raise UsageError(
            "interface-unknown",
            what=f"The network interface {interface} has no broadcast address.",
            remedy="Connect it, or name another one.",
        )
    raise UsageError(
        "interface-unknown",
        what=f"There is no network interface {interface!r}.",
        remedy=f"Use one of {', '.join(names)}, or {ALL}.",
    )


LONGEST_S: Final = 300.0


@dataclass(frozen=True, slots=True)
class Tools:
    """Finders and drivers; only tests replace the installed ones. ``wanted`` changes where to search."""

    finders: tuple[Finder, ...] | None = None
    drivers: Drivers | None = None
    wanted: dict[str, Any] | None = None


def examine(
    *,
    stage: Path | None,
    write_it: bool,
    reporter: Reporter,
    cancel: threading.Event,
    network: str = "",
    tools: Tools | None = None,
) -> Examination:
    """The result of `velatura doctor`. ``write_it``: also write the devices found to stage.toml. ``network``: the
    interface on which projectors are searched, "all", or "": no search, and only the stage's own devices are asked.

    Raises UsageError("already-running") while another program works on the stage, and what writing raises.
    """
    tools = tools or Tools()
    folder = stage or Path()
    deadline = in_seconds(LONGEST_S, cancel)
    with contextlib.ExitStack() as stack:
        if stage is not None and (folder / FILE).exists():
            stack.enter_context(exclusive(folder / LOCK, what_is_running="Velatura"))
        checked, wrong = _checked(folder, tools) if stage is not None else (None, [])
        search = (search_address(network), PJLINK) if network else None
        wanted = SearchScope(folder, _known(checked), **{"search": search, **(tools.wanted or {})})
        _say_what_is_sent(wanted, reporter)
        found, problems = _search(wanted, tools.finders, deadline, reporter)
        seen = _compared(checked, found, [*wrong, *problems], tools)
        if checked is not None:
            seen = _tried(checked, seen, deadline, reporter)
        seen = replace(seen, graphics=graphics_sentence())
    if write_it:
        if wrong and checked is None:
            raise UsageError(wrong[0].code, what=wrong[0].what, remedy=wrong[0].remedy)
        seen = replace(seen, written=write(folder, None if checked is None else checked.stage, seen))
    return seen


def _say_what_is_sent(wanted: SearchScope, reporter: Reporter) -> None:
    """Name every place outside this computer that gets a message."""
    addresses = [
        str(place) for one in wanted.known for place in (one.settings.get("address"), one.settings.get("port"))
        if place and (one.settings.get("address") or "://" in str(place))
    ]  # fmt: skip
    if addresses:
        reporter.say(f"Asking the stage's own devices on the network: {', '.join(dict.fromkeys(addresses))}.")
    if wanted.search is None:
        reporter.say("Not searching the network. --network INTERFACE sends a search for projectors.")
    else:
        reporter.say("Sending a search for projectors (PJLink, UDP port {1}) to {0}.".format(*wanted.search))


def _checked(folder: Path, tools: Tools) -> tuple[Checked | None, list[Notice]]:
    """The stage, or the error in its stage.toml; a folder without stage.toml is not a stage yet."""
    if not (folder / FILE).exists():
        if not folder.is_dir():
            raise UsageError(
                "stage-missing",
                what=f"The folder {folder} does not exist.",
                remedy="Create it, or give another folder.",
            )
        return None, []
    try:
        checked = check_stage(folder, drivers=tools.drivers)
    except (UsageError, DeviceError) as error:
        return None, [Notice.of(error, about=FILE)]
    return checked, [Notice.of(fault, about=FILE) for fault in checked.faults]


def _known(checked: Checked | None) -> tuple[Known, ...]:
    if checked is None:
        return ()
    return tuple(Known(device.kind, device.driver.name, device.settings) for device in devices_of(checked))


def _search(
    wanted: SearchScope, finders: Sequence[Finder] | None, deadline: Deadline, reporter: Reporter
) -> tuple[list[Found], list[Notice]]:
    """Search all buses in parallel, because most of the time is spent waiting for answers."""
    problems: list[Notice] = []
    if finders is None:
        finders, broken = load_finders()
        problems += broken
    found: list[Found] = []
    reporter.say(f"Searching {', '.join(finder.bus for finder in finders)}.")
    with ThreadPoolExecutor(max(1, len(finders)), thread_name_prefix="doctor") as pool:
        for finder, search in [(finder, pool.submit(search_bus, finder, wanted, deadline)) for finder in finders]:
            try:
                found += search.result()
            except Cancelled:
                raise
            except DeviceError as error:
                problems.append(Notice.of(error, about=finder.bus))
    return found, problems


def _compared(checked: Checked | None, found: Sequence[Found], problems: list[Notice], tools: Tools) -> Examination:
    """Which of them the stage has, and the problems of each."""
    known = [] if checked is None else list(devices_of(checked))
    own = {(device.driver.name, device.place) for device in known}
    kinds = {device.kind for device in known}
    tables = () if checked is None else checked.stage.tables.display.outputs
    outputs = {output.name for output in tables if not output.elsewhere}
    new = []
    for one in found:
        problems += [replace(problem, about=one.address) for problem in one.problems]
        if not one.driver or one.kind == "display":
            continue
        # A table without an address or serial number stands for the only device of its kind.
        if not any((one.driver, place) in own for place in (*map(str, one.settings.values()), "")):
            new.append(one)
    if checked is not None:
        problems += _not_in_stage(new, kinds)
        problems += _unplugged_outputs(found, outputs)
    for plugin in (tools.drivers or load_drivers(benches=False)).broken:
        what = f"The plugin {plugin.entry_point} of {plugin.distribution} can't be used: {plugin.reason}."
        problems.append(Notice.warning("plugin-broken", what, plugin.remedy))
    return Examination(tuple(found), (), tuple(problems), tuple(new))


def _not_in_stage(new: Sequence[Found], kinds: set[str]) -> list[Notice]:
    missing = []
    for device in new:
        if device.kind == "power_switch":
            remedy = (
                "Add it by hand, with the projector of each relay: [[relays]] with driver, serial and "
                "[[relays.mains]] (docs/how-to/relays-sensor-keys.md)."
            )
        elif device.kind == "camera" and "camera" in kinds:
            remedy = f"If it is the one to use, write address = {device.settings.get('address', '')!r} into [camera]."
        else:
            remedy = "Add it with `velatura doctor STAGE --write`, or unplug it if it is not part of this stage."
        what = f"{device.what} is not in stage.toml."
        missing.append(Notice.warning("not-in-stage", what, remedy, about=device.address))
    return missing


def _unplugged_outputs(found: Sequence[Found], outputs: set[str]) -> list[Notice]:
    """Outputs of stage.toml that the X server does not have; empty without an X server."""
    there = {device.address for device in found if device.kind == "display"}
    if not there:
        return []
    return [
        Notice.warning(
            "output-missing",
            f"stage.toml has an output {name}, and the X server has {', '.join(sorted(there))}.",
            "Connect the projector and enable the output (xrandr), or correct [[display.outputs]].",
            about=name,
        )
        for name in sorted(outputs - there)
    ]


def _tried(checked: Checked, seen: Examination, deadline: Deadline, reporter: Reporter) -> Examination:
    reporter.say("Testing the stage's own devices; no lamp is switched on.")
    failed = {
        device.address: device.problems[0]
        for device in seen.found
        if device.problems and not device.problems[0].code.endswith("may-be-taken")
    }
    tried, findings = [], list(seen.findings)
    for result, finding in DeviceSurvey(checked, deadline).results(failed):
        tried.append(result)
        if finding is not None and replace(finding, about="") not in [replace(known, about="") for known in findings]:
            findings.append(finding)
    return replace(seen, tried=tuple(tried), findings=tuple(findings))
