"""The doctor's findings on a kiosk, and the device search for a new one."""

from __future__ import annotations

import shutil
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

from controller.config.writer import toml_text
from controller.core.text import printable
from controller.kiosk.service import Service
from controller.kiosk.state import troubles
from controller.kiosk.values import FoundDevice, TriedDevice
from controller.run.progress import Silent
from controller.stage.doctor.examine import Tools, examine
from controller.stage.doctor.values import Examination
from hal.deadline import in_seconds
from hal.errors import CodedError
from hal.finding import Found
from hal.notices import Level, Notice
from hal.registry import OpenContext, load_drivers, open_device

LOW_DISK_BYTES: Final = 2 << 30
_TABLES: Final = {"projector": "projectors", "power_switch": "relays", "button_panel": "key_panel"}
_LISTS: Final = ("projectors", "relays")


class Examinations:
    """One search of the buses at a time: two would take each other's ports. Who asks meanwhile gets the same answer."""

    def __init__(self, search: Callable[[], Sequence[Notice]]) -> None:
        self._search, self._lock = search, threading.Lock()
        self._ended_s, self._found = float("-inf"), tuple[Notice, ...]()

    def findings(self) -> Sequence[Notice]:
        asked_s = time.monotonic()
        with self._lock:
            if self._ended_s < asked_s:
                self._found = tuple(self._search())
                self._ended_s = time.monotonic()
            return self._found


def findings(stage: Path, service: Service | None, *, tools: Tools | None = None) -> Sequence[Notice]:
    """Problems of the disk, the devices, the player and the buses, worst first, and what was examined."""
    rows = () if service is None else (service.disk.row, *service.rows())
    problems = [Notice("", what, remedy, Level.ERROR, names) for names, what, remedy in troubles(rows)]
    if service is not None:
        player = service.player.view
        problems += [
            replace(notice, about="player") for notice in (player.problem, player.warning) if notice is not None
        ]
    if shutil.disk_usage(stage).free < LOW_DISK_BYTES:
        problems.append(Notice.warning("disk-low", "Less than 2 GiB are free on the stage's disk.",
                                       "Delete old runs or backups. Playback continues; calibration may fail.",
                                       about="disk"))  # fmt: skip
    searched = _search(tools)
    for found in searched.findings:
        problems.append(Notice.warning(found.code, printable(found.what), printable(found.remedy),
                                       about=printable(found.about or "bus")))  # fmt: skip
    problems.sort(key=lambda notice: notice.level is not Level.ERROR)
    names = ", ".join((*(row.name for row in rows), "player", "ports", "network", "USB", "outputs"))
    what = f"{names}. Devices there: {', '.join(printable(one.what) for one in searched.found) or 'none'}."
    return [*problems, Notice("examined", what, "", about="Examined")]


def _search(tools: Tools | None) -> Examination:
    return examine(stage=None, write_it=False, reporter=Silent(), cancel=threading.Event(), tools=tools)


def find(stage: Path, *, tools: Tools | None = None) -> Sequence[FoundDevice]:
    """Every device of every bus, with its table for stage.toml."""
    return [_row(device) for device in _search(tools).found]


def _row(device: Found) -> FoundDevice:
    table = _TABLES.get(device.kind, device.kind)
    text = ""
    if device.driver:
        content = {"driver": device.driver, **device.settings}
        text = toml_text({table: [content] if table in _LISTS else content})
    return FoundDevice(f"{device.bus}:{device.address}", device.kind, device.driver, printable(device.what), text)


def try_device(stage: Path, key: str, *, tools: Tools | None = None) -> TriedDevice:
    """Open the device and read its identity; changes nothing."""
    device = next((device for device in _search(tools).found if f"{device.bus}:{device.address}" == key), None)
    if device is None:
        return TriedDevice(False, "The device was not found any more. Plug it in and search again.")
    if not device.driver:
        return TriedDevice(False, "No driver is known for this device. Write its table into stage.toml by hand.")
    try:
        drivers = tools.drivers if tools is not None and tools.drivers is not None else load_drivers(benches=False)
        driver = drivers.get(device.kind, device.driver)
        opened = open_device(driver, dict(device.settings), OpenContext(stage=stage), in_seconds(20.0))
    except CodedError as error:
        return TriedDevice(False, f"{error.what} {error.remedy}")
    try:
        identity = opened.identity(deadline=in_seconds(10.0))
        text = printable(f"{identity.maker} {identity.model} {identity.serial}".strip())
        return TriedDevice(True, f"The device answers: {text}.")
    except CodedError as error:
        return TriedDevice(False, f"{error.what} {error.remedy}")
    finally:
        opened.close()
