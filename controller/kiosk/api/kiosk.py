"""``controller.kiosk.interface.Kiosk`` for a running service, as panel and command line use it."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

from controller.config.models import StageTables
from controller.core.errors import UsageError, WorkError
from controller.core.storage import write_atomically
from controller.kiosk.api import aim, finding
from controller.kiosk.api.attached import AttachedKiosk
from controller.kiosk.api.control import plain
from controller.kiosk.api.folder import appearances_of, projector_picture
from controller.kiosk.api.photograph import newest_photograph
from controller.kiosk.changes.watch import since_good
from controller.kiosk.decide.interfaces import Request, title_of
from controller.kiosk.decide.operator_overrides import effect
from controller.kiosk.schedule import check
from controller.kiosk.service import Service
from controller.kiosk.state import Job
from controller.kiosk.store import archive, runs, settings, targets
from controller.kiosk.store.archive import diagnostics
from controller.kiosk.values import (
    IN_TURN,
    Aiming,
    Appearance,
    Changes,
    Comparison,
    Computed,
    Fit,
    FoundDevice,
    LampDay,
    Reach,
    RecalibrationKind,
    Results,
    Schedule,
    TriedDevice,
)
from controller.stage.sessions.check import check_stage
from hal.notices import Notice

LIT_FOR_AIMING_S: Final = 900.0
"""The lamps stay lit for so long after test shots, because the next ones follow soon."""


class StageKiosk(AttachedKiosk):
    """Operations that are not defined here are those of ``FolderKiosk``."""

    def recalibrate(self, kind: RecalibrationKind, projector: str | None = None) -> Job:
        """``projector``: only this one, whatever ``kind``. Raises UsageError("projector-unknown"), WorkError."""
        service = self.service
        if projector is not None and projector not in service.checked.names:
            raise UsageError("projector-unknown", what=f"There is no projector {projector[:64]!r}.",
                             remedy=f"Choose one of {', '.join(service.checked.names)}.")  # fmt: skip
        asked = Request(kind, light=True) if projector is None else Request("projector", True, arguments=(projector,))
        return self._begun(service, asked, title_of(asked))

    def _begun(self, service: Service, asked: Request, name: str) -> Job:
        # Before it is queued, because it may start at once.
        number = service.jobs.reserve()
        service.submit(replace(asked, number=number))
        return Job(number, name)

    def job(self, number: int) -> Job | None:
        """A requested job; None while it waits. Raises WorkError("job-given-up") if it will never start."""
        service = self.service
        # In this order, so that a job that starts between the two calls is not taken for a lost one.
        waits = service.reconciler.waits(number)
        if (job := service.jobs.known(number)) is None and not waits:
            raise WorkError("job-given-up", what="The job will not start: the kiosk cancelled it or restarted.",
                            remedy="See `velatura kiosk events` for the reason, then start it again.")  # fmt: skip
        return job

    def cancel(self) -> None:
        self.service.reconciler.cancel()

    def play(self, name: str, fade_s: float | None = None) -> None:
        service = self.service
        service.bundles.check_name(name)
        service.reconciler.choose(name, fade_s)
        service.reconciler.open()
        service.hurry()

    def rotate(self) -> None:
        service = self.service
        service.reconciler.choose(IN_TURN)
        service.reconciler.open()
        service.hurry()

    def next(self, fade_s: float | None = None) -> None:
        service = self.service
        service.reconciler.next(fade_s)
        service.hurry()

    def black(self, on: bool, fade_s: float | None = None) -> None:
        service = self.service
        service.reconciler.black(on, fade_s)
        service.hurry()

    def pause(self, on: bool) -> None:
        service = self.service
        service.reconciler.pause(on)
        service.hurry()

    def brightness(self, percent: float) -> None:
        service = self.service
        service.reconciler.brighten(percent / 100)
        service.hurry()

    def stop(self) -> None:
        self.service.reconciler.shut()

    def start(self) -> None:
        for supervisor in self.service.devices.projectors:
            supervisor.forgive()
        self.service.reconciler.open()

    def view_px(self) -> tuple[int, int] | None:
        return None if self._service is None else targets.camera_view_px(self.stage, self._service.checked.names)

    def reach(self, target: Path) -> Reach:
        from controller.kiosk.preview.reach import reach

        if self.service.jobs.running is None:
            self._previews.begin(self.service.checked, target)
        return reach(self.service.checked, target)

    def computed(self, target: Path) -> Computed:
        service = self.service
        if (running := service.jobs.running) is not None:
            # Both would need the memory of a whole solve.
            raise WorkError("preview-ended", what=f"{title_of(running)} runs, which may need all of the memory.",
                            remedy="Look at the picture again when the job has ended.")  # fmt: skip
        return self._previews.of(service.checked, target)

    def fitted(self, target: Path, fit: Fit = "fit", points: str = "") -> bytes:
        if fit == "wrap" or fit == "restore":  # noqa: PLR1714 - so a type checker knows what is left
            kind = "photograph" if fit == "wrap" else "restoration"
            return targets.on_object(self.stage, self.service.checked.names, target, kind, points)
        picture, size_px = target.read_bytes(), self.view_px()
        return picture if size_px is None else targets.fitted(picture, size_px, fit)

    def compute(self, name: str, target: Path, fit: Fit = "fit") -> Job:
        service = self.service
        settings.check_name(name)
        picture = self.fitted(target, fit)
        kept = self.stage / "appearances" / f"{name}.png"
        with service.reconciler.idle():
            entry = {"name": name, "kind": "picture", "file": str(kept.relative_to(self.stage))}
            settings.add_appearance(self.stage, entry)
            write_atomically(kept, picture)
            return self._begun(service, Request("compute", arguments=(name,)), "New appearance")

    def compute_scene(self, name: str, scene: str) -> Job:
        from controller.kiosk.preview.scenes import entry
        from controller.stage.blender.run import find_blender

        service = self.service
        settings.check_name(name)
        added = entry(self.stage, name, scene)
        find_blender()
        with service.reconciler.idle():
            settings.add_appearance(self.stage, added)
            return self._begun(service, Request("compute", arguments=(name,)), "New appearance")

    def appearances(self) -> Sequence[Appearance]:
        service = self.service
        return appearances_of(service.bundles, self.comparisons(), service.checked, playing=self._last.playing)

    def projector_picture(self, name: str, projector: str) -> Path | None:
        service = self.service
        return projector_picture(service.bundles, service.checked, name, projector)

    def photograph(self) -> bytes | None:
        service = self.service
        return (
            None
            if service.jobs.running is None
            else newest_photograph(self.stage, self._world.wall(), self._last.since_unix_s)
        )

    def compare(self, name: str | None = None) -> Job:
        service = self.service
        service.bundles.check_name(name)
        asked = Request("compare", light=True, arguments=() if name is None else (name,))
        return self._begun(service, asked, title_of(asked))

    def comparisons(self) -> Sequence[Comparison]:
        return runs.comparisons(self.stage, self.service.bundles.names())

    def remove_appearance(self, name: str) -> None:
        service = self.service
        if (name == self._last.playing and not self._last.in_turn) or name in [
            row.appearance for row in service.schedule.now.rows
        ]:
            raise UsageError("appearance-in-use", what=f"{name} is playing, or it is in the schedule.",
                             remedy="Play another one, and remove it from the schedule.")  # fmt: skip
        with service.reconciler.idle():
            settings.remove_picture(self.stage, name)
            settings.forget_solved(self.stage, name)
            service.submit(Request("publish"))

    def lamp_history(self) -> Sequence[LampDay]:
        return () if self._service is None else self._service.lamp_history.days()

    def schedule(self) -> Schedule:
        return Schedule("UTC") if self._service is None else self._service.schedule.now

    def set_schedule(self, schedule: Schedule) -> None:
        self.service.schedule.replace(schedule, self.service.bundles.names())

    def effect_of_schedule(self, schedule: Schedule) -> str:
        service = self.service
        check(schedule, service.bundles.names())
        return effect(schedule, service.reconciler.overrides, service.reconciler.plan, self._world.wall())

    def identify(self, on: bool) -> None:
        self.service.player.identifying = on
        with self._lock:
            # At once: the browser loads the next page before the service's next step.
            self._last = replace(self._last, identifying=on, revision=self._last.revision + 1)
        self._notify()

    def seen(self, number: int | None = None) -> None:
        log = self.service.log
        log.seen(log.number if number is None else number)
        with self._lock:
            self._last = replace(self._last, failures=log.failures, revision=self._last.revision + 1)
        self._notify()

    def doctor(self) -> Sequence[Notice]:
        return self._examinations.findings()

    def changes(self) -> Changes:
        service = self._service
        return super().changes() if service is None else since_good(self.stage, service.inventory())

    def test_alerts(self) -> None:
        self.service.alerts.test()

    def test_backup(self) -> None:
        self.service.backups.now()

    def restore(self, backup: Path) -> None:
        with self._idle():
            archive.restore(self.stage, backup)
            service = self._service
            if service is not None:
                after = check_stage(self.stage, drivers=self._world.drivers).stage.tables
                service.cools_at_end = settings.change(self._in_use, after).lamps
            self.reload.set()

    def diagnostics(self) -> Path:
        return diagnostics(self.stage, {"state": plain(self._last), "events": plain(self.events())})

    def effect_of_settings(self, text: str) -> str:
        settings.validate(text)
        after = settings.tables_of(text)
        return "" if self._service is None else settings.change(self._in_use, after).warning(self.stage)

    def save_settings(self, text: str) -> None:
        with self._idle():
            first = not settings.text(self.stage)
            text = settings.with_own_key(self.stage, text) if first else text
            settings.save(self.stage, text, self._world.drivers)
            self.take_over()

    @property
    def _in_use(self) -> StageTables:
        return self.service.tables

    def take_over(self) -> None:
        """Use stage.toml as it is now: at once, or by a restart of what has to be opened again."""
        service = self._service
        if service is None:
            self.reload.set()
            return
        checked = settings.checked_settings(self.stage, self._world.drivers)
        found = settings.change(self._in_use, checked.stage.tables)
        if not found.restarts:
            service.use(checked)
            return
        service.cools_at_end = found.lamps
        self.reload.set()

    def _idle(self) -> contextlib.AbstractContextManager[None]:
        return contextlib.nullcontext() if self._service is None else self._service.reconciler.idle()

    def camera_picture(self) -> bytes | None:
        return None if self._service is None else aim.camera_picture(self._service.devices)

    def results(self, run: str) -> Results:
        return runs.results(self.stage, run, self.service.tables.calibration.worst_grade)

    def report(self, run: str) -> Path:
        return runs.report(self.stage, run, self.service.checked)

    def aiming(self) -> Aiming:
        return aim.aiming(self.service.checked)

    def test_shots(self) -> Job:
        service, asked = self.service, Request("aim", light=True)
        job = self._begun(service, asked, title_of(asked))
        service.reconciler.light_for(LIT_FOR_AIMING_S, closed_too=True)
        return job

    def find_devices(self) -> Sequence[FoundDevice]:
        return finding.find(self.stage)

    def try_device(self, key: str) -> TriedDevice:
        return finding.try_device(self.stage, key)
