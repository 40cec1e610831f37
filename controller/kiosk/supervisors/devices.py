"""The supervisors of all devices of a stage, and the rig that they lend to jobs."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Final, cast

from controller.core.text import printable
from controller.kiosk.changes.devices import camera_facts, projector_facts
from controller.kiosk.changes.inventory import Fact
from controller.kiosk.decide.interfaces import DISK_FULL, NOT_YET, Condition, ProjectorView
from controller.kiosk.state import DeviceRow, LiveValue
from controller.kiosk.supervisors.device_supervisor import DeviceSupervisor
from controller.kiosk.supervisors.light_records import LightDose
from controller.kiosk.supervisors.mains_supervisor import Boards, MainsSupervisor
from controller.kiosk.supervisors.projector_supervisor import LampBefore, Mains, Pace, ProjectorSupervisor
from controller.kiosk.world import World
from controller.stage.rig.ambient_light import AmbientLightLimit, LightWatch
from controller.stage.rig.lamp_guard import LampGuard
from controller.stage.rig.lamp_ledger import LampFile
from controller.stage.rig.rig import Rig
from controller.stage.sessions.check import Checked
from controller.stage.sessions.open import (
    light_sensor,
    mains_circuits,
    open_camera,
    open_device,
    open_projector,
    rig_of,
    views_opened,
)
from hal.deadline import Deadline
from hal.errors import DeviceGone
from hal.interfaces import Camera, Device, Display, LightSensor, WatchedCamera
from hal.notices import Level, Notice

Tell = Callable[[Notice], object]


class Devices:
    """All device supervisors of a stage; the devices are opened by their ``step``.

    ``scene`` names the steady picture on the object, for the light sensor; None while nothing is steady.
    """

    def __init__(self, checked: Checked, runtime: Path, tell: Tell, world: World | None = None) -> None:
        self._checked, self._tell = checked, tell
        self._world = world or World()
        self._context = self._world.open_context(checked.stage.folder, runtime)
        self._ledger = LampFile(checked.stage.folder / LampFile.NAME)
        self.mains = self._mains_supervisor()
        self.projectors = tuple(self._projector(number) for number in range(len(checked.projectors)))
        if self.mains is not None:
            self.mains.supervisors = self.projectors
        tables = checked.stage.tables
        self.scene: Callable[[], str | None] = lambda: None
        self._room: str | None = None
        self._dose = LightDose(checked.stage.folder, monotonic=self._world.monotonic)
        drivers = {name: table.driver for name, table in tables.views}
        self.cameras = {
            name: DeviceSupervisor(DeviceRow(name, "camera", drivers[name]), partial(self._open_camera, name),
                                   _look_at_camera, tell, every_s=60.0, world=self._world)
            for name in views_opened(checked)
        }  # fmt: skip
        self.camera = next(iter(self.cameras.values()))
        self.sensor = self._sensor()

    def use(self, checked: Checked) -> None:
        """Use settings in which nothing differs that a device is opened with."""
        self._checked = checked

    @property
    def others(self) -> tuple[DeviceSupervisor, ...]:
        """The supervisors of all devices that are not projectors."""
        rest = (supervisor for supervisor in (self.sensor, self.mains) if supervisor is not None)
        return (*self.cameras.values(), *rest)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Problems that belong to no device."""
        return () if self._room is None else (f"{self._room} {_DARKEN}",)

    @property
    def dose_klx_h(self) -> float | None:
        """The object's light dose, in steps of 0.01 klx h; None without a light sensor."""
        return None if self.sensor is None else round(self._dose.lux_hours / 1000, 2)

    def rows(self) -> tuple[DeviceRow, ...]:
        """The rows that the panel shows."""
        tables = self._checked.stage.tables.projectors
        projectors = [
            projector_row(supervisor.view, table.driver, table.output)
            for supervisor, table in zip(self.projectors, tables, strict=True)
        ]
        return (*projectors, *(supervisor.row for supervisor in self.others))

    def facts(self) -> tuple[Fact, ...]:
        """What the devices report. Seconds; unknown what is missing, or lent to a job."""
        in_s = self._world.deadline
        found = [fact for one in self.projectors for fact in projector_facts(one.name, one.guard, in_s)]
        mine = self.camera.lent.acquire(blocking=False)
        try:
            return (*found, *camera_facts(self.camera.device if mine else None, in_s))
        finally:
            if mine:
                self.camera.lent.release()

    def missing_for_work(self) -> Notice | None:
        """The missing device that photographs need, or None."""
        if self.camera.device is None or self.camera.problem is not None:
            problem = self.camera.problem or Notice(NOT_YET, "The camera is not connected yet.", "Wait for it.")
            reason = f"No photographs are possible without the camera. {problem.what}"
            return replace(problem, what=reason, level=Level.ERROR)
        views = [supervisor.view for supervisor in self.projectors]
        missing = [view.name for view in views if view.condition in (Condition.LOST, Condition.BROKEN)]
        full = next(
            (view.problem for view in views if view.problem is not None and view.problem.code == DISK_FULL), None
        )
        if full is not None:
            return full
        if missing:
            return Notice("projector-missing", f"No photographs are possible without projector {', '.join(missing)}.",
                            "Repair it first. Playback continues without it.", Level.ERROR)  # fmt: skip
        return None

    @contextlib.contextmanager
    def lent(self) -> Iterator[Rig]:
        """The opened devices for one job. Raises DeviceGone("device-missing") and what opening raises."""
        with contextlib.ExitStack() as stack:
            for supervisor in (*self.cameras.values(), *([] if self.sensor is None else [self.sensor])):
                # The supervisor's thread must not use the device during the job.
                stack.enter_context(supervisor.lent)
            # Only with the lock: before that, its supervisor may close it.
            cameras = {name: one.device for name, one in self.cameras.items() if one.device is not None}
            guards = [supervisor.guard for supervisor in self.projectors]
            if self.camera.device is None or any(guard is None for guard in guards):
                raise DeviceGone("device-missing", what="A device that the job needs is missing.",
                                 remedy="See the list of devices.")  # fmt: skip
            driver, settings = self._checked.display
            table = self._checked.stage.tables.display
            display = cast("Display", open_device(table, driver, settings, self._context, self._world.deadline(20)))
            stack.callback(display.close)
            held = [guard for guard in guards if guard is not None]
            rig = rig_of(self._checked.stage, held, cast("dict[str, Camera]", cameras), display)
            absent = {name: self._absent(name) for name in self.cameras if name not in cameras}
            try:
                yield replace(rig, ambient_limit=self._ambient_limit(), absent=absent)
            except DeviceGone as error:
                # The job sees only a closed device; its supervisor knows the reason.
                lost = any(
                    supervisor.guard is not guard for supervisor, guard in zip(self.projectors, guards, strict=True)
                )
                if lost and (missing := self.missing_for_work()) is not None:
                    raise DeviceGone("device-missing", what=missing.what, remedy=missing.remedy) from error
                raise

    def close(self) -> None:
        for projector in self.projectors:
            projector.close()
        for supervisor in self.others:
            supervisor.close()
        self._dose.save()

    # -- opening

    def _projector(self, number: int) -> ProjectorSupervisor:
        tables = self._checked.stage.tables
        table = tables.projectors[number]
        at_least = tables.safety.at_least()

        def open_guard(deadline: Deadline) -> LampGuard:
            projector = open_projector(self._checked, number, self._context, deadline)
            return LampGuard(table.name, projector, self._ledger, at_least=at_least, clock=self._world,
                             lock=self._world.rlock())  # fmt: skip

        mains = Mains(problem=partial(self._unfed, table.name))
        if self.mains is not None:
            mains = replace(mains, asleep=partial(self.mains.silences, table.name))
        # Lit when the service before this one ended: it may burn behind a line that does not answer. So may one of
        # which nothing is known, because the ledger was damaged: its record has no boot.
        record = self._ledger.read(table.name)
        maybe_lit = record is not None and record.lit and record.boot in ("", self._world.boot())
        # Before its projector is reached: an opening may come first.
        failed = 0 if record is None else record.failed_in(self._world.boot())
        lamp = LampBefore(maybe_lit, failed, partial(self._ledger.forgive, table.name))
        supervisor = ProjectorSupervisor(table.name, open_guard, self._tell, clock=self._world, mains=mains, lamp=lamp,
                                         deadline=self._world.deadline)  # fmt: skip
        supervisor.pace = Pace(table.ask_lit_s, table.ask_dark_s)
        return supervisor

    def _unfed(self, projector: str) -> Notice | None:
        feeds = [name for table in self._checked.stage.tables.relays for mains in table.mains for name in mains.feeds]
        return self.mains.problem if self.mains is not None and projector in feeds else None

    def _open_camera(self, view: str, deadline: Deadline) -> Device:
        return open_camera(self._checked, view, self._context, deadline)

    def _absent(self, view: str) -> DeviceGone:
        problem = self.cameras[view].problem or Notice(NOT_YET, "The camera is not connected yet.", "Wait for it.")
        return DeviceGone(problem.code, what=problem.what, remedy=problem.remedy)

    def _sensor(self) -> DeviceSupervisor | None:
        table = self._checked.stage.tables.light_sensor
        if table is None:
            return None

        def open_sensor(deadline: Deadline) -> Device:
            opened = light_sensor(self._checked, self._context, contextlib.ExitStack(), deadline)
            assert opened is not None
            return opened.sensor

        watch = LightWatch(table.most_lux)

        def look(device: Device, deadline: Deadline) -> tuple[LiveValue, ...]:
            lux = cast("LightSensor", device).illuminance_lux(deadline=deadline)
            self._report_light(watch.observe(lux, self.scene()))
            self._dose.add(lux)
            dark = DARK_ENOUGH if lux <= table.most_lux else TOO_BRIGHT
            return (LiveValue.said("Light", dark, lux, digits=2),)

        row = DeviceRow("light sensor", "sensor", table.driver)
        return DeviceSupervisor(row, open_sensor, look, self._tell, every_s=10.0, world=self._world)

    def _report_light(self, room: str | None) -> None:
        before, self._room = self._room, room
        if room is not None and before is None:
            self._tell(Notice("room-bright", room, _DARKEN, Level.WARNING))
        elif room is None and before is not None:
            self._tell(Notice("room-dark", "The room is dark again."))

    def _ambient_limit(self) -> AmbientLightLimit | None:
        table = self._checked.stage.tables.light_sensor
        if table is None or self.sensor is None or self.sensor.device is None:
            return None
        return AmbientLightLimit(cast("LightSensor", self.sensor.device), table.most_lux)

    def _mains_supervisor(self) -> MainsSupervisor | None:
        if not self._checked.relays:
            return None
        drivers = ", ".join(table.driver for table in self._checked.stage.tables.relays)

        def open_circuits(deadline: Deadline) -> Device:
            stack = contextlib.ExitStack()
            circuits = mains_circuits(self._checked, self._context, stack, deadline)
            return Boards(circuits, stack)

        return MainsSupervisor(drivers, open_circuits, self._tell, self._world)


