"""``controller.kiosk.interface.Kiosk`` for a running service, as panel and command line use it."""

from __future__ import annotations

import contextlib
import threading
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from controller.config.models import StageTables
from controller.core.errors import UsageError, WorkError
from controller.core.storage import write_atomically
from controller.kiosk.api import aim, finding
from controller.kiosk.api.control import plain
from controller.kiosk.api.folder import FolderKiosk, appearances_of, projector_picture
from controller.kiosk.api.photograph import newest_photograph
from controller.kiosk.api.snapshot import Snapshots
from controller.kiosk.changes.watch import since_good
from controller.kiosk.decide.changed_hours import effect
from controller.kiosk.decide.interfaces import IN_TURN, Request
from controller.kiosk.interface import (
    Aiming,
    Appearance,
    Changes,
    Comparison,
    EventLevel,
    EventRow,
    Finding,
    Fit,
    FoundDevice,
    Job,
    KioskState,
    LampDay,
    Reach,
    RecalibrationKind,
    Results,
    Schedule,
    TriedDevice,
    Unsubscribe,
)
from controller.kiosk.jobs.job_runner import title_of
from controller.kiosk.operations.accounts import AccountActions
from controller.kiosk.service import Service
from controller.kiosk.store import archive, runs, settings, settings_change, targets
from controller.kiosk.store.accounts import Accounts, stage_accounts
from controller.kiosk.store.event_log import Decision
from controller.kiosk.store.schedule_file import check
from controller.kiosk.world import World
from controller.stage.calibrations import finished_calibration
from controller.stage.check import check_stage

NOTICE_S: Final = 900.0
"""The longest time for a text on the projectors, so that no lamp burns for it all night."""
AIMING_S: Final = 900.0
MOST_UNLOGGED: Final = 200
"""Lines for the event log of a service that does not run yet."""
_REVISIONS: Final = 1_000_000_000


