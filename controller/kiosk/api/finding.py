"""What the doctor finds on a kiosk, and the devices that a search finds for a new one."""

from __future__ import annotations

import shutil
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from controller.config.writer import toml_text
from controller.core.errors import VelaturaError
from controller.core.text import printable
from controller.doctor.examine import Tools, examine
from controller.doctor.values import Examination
from controller.kiosk.interface import Finding, FoundDevice, TriedDevice
from controller.kiosk.service import Service
from controller.run.progress import Silent
from hal.deadline import in_seconds
from hal.errors import DeviceError
from hal.finding import Found
from hal.registry import OpenContext, load_drivers, open_device

LOW_DISK_BYTES: Final = 2 << 30
_TABLES: Final = {"projector": "projectors", "power_switch": "relays", "button_panel": "key_panel"}
_LISTS: Final = ("projectors", "relays")


def findings(stage: Path, service: Service | None, *, tools: Tools | None = None) -> Sequence[Finding]:
    """What is wrong: the devices' own problems, the disk, and what the buses say."""
    found = []
    for row in () if service is None else service.rows():
        if row.problem is not None:
            found.append(Finding("error", f"{row.kind} {row.name}", row.problem, row.remedy))
    if service is not None and service.player.view.problem is not None:
        problem = service.player.view.problem
        found.append(Finding("error", "player", problem.reason, problem.remedy))
    if service is not None and service.player.view.warning is not None:
        warning = service.player.view.warning
        found.append(Finding("warning", "player", warning.reason, warning.remedy))
    if shutil.disk_usage(stage).free < LOW_DISK_BYTES:
        found.append(Finding("warning", "disk", "Less than 2 GiB are free on the stage's disk.",
                             "Delete old runs or backups; playback goes on, calibrating may not."))  # fmt: skip
    seen = _search(tools)
    for one in seen.findings:
        found.append(Finding("warning", printable(one.device or "bus"), printable(one.problem.what),
                             printable(one.problem.remedy)))  # fmt: skip
    return found


def _search(tools: Tools | None) -> Examination:
    return examine(stage=None, write_it=False, reporter=Silent(), cancel=threading.Event(), tools=tools)


def find(stage: Path, *, tools: Tools | None = None) -> Sequence[FoundDevice]:
    """Every device of every bus, with its table for stage.toml."""
    seen = _search(tools)
    return [_found(one) for one in seen.found]


def _found(one: Found) -> FoundDevice:
    table = _TABLES.get(one.kind, one.kind)
    text = ""
    if one.driver:
        content = {"driver": one.driver, **one.settings}
        text = toml_text({table: [content] if table in _LISTS else content})
    return FoundDevice(f"{one.bus}:{one.address}", one.kind, one.driver, printable(one.what), text)


def try_device(stage: Path, key: str, *, tools: Tools | None = None) -> TriedDevice:
    """Open the device and ask it who it is; changes nothing."""
    seen = _search(tools)
    one = next((one for one in seen.found if f"{one.bus}:{one.address}" == key), None)
    if one is None:
        return TriedDevice(False, "It is not there any more. Plug it in and search again.")
    if not one.driver:
        return TriedDevice(False, "Nobody knows what drives it. Write its table into stage.toml by hand.")
    try:
        drivers = tools.drivers if tools is not None and tools.drivers is not None else load_drivers(benches=False)
        driver = drivers.get(one.kind, one.driver)
        opened = open_device(driver, dict(one.settings), OpenContext(stage=stage), in_seconds(20.0))
    except (DeviceError, VelaturaError) as error:
        return TriedDevice(False, f"{error.what} {error.remedy}")
    try:
        who = opened.identity(deadline=in_seconds(10.0))
        return TriedDevice(True, f"It answers: {printable(f'{who.maker} {who.model} {who.serial}'.strip())}.")
    except (DeviceError, VelaturaError) as error:
        return TriedDevice(False, f"{error.what} {error.remedy}")
    finally:
        opened.close()
