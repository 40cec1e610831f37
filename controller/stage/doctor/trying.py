"""Opens the devices of stage.toml and reads their state. No lamp, relay or camera is operated."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final, cast

from controller.stage.doctor.values import Tried
from controller.stage.rig.lamp_faults import fatal_faults, faulty
from controller.stage.sessions.check import Checked
from controller.stage.sessions.recording import open_context
from hal.deadline import Deadline
from hal.errors import DeviceError
from hal.interfaces import ButtonPanel, Camera, Douser, LightSensor, PowerSwitch, Projector, WatchedProjector
from hal.notices import Notice
from hal.registry import Driver, open_device
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
        return self.name if self.kind in ("projector", "power_switch") else ""

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
    yield Device("camera", "camera", *checked.camera)
    if checked.light_sensor is not None:
        yield Device("light sensor", "light_sensor", *checked.light_sensor)
    if checked.key_panel is not None:
        yield Device("key panel", "button_panel", *checked.key_panel)


class Trying:
    """Tests one device after the other, and remembers which relays are open."""

    def __init__(self, checked: Checked, deadline: Deadline) -> None:
        self._checked = checked
        self._deadline = deadline
        self._dark: dict[str, str] = {}

    def each(self, failed: Mapping[str, Notice]) -> Iterator[tuple[Tried, Notice | None]]:
        """Test every device, except those whose address has ``failed`` already."""
        for device in devices_of(self._checked):
            problem = failed.get(device.place)
            answer = None
            if problem is None:
                try:
                    answer = self._asked(device)
                except DeviceError as error:
                    problem = Notice.of(error)
            if problem is not None and device.name in self._dark:
                problem = Notice.warning(
                    "mains-off",
                    f"Projector {device.name} does not answer, and its mains relay {self._dark[device.name]} is open.",
                    "A run closes it automatically. To test it now, switch the relay on by hand (usbrelay).",
                )
            yield Tried(device.name, device.kind, answer), problem and replace(problem, about=device.name)

    def _asked(self, device: Device) -> str:
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