DARK_ENOUGH: Final = "{0} lux (dark enough to calibrate)"
TOO_BRIGHT: Final = "{0} lux (too bright to calibrate)"
_DARKEN: Final = "Switch the lights off and close the blinds. Other light makes the appearance pale."


@lru_cache(maxsize=32)
def projector_row(view: ProjectorView, driver: str, output: str = "") -> DeviceRow:
    """The row of a projector on the panel. Made four times a second, and mostly the same."""
    problem = view.problem
    # The disk has a row of its own, and the lamp is not broken.
    of_disk = problem is not None and problem.code == DISK_FULL
    lamp = Condition.DARK if of_disk and view.condition is Condition.BROKEN else view.condition
    hours = LiveValue.said("Hours", "{0} h with Velatura, {1} strikes", view.hours, view.strikes)
    values = [LiveValue.said("Lamp", lamp.value), hours]
    if view.counter_hours is not None:
        values.append(LiveValue.said("Projector's counter", "{0} h", view.counter_hours))
    if view.condition is Condition.LIT and view.stable_left_s > 0:
        values.append(LiveValue.said("Stable in", "{0} s", view.stable_left_s))
    what, remedy = (None, "") if problem is None or of_disk else (problem.what, problem.remedy)
    return DeviceRow(view.name, "projector", driver, tuple(values), what, remedy, output)


def _look_at_camera(device: Device, deadline: Deadline) -> tuple[LiveValue, ...]:
    identity = device.identity(deadline=deadline)
    values = [LiveValue("Model", printable(f"{identity.maker} {identity.model}"))]
    if isinstance(device, WatchedCamera):
        status = device.status(deadline=deadline)
        if status.battery_percent is not None:
            values.append(LiveValue.said("Battery", "{0} %", status.battery_percent))
        if status.free_pictures is not None:
            values.append(LiveValue.said("Space for", "{0} pictures", status.free_pictures))
        if status.warnings:
            values.append(LiveValue("Warnings", ", ".join(status.warnings)))
    return tuple(values)
