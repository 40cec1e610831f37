"""Search every bus, test the stage's own devices, and compare."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from controller.config.loader import FILE
from controller.core.errors import UsageError
from controller.core.storage import exclusive
from controller.optics.solve.engines import graphics_sentence
from controller.run.progress import Reporter
from controller.stage.doctor.search_address import PJLINK, search_address
from controller.stage.doctor.trying import Trying, devices_of
from controller.stage.doctor.values import Examination
from controller.stage.doctor.writing import write
from controller.stage.sessions.check import Checked, check_stage
from controller.stage.sessions.run import LOCK
from hal.deadline import Cancelled, Deadline, in_seconds
from hal.errors import DeviceError
from hal.finding import Finder, Found, Known, SearchScope, load_finders, search_bus
from hal.notices import Notice
from hal.registry import Drivers, load_drivers

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
    outputs = {output.name for output in checked.stage.tables.display.outputs} if checked is not None else set()
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
    for one, finding in Trying(checked, deadline).each(failed):
        tried.append(one)
        if finding is not None and replace(finding, about="") not in [
            replace(earlier, about="") for earlier in findings
        ]:
            findings.append(finding)
    return replace(seen, tried=tuple(tried), findings=tuple(findings))
