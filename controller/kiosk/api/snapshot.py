"""The state that the panel's first page shows, read from a running service."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Final

from controller.kiosk.interface import BundleIdentity, DeviceRow, Grade, KioskState
from controller.kiosk.service import Service
from controller.kiosk.store import runs

GRADES_EVERY_S: Final = 10.0


class Snapshots:
    """Use it only in the reconciler's thread."""

    def __init__(self, stage: Path) -> None:
        self._stage = stage
        self._grades: tuple[float, tuple[Grade, ...]] = (0.0, ())
        self._since = ("", 0.0)

    def of(self, service: Service, revision: int) -> KioskState:
        """The state now; the grades come from the disk and may be some seconds old."""
        machine, shown = service.reconciler.machine, service.player.view.shown
        state = machine.state.value
        if self._since[0] != state:
            self._since = (state, time.time())
        at_s, grades = self._grades
        if time.monotonic() - at_s > GRADES_EVERY_S or not at_s:
            grades = runs.grades(self._stage, service.checked.stage.tables.calibration.worst_grade)
            self._grades = time.monotonic(), grades
        index = service.bundles.index(bundle := service.bundles.bundle())
        identity = None
        if index is not None and bundle is not None:
            identity = BundleIdentity(index.revision, bundle.stem, float(index.created_unix_s))
        return KioskState(
            revision=revision,
            stage=service.checked.stage.tables.stage.name,
            state=state,
            reason=machine.reason,
            since_unix_s=self._since[1],
            devices=(*service.rows(), self._player_row(service), *self._disk_row(service)),
            job=service.jobs.job,
            playing=shown.appearance if shown is not None else "",
            next_event=service.reconciler.plan.next,
            bundle=identity,
            lamps=service.lamps,
            grades=grades,
            identifying=service.player.identifying,
            warnings=self._warnings(service),
            failures=service.log.failures,
        )

    def _warnings(self, service: Service) -> tuple[str, ...]:
        said = service.player.view.warning
        return service.devices.warnings if said is None else (*service.devices.warnings, said.text)

    def _player_row(self, service: Service) -> DeviceRow:
        problem = service.player.view.problem
        what, remedy = (None, "") if problem is None else (problem.reason, problem.remedy)
        return DeviceRow("player", "display", "player", (), what, remedy)

    def _disk_row(self, service: Service) -> tuple[DeviceRow, ...]:
        if service.log.problem is None:
            return ()
        remedy = "Free some space on the disk. Playback continues."
        return (DeviceRow("disk", "disk", "", (), f"The event log can't be written: {service.log.problem}.", remedy),)
