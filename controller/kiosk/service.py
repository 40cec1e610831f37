"""The kiosk's service: makes the reconciler and all supervisors of a stage, and runs each in its own thread."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Final

from controller.bundle.install import of_other_format
from controller.config.models import StageTables
from controller.core import kiosk_places
from controller.core.errors import SEND_DIAGNOSTICS, WorkError
from controller.core.storage import runtime_folder
from controller.kiosk.alerts import Alerts
from controller.kiosk.backup import NightlyBackup
from controller.kiosk.changes.inventory import Inventory
from controller.kiosk.changes.watch import InventoryWatch
from controller.kiosk.decide.clock import Timetable, TrustedClock, beginning
from controller.kiosk.decide.interfaces import BLACK, DISK_FULL, Condition, Request, title_of
from controller.kiosk.decide.reconciler import Reconciler
from controller.kiosk.decide.stage_states import Limits
from controller.kiosk.jobs.job_handlers import JobHandlers
from controller.kiosk.jobs.job_runner import JobHandler, JobRunner
from controller.kiosk.schedule import ScheduleFile
from controller.kiosk.state import DeviceRow, Lamp
from controller.kiosk.store.bundle_store import BundleStore, BundleWatch
from controller.kiosk.store.disk_space import TIDY_S, purge_old_photographs
from controller.kiosk.store.event_log import EventLog
from controller.kiosk.store.settings import GoodSettings
from controller.kiosk.supervisors.devices import Devices
from controller.kiosk.supervisors.disk_supervisor import DiskSupervisor
from controller.kiosk.supervisors.keys_supervisor import KeysSupervisor
from controller.kiosk.supervisors.light_records import LampHistory
from controller.kiosk.supervisors.player_supervisor import PlayerSupervisor
from controller.kiosk.supervisors.projector_supervisor import ProjectorSupervisor
from controller.kiosk.world import Thread, World
from controller.play.control.launch import AttachedPlayer, PlayerSettings
from controller.run.state_machine import State
from controller.stage.sessions.calibrations import finished_calibrations, stage_trust
from controller.stage.sessions.check import Checked
from controller.stage.sessions.open import player_settings, technicians_panel
from hal.interfaces import ButtonPanel
from hal.notices import Level, Notice

STEP_S: Final = 0.25
LOOK_S: Final = 1.0
DISK_S: Final = 5.0
BACKUP_S: Final = 20.0
INVENTORY_S: Final = 30.0
END_WORK_S: Final = 30.0
AFTER_CRASH_S: Final = 5.0

MakeJobs = Callable[[JobHandlers], Mapping[str, JobHandler]]


class Service:
    """One stage that runs by itself. ``changed`` is called after every step that may have changed something, ``alive``
    by the loop as long as it turns.

    ``problem``: why it runs with older settings than those of stage.toml, or None. ``cools_at_end``: the projectors
    whose lamps are switched off at its end; None: all. ``world``: clock, threads and all else outside; ``jobs`` makes
    the handlers of all kinds of jobs.
    """

    def __init__(
        self, checked: Checked, log: EventLog, problem: Notice | None = None, world: World | None = None,
        jobs: MakeJobs = JobHandlers.table,
    ) -> None:  # fmt: skip
        stage, world = checked.stage, world or World()
        self._world, self.problem = world, problem
        self.cools_at_end: tuple[str, ...] | None = None
        self.checked, self.log, self.stage = checked, log, stage.folder
        self.runtime = runtime_folder(stage.folder)
        self.alive: Callable[[], None] = lambda: None
        self.changed: Callable[[], None] = lambda: None
        self.good_settings = GoodSettings()
        self._stop = world.event()
        self._threads: list[Thread] = []
        self._known_runs: tuple[float, bool] = (0.0, False)
        self._asked, self._decided = world.event(), world.event()
        # In this order: what is kept on disk, the devices, the jobs that use them, and what directs all of them.
        self.bundles = BundleStore(stage.folder, stage_trust(stage), world.monotonic)
        self.schedule = ScheduleFile(stage.folder, stage.tables.schedule)
        self.lamp_history = LampHistory(stage.folder, monotonic=world.monotonic)
        self.bundle_watch = BundleWatch(self.bundles, log.add)
        self.player = self._player_supervisor(world)
        self.devices = Devices(checked, self.runtime, self._tell, world)
        self.devices.scene = self._scene
        self.jobs = self._job_runner(jobs, world)
        self.reconciler = self._reconciler(world)
        self.keys = self._keys_supervisor()
        self._keep_house(world)

    def _player_supervisor(self, world: World) -> PlayerSupervisor:
        attach = partial(AttachedPlayer, kiosk_places.PLAYER_SOCKET, kiosk_places.PLAYER_OPTIONS)
        return PlayerSupervisor(
            self.runtime, self._settings, self.log.add, monotonic=world.monotonic,
            attach=attach if kiosk_places.is_installed(self.stage) else None,
            launch=world.launch, channel=world.channel(),
        )  # fmt: skip

    def _job_runner(self, jobs: MakeJobs, world: World) -> JobRunner:
        handlers = JobHandlers(
            self.stage, self.devices.lent, missing_device=self._missing_for_work, calibrated=self._calibrated,
            open_now=self._open_now,
        )  # fmt: skip
        return JobRunner(jobs(handlers), self.log, number=int(self.log.value("job") or 0), world=world)

    def _reconciler(self, world: World) -> Reconciler:
        safety = self.tables.safety
        clock = TrustedClock(self.log, world.wall, world.monotonic, world.synchronised)
        return Reconciler(
            self.devices.projectors, self.player, self.jobs, self.bundles, self.log, Timetable(self.schedule, clock),
            Limits(safety.power_up_s, max(900.0, 10 * safety.power_down_s)),
        )  # fmt: skip

    def _keep_house(self, world: World) -> None:
        """Make what works beside the stage. Settings are asked for each time: ``use`` replaces them."""
        stage, log = self.stage, self.log
        self.disk = DiskSupervisor(
            stage, lambda: self.tables.disk, self.bundles, log, busy=self._busy, world=world
        )  # fmt: skip
        self.backups = NightlyBackup(
            stage, lambda: self.tables.backup, lambda: self.schedule.now.time_zone, log, busy=self._busy,
            wall=world.wall,
        )  # fmt: skip
        self.inventories = InventoryWatch(
            stage, self.inventory, lambda: self.tables.calibration.worst_grade, log, busy=self._busy, wall=world.wall,
        )  # fmt: skip
        self.alerts = Alerts(
            stage, lambda: self.tables.stage.name, lambda: self.tables.alerts, log, monotonic=world.monotonic,
            wall=world.wall, ways=world.ways_out,
        )  # fmt: skip

    @property
    def tables(self) -> StageTables:
        """The settings in use."""
        return self.checked.stage.tables

    def _busy(self) -> bool:
        return self.jobs.running is not None

    def _open_now(self) -> bool:
        """Whether opening hours keep the stage open now."""
        return bool(self.schedule.now.rows) and self.reconciler.plan.open is True

    def hurry(self) -> None:
        """Decide now, and let the player follow: a person waits for what was asked."""
        self._asked.set()

    def start(self) -> None:
        """Start; the player first, so that it shows pictures before any device has answered."""
        self.log.add(beginning(self.log))
        if self.schedule.problem is not None:
            problem = self.schedule.problem
            self.log.add(Notice(problem.code, problem.what, problem.remedy, Level.ERROR))
        if self.problem is not None:
            self.log.add(self.problem)
        self._go_on()
        if of_other_format(self.stage / "bundles"):
            self._make_bundle_again()
        self.reconciler.step()
        self._thread("player", self.player.step, STEP_S, sooner=self._decided)
        self._thread("bundles", self.bundle_watch.step, LOOK_S)
        self._thread("disk", self._watch_disk, DISK_S)
        self._thread("alerts", self.alerts.step, LOOK_S)
        self._thread("backups", self.backups.step, BACKUP_S)
        self._thread("inventories", self.inventories.step, INVENTORY_S, first_s=INVENTORY_S)
        for projector in self.devices.projectors:
            self._thread(f"projector {projector.name}", projector.step, LOOK_S)
        for supervisor in self.devices.others:
            self._thread(supervisor.name, supervisor.step, STEP_S)
        if self.keys is not None:
            self._thread("keys", self.keys.step, 2.0)
        purge_old = partial(purge_old_photographs, self.stage, self.log, self._world.wall)
        self._thread("old photographs", purge_old, TIDY_S, first_s=TIDY_S)

    def run(self, cancel: threading.Event) -> None:
        """Decide, over and over, until ``cancel``."""
        while not cancel.is_set():
            hurried = self._asked.is_set()
            self._asked.clear()
            try:
                self._decide()
            except Exception as error:  # noqa: BLE001 - the last boundary of this thread: it reports and continues
                # The watchdog is not fed, so systemd restarts the service if the error persists.
                what = f"The kiosk met an unexpected error ({type(error).__name__}: {error})."
                self.log.add(Notice("crash", what, SEND_DIAGNOSTICS, Level.ERROR))
                cancel.wait(AFTER_CRASH_S)
                continue
            if hurried:
                self._decided.set()
            self.alive()
            self._asked.wait(STEP_S)

    def _decide(self) -> None:
        self.reconciler.step()
        if self.devices.mains is not None:
            self.devices.mains.want_on = self._light_wanted()
        if self.jobs.number:
            self.log.keep("job", str(self.jobs.number))
        self.lamp_history.note(self.lamps, self._world.today())
        self.changed()

    def end(self, *, leave_lit: bool) -> None:
        """Cancel the job, cool the lamps (unless ``leave_lit``, for the next start), and close everything."""
        self.jobs.close(END_WORK_S)
        cooled = [one for one in self.devices.projectors if self.cools_at_end is None or one.name in self.cools_at_end]
        if cooled and not leave_lit:
            if self.cools_at_end is None:
                self.player.want = BLACK
            for projector in cooled:
                projector.want_lit = False
            self._wait_until_dark(cooled)
        self._stop.set()
        for thread in self._threads:
            thread.join(5.0)
        if self.keys is not None:
            self.keys.close()
        self.lamp_history.note(self.lamps, self._world.today(), now=True)
        self.player.close()
        self.devices.close()
        self.log.add(Notice("service-ended", "The kiosk has stopped."))

    def use(self, checked: Checked) -> None:
        """Use settings that differ only in what no device depends on (``store.settings.change``)."""
        self.checked, self.problem = checked, None
        self.devices.use(checked)
        self.good_settings.keep(checked)

    def rows(self) -> tuple[DeviceRow, ...]:
        """Every device as the panel shows it."""
        return (*self.devices.rows(), *(() if self.keys is None else (self.keys.row,)))

    def inventory(self, run: str = "") -> Inventory:
        """What the kiosk consists of now; ``run``: what graded well before. Seconds."""
        return self._world.inventory(self.stage, self.tables, self.devices.facts(), run)

    def submit(self, *requests: Request) -> None:
        self.reconciler.submit(*requests)

    # -- inside

    def _watch_disk(self) -> None:
        self.disk.step()
        self.good_settings.step()

    def _go_on(self) -> None:
        for request, again in self.reconciler.go_on():
            what = f"{title_of(request)} was cut off when the kiosk ended."
            if again:
                self.log.add(Notice("work-cut-off", what, "It is done again.", Level.WARNING))
            else:
                remedy = "Start it again: it continues where it stopped."
                self.log.add_failure(Notice("work-cut-off", what, remedy, Level.ERROR))

    def _make_bundle_again(self) -> None:
        """After the way back from a newer version: its bundle can't be read, but the solved frames can."""
        text = "The installed bundle has the format of another version of Velatura, so it is made again."
        self.log.add(Notice("bundle-other-format", text, level=Level.WARNING))
        # The reason of a refusal is in the log.
        with contextlib.suppress(WorkError):
            self.submit(Request("publish"))

    def _tell(self, notice: Notice) -> None:
        """A device's event. That nothing can be written is one event, not one of each device."""
        if notice.code == DISK_FULL:
            self.disk.suspect(notice)
        else:
            self.log.add(notice)

    def _settings(self, with_bundle: bool) -> PlayerSettings:
        return player_settings(self.checked.stage, self.runtime, plays=with_bundle)

    @property
    def lamps(self) -> tuple[Lamp, ...]:
        views = [supervisor.view for supervisor in self.devices.projectors]
        return tuple(Lamp(view.name, view.hours, view.strikes, view.condition is Condition.LIT) for view in views)

    def _scene(self) -> str | None:
        """What has lit the object long enough for the light sensor, or None."""
        shown = self.player.view.shown
        state = self.reconciler.machine.state
        if state not in (State.PLAYING, State.DEGRADED) or shown is None or not shown.appearance:
            return None
        if shown.brightness < 1:
            return None
        views = [supervisor.view for supervisor in self.devices.projectors]
        if any(view.coming or (view.shines and view.stable_left_s > 0) for view in views):
            return None
        lit = " ".join(view.name for view in views if view.shines)
        return f"{shown.bundle} {shown.appearance} {lit}"

    def _missing_for_work(self) -> Notice | None:
        """The device that photographs need and that is missing, or None."""
        problem = self.player.view.outputs
        if problem is not None:
            return replace(problem, what=f"No photographs are possible without it. {problem.what}")
        return self.devices.missing_for_work()

    def _calibrated(self) -> bool:
        # Called four times a second while a task is due, so the journals are not opened each time.
        at_s, calibrated = self._known_runs
        if self._world.monotonic() - at_s > 5.0 or not at_s:
            calibrated = bool(finished_calibrations(self.stage))
            self._known_runs = self._world.monotonic(), calibrated
        return calibrated

    def _light_wanted(self) -> bool:
        machine = self.reconciler.machine.state
        return machine not in (State.OFF, State.COOLING) or any(
            projector.want_lit for projector in self.devices.projectors
        )

    def _wait_until_dark(self, projectors: Sequence[ProjectorSupervisor]) -> None:
        until_s = self._world.monotonic() + self.tables.safety.power_down_s
        while any(one.may_light for one in projectors) and self._world.monotonic() < until_s:
            self.alive()
            self._world.sleep(0.1)
        names = [projector.name for projector in projectors if projector.view.maybe_lit]
        if names:
            self.log.add(Notice("lamp-still-lit", f"The lamp of {', '.join(names)} could not be switched off.",
                                   "Switch it off with its remote control.", Level.ERROR))  # fmt: skip

    def _thread(
        self, name: str, step: Callable[[], None], every_s: float, *, first_s: float = 0.0,
        sooner: threading.Event | None = None,
    ) -> None:  # fmt: skip
        def loop() -> None:
            self._stop.wait(first_s)
            while not self._stop.is_set():
                try:
                    step()
                except Exception as error:  # noqa: BLE001 - the last boundary of this thread: it reports and continues
                    what = f"{name} met an unexpected error ({type(error).__name__}: {error})."
                    self.log.add(Notice("crash", what, SEND_DIAGNOSTICS, Level.ERROR))
                    self._stop.wait(AFTER_CRASH_S)
                (sooner or self._stop).wait(every_s)
                if sooner is not None:
                    sooner.clear()

        thread = self._world.thread(loop, name)
        self._threads.append(thread)
        thread.start()

    def _keys_supervisor(self) -> KeysSupervisor | None:
        table = self.tables.key_panel
        if table is None:
            return None

        @contextlib.contextmanager
        def opened() -> Iterator[ButtonPanel]:
            with technicians_panel(self.checked, deadline=self._world.deadline(20.0)) as panel:
                assert panel is not None
                yield panel

        presses = (self.reconciler.open, self.reconciler.shut, self._recalibrate)
        return KeysSupervisor(table.driver, opened, presses, lambda: self.reconciler.machine.state, self.log.add)

    def _recalibrate(self) -> None:
        try:
            self.reconciler.submit(Request("quick", light=True))
        except WorkError as error:
            # A key can't show it.
            self.log.add(Notice("refused", f"Key panel: Quick recalibration. Refused: {error.what}", "", Level.WARNING))
