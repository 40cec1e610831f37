"""The state that the panel's first page shows, read from a running service."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from controller.kiosk.api.places import places
from controller.kiosk.interface import BundleIdentity, DeviceRow, DriftCheck, Grade, Job, KioskState, Place
from controller.kiosk.jobs.job_runner import title_of
from controller.kiosk.service import Service
from controller.kiosk.store import runs
from controller.kiosk.world import World
from controller.run.state_machine import State

GRADES_EVERY_S: Final = 10.0


class Snapshots:
    """Use it only in the reconciler's thread."""

    def __init__(self, stage: Path, world: World) -> None:
        self._stage, self._world = stage, world
        self._grades: tuple[float, tuple[Grade, ...]] = (0.0, ())
        self._bundle: Path | None = None
        self._places: tuple[Place, ...] = ()
        self._drifts: tuple[DriftCheck, ...] = ()
        self._since = ("", 0.0)

    def of(self, service: Service, revision: int) -> KioskState:
        """The state now; the grades come from the disk and may be some seconds old, but not older than the bundle."""
        shown, wanted = service.player.view.shown, service.player.want
        job = self._job(service)
        state, reason = self._state(service, job)
        if self._since[0] != state:
            self._since = (state, self._world.wall())
        bundle = service.bundles.bundle()
        at_s, grades = self._grades
        if self._world.monotonic() - at_s > GRADES_EVERY_S or not at_s or bundle != self._bundle:
            grades = runs.grades(self._stage, service.checked.stage.tables.calibration.worst_grade)
            self._grades, self._bundle = (self._world.monotonic(), grades), bundle
            self._places, self._drifts = places(self._stage), runs.drifts(self._stage)
        index = service.bundles.index(bundle)
        identity = None
        if index is not None and bundle is not None:
            identity = BundleIdentity(index.revision, bundle.stem, float(index.created_unix_s))
        live = service.reconciler.live
        return KioskState(
            revision=revision,
            stage=service.checked.stage.tables.stage.name,
            state=state,
            reason=reason,
            since_unix_s=self._since[1],
            devices=(*service.rows(), self._player_row(service), service.disk.row),
            job=job,
            playing=shown.appearance if shown is not None else "",
            disk_free_bytes=service.disk.free_bytes,
            in_turn=shown is not None and bool(shown.appearance) and bool(wanted is not None and wanted.in_turn),
            next_event=service.reconciler.plan.next,
            bundle=identity,
            lamps=service.lamps,
            grades=grades,
            identifying=service.player.identifying,
            warnings=self._warnings(service),
            failures=service.log.failures,
            places=self._places,
            drifts=self._drifts,
            black=live.black,
            paused=bool(live.held),
            brightness=round(100 * live.brightness, 1),
            dose_klx_h=service.devices.dose_klx_h,
        )

    def _job(self, service: Service) -> Job | None:
        """The job that runs, or waits for its lamps; else the last one."""
        waiting = service.reconciler.waiting
        if waiting is None or not waiting.light:
            return service.jobs.job
        number = waiting.number or service.jobs.number + 1
        return Job(number, title_of(waiting), waits="It starts when the lamps are lit and steady.")

    def _state(self, service: Service, job: Job | None) -> tuple[str, str]:
        """A closed stage that computes is not only closed."""
        machine, request = service.reconciler.machine, service.jobs.running
        if machine.state is not State.OFF or request is None or job is None or job.ended:
            return machine.state.value, machine.reason
        state = State.PUBLISHING if request.kind == "publish" else State.SOLVING
        return state.value, f"{job.name}. The stage is closed, and the lamps are off."

    def _warnings(self, service: Service) -> tuple[str, ...]:
        said = (service.problem, service.player.view.warning, service.bundle_watch.warning)
        return (*service.devices.warnings, *(one.text for one in said if one is not None))

    def _player_row(self, service: Service) -> DeviceRow:
        problem = service.player.view.problem
        what, remedy = (None, "") if problem is None else (problem.reason, problem.remedy)
        return DeviceRow("player", "display", "player", (), what, remedy)