class StageKiosk(FolderKiosk):
    """Operations that are not defined here are those of ``FolderKiosk``.

    It outlives restarts of the service; the service is None while stage.toml is missing or wrong. ``accounts`` are
    shared by panel and socket, and opened at the first use; ``sessions_ended`` is set by a panel. ``reload`` is set
    when the settings have changed: its owner then restarts the service.
    """

    def __init__(self, stage: Path, world: World | None = None) -> None:
        super().__init__(stage)
        self._world = world or World()
        self.reload = self._world.event()
        self.accounts: Accounts | None = None
        self.sessions_ended: Callable[[str], object] = lambda name: None
        self._service: Service | None = None
        self._lock = threading.RLock()
        self._opening_accounts = threading.Lock()
        self._callbacks: list[Callable[[], None]] = []
        self._last = KioskState(
            0, stage.name, "off", "The stage is not set up yet.", self._world.wall(), needs_setup=True
        )
        self._events = 0
        self._snapshots = Snapshots(stage, self._world)
        self._examinations = finding.Examinations(lambda: finding.findings(stage, self._service))
        self._notice: tuple[tuple[str, ...], Callable[[], bool]] | None = None
        self._notice_ends_s = float("inf")
        self._unlogged: deque[Decision] = deque(maxlen=MOST_UNLOGGED)

    def attach(self, service: Service | None, reason: str = "") -> None:
        """Use this service from now on; None with the ``reason`` why there is none."""
        with self._lock:
            self._service = service
            if service is None:
                revision = self._last.revision + 1
                state, why = ("fault", reason) if reason else ("off", "The stage is not set up yet.")
                self._last = KioskState(revision, self.stage.name, state, why, self._world.wall(), needs_setup=True)
            else:
                starts = int(service.log.value("starts") or 0) + 1
                service.log.keep("starts", str(starts))
                self._last = replace(self._last, revision=starts * _REVISIONS)
                service.changed = self._refresh
                while self._unlogged:
                    service.log.add(self._unlogged.popleft())
                self._show_notice()
        self._notify()

    def detach(self) -> None:
        """Stop using the service, which has ended: the next one may have read its files already."""
        self._service = None

    def held_accounts(self) -> Accounts:
        """The one copy that panel and socket share: a second one would overwrite its changes."""
        with self._opening_accounts:
            if self.accounts is None:
                self.accounts = stage_accounts(self.stage)
            return self.accounts

    def holders(self) -> dict[str, Any]:
        """The holders of the socket's operations."""
        return {"kiosk": self, "accounts": AccountActions(self.held_accounts, self._end_sessions)}

    def _end_sessions(self, name: str) -> None:
        # Looked up late, because a panel may be attached after the socket.
        self.sessions_ended(name)

    @property
    def service(self) -> Service:
        """Raises WorkError("not-set-up", "kiosk-restarting")."""
        service = self._service
        if service is None and not self._last.needs_setup:
            raise WorkError("kiosk-restarting", what="The kiosk is restarting.", remedy="Try again in a moment.")
        if service is None:
            raise WorkError("not-set-up", what=self._last.reason, remedy="Set the stage up first.")
        return service

    def announce(self, lines: tuple[str, ...], until: Callable[[], bool]) -> None:
        """Show text on the projectors in turn, with lamps lit, until ``until`` is true or ``NOTICE_S`` have passed.

        Only on a stage without a bundle: the text is for the person who sets it up, not for visitors.
        """
        self._notice = (lines, until)
        self._show_notice()

    def _show_notice(self) -> None:
        service = self._service
        if service is not None and self._notice is not None and service.bundles.bundle() is None:
            service.player.notice = self._notice[0]
            service.reconciler.light_for(NOTICE_S)
            self._notice_ends_s = self._world.monotonic() + NOTICE_S

    def _end_notice(self, service: Service) -> None:
        if self._notice is not None and (self._notice[1]() or self._world.monotonic() > self._notice_ends_s):
            self._notice = None
            service.player.notice = ()
            service.reconciler.light_for(0.0)

    # -- frequent questions

    def snapshot(self) -> KioskState:
        return self._last

    def events(self, after: int = 0) -> Sequence[EventRow]:
        return () if self._service is None else self._service.log.after(after)

    def record(self, code: str, what: str, level: EventLevel = "info") -> None:
        decision = Decision(code, what, "", level)
        with self._lock:
            if self._service is not None:
                self._service.log.add(decision)
            else:
                self._unlogged.append(decision)

    def subscribe(self, callback: Callable[[], None]) -> Unsubscribe:
        with self._lock:
            self._callbacks.append(callback)
        return lambda: self._callbacks.remove(callback) if callback in self._callbacks else None

    def _refresh(self) -> None:
        service = self._service
        if service is None:
            return
        self._end_notice(service)
        now = self._snapshots.of(service, self._last.revision + 1)
        with self._lock:
            # Read once: an event logged between two reads would never be sent to the panel.
            events = service.log.number
            same = replace(now, revision=self._last.revision) == self._last and self._events == events
            self._events = events
            if not same:
                self._last = now
        if not same:
            self._notify()

    def _notify(self) -> None:
        for callback in tuple(self._callbacks):
            callback()

    # -- commands

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
                            remedy="See `velatura events` for the reason, then start it again.")  # fmt: skip
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
        from controller.kiosk.api.reach import reach

        return reach(self.service.checked, target)

    def fitted(self, target: Path, fit: Fit = "fit") -> bytes:
        if fit == "wrap":
            from controller.kiosk.api.wrapped import wrapped

            return wrapped(finished_calibration(self.stage), self.service.checked.names, target)
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
        from controller.blender.run import find_blender
        from controller.kiosk.api.scenes import entry

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

    def doctor(self) -> Sequence[Finding]:
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
                service.cools = settings_change.change(self._in_use, after).lamps
            self.reload.set()

    def diagnostics(self) -> Path:
        return archive.diagnostics(self.stage, {"state": plain(self._last), "events": plain(self.events())})

    def effect_of_settings(self, text: str) -> str:
        settings.validate(text)
        after = settings.tables_of(text)
        return "" if self._service is None else settings_change.change(self._in_use, after).warning(self.stage)

    def save_settings(self, text: str) -> None:
        with self._idle():
            first = not settings.text(self.stage)
            text = settings.with_own_key(self.stage, text) if first else text
            settings.save(self.stage, text, self._world.drivers)
            self.take_over()

    @property
    def _in_use(self) -> StageTables:
        return self.service.checked.stage.tables

    def take_over(self) -> None:
        """Use stage.toml as it is now: at once, or by a restart of what has to be opened again."""
        service = self._service
        if service is None:
            self.reload.set()
            return
        checked = check_stage(self.stage, drivers=self._world.drivers)
        found = settings_change.change(self._in_use, checked.stage.tables)
        if not found.restarts:
            service.use(checked)
            return
        service.cools = found.lamps
        self.reload.set()

    def _idle(self) -> contextlib.AbstractContextManager[None]:
        return contextlib.nullcontext() if self._service is None else self._service.reconciler.idle()

    def camera_picture(self) -> bytes | None:
        return None if self._service is None else aim.camera_picture(self._service.devices)

    def results(self, run: str) -> Results:
        return runs.results(self.stage, run, self.service.checked.stage.tables.calibration.worst_grade)

    def report(self, run: str) -> Path:
        return runs.report(self.stage, run, self.service.checked)

    def aiming(self) -> Aiming:
        return aim.aiming(self.service.checked)

    def test_shots(self) -> Job:
        service, asked = self.service, Request("aim", light=True)
        job = self._begun(service, asked, title_of(asked))
        # Test shots are repeated while aiming; the lamps stay lit between them.
        service.reconciler.light_for(AIMING_S, closed_too=True)
        return job

    def find_devices(self) -> Sequence[FoundDevice]:
        return finding.find(self.stage)

    def try_device(self, key: str) -> TriedDevice:
        return finding.try_device(self.stage, key)
