"""The kiosk's service: makes the conductor and every keeper from a stage, and runs each in a thread of its own."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from datetime import date
from functools import partial
from pathlib import Path
from typing import Final

from controller.core import kiosk_places
from controller.core.errors import UsageError, WorkError
from controller.core.storage import runtime_folder
from controller.kiosk.decide.clock import Clockwork, beginning
from controller.kiosk.decide.interfaces import BLACK, Condition, Request
from controller.kiosk.decide.reconciler import Conductor, Limits
from controller.kiosk.interface import DeviceRow, Lamp
from controller.kiosk.jobs.job_handlers import Kinds
from controller.kiosk.jobs.job_runner import ThreadWorks
from controller.kiosk.store import archive
from controller.kiosk.store.bundle_store import BundleStock
from controller.kiosk.store.event_log import Decision, EventLog
from controller.kiosk.store.photo_retention import TIDY_S, forget_old_photographs
from controller.kiosk.store.schedule_file import ScheduleFile
from controller.kiosk.supervisors.devices import Devices
from controller.kiosk.supervisors.keys_supervisor import KeysKeeper
from controller.kiosk.supervisors.lamp_history import LampHistory
from controller.kiosk.supervisors.player_supervisor import PlayerKeeper
from controller.play.control.attached import AttachedPlayer
from controller.play.control.launch import PlayerSettings
from controller.run.state_machine import State
from controller.stage.calibrations import finished_calibrations, stage_trust
from controller.stage.check import Checked, check_stage
from controller.stage.open import player_settings, technicians_panel
from controller.stage.run import stage_lock
from hal.deadline import in_seconds
from hal.interfaces import ButtonPanel

STEP_S: Final = 0.25
LOOK_S: Final = 1.0
END_WORK_S: Final = 30.0
AFTER_CRASH_S: Final = 5.0


class Service:
    """One stage that runs by itself. ``changed`` is called after every step that may have changed something, ``alive``
    by the loop as long as it turns.
    """

    def __init__(self, checked: Checked, log: EventLog) -> None:
        stage = checked.stage
        self.checked, self.log, self.stage = checked, log, stage.folder
        self.runtime = runtime_folder(stage.folder)
        self.stock = BundleStock(stage.folder, stage_trust(stage))
        self.schedule = ScheduleFile(stage.folder, stage.tables.schedule)
        attach = partial(AttachedPlayer, kiosk_places.PLAYER_SOCKET, kiosk_places.PLAYER_OPTIONS)
        installed = kiosk_places.is_installed(stage.folder)
        self.player = PlayerKeeper(self.runtime, self._settings, log.tell, attach=attach if installed else None)
        self.alive: Callable[[], None] = lambda: None
        self.devices = Devices(checked, self.runtime, log.tell)
        self.devices.scene = self._scene
        self.lamp_history = LampHistory(stage.folder)
        kinds = Kinds(
            stage.folder, self.devices.lent, missing_device=self.devices.missing_for_work, calibrated=self._calibrated,
            open_now=lambda: bool(self.schedule.now.rows) and self.conductor.plan.open is True,
        )  # fmt: skip
        self.works = ThreadWorks(kinds.table(), log, number=int(log.value("job") or 0))
        safety = stage.tables.safety
        self.conductor = Conductor(
            self.devices.projectors, self.player, self.works, self.stock, log,
            schedule=lambda: self.schedule.now,
            clock=Clockwork(log, time.time, time.monotonic),
            monotonic=time.monotonic,
            without_time=self.schedule.open_without_time,
            limits=Limits(safety.power_up_s, max(900.0, 10 * safety.power_down_s)),
        )  # fmt: skip
        self.changed: Callable[[], None] = lambda: None
        self._stop = threading.Event()
        self._threads: list[threading.Thread] = []
        self.keys = self._keys_keeper()
        self._known_runs: tuple[float, bool] = (0.0, False)

    def start(self) -> None:
        """Begin: the player first, so that there are pictures before any device has answered."""
        self.log.tell(beginning(self.log))
        if self.schedule.problem is not None:
            problem = self.schedule.problem
            self.log.tell(Decision(problem.code, problem.what, problem.remedy, "error"))
        self.conductor.step()
        self._thread("player", self.player.step, STEP_S)
        for projector in self.devices.projectors:
            self._thread(f"projector {projector.name}", projector.step, LOOK_S)
        for keeper in self.devices.others:
            self._thread(keeper.name, keeper.step, STEP_S)
        if self.keys is not None:
            self._thread("keys", self.keys.step, 2.0)
        forget_old = partial(forget_old_photographs, self.stage, self.log, time.time)
        self._thread("old photographs", forget_old, TIDY_S, first_s=TIDY_S)

    def run(self, cancel: threading.Event) -> None:
        """Decide, over and over, until ``cancel``."""
        while not cancel.is_set():
            try:
                self._decide()
            except Exception as error:  # noqa: BLE001 - the last boundary of this thread: told, and it goes on
                # Not alive, for systemd's watchdog: what lasts is mended by a new start.
                what = f"The conductor met an error that Velatura does not know ({type(error).__name__}: {error})."
                self.log.tell(Decision("crash", what, "Export the diagnostics.", "error"))
                cancel.wait(AFTER_CRASH_S)
                continue
            self.alive()
            cancel.wait(STEP_S)

    def _decide(self) -> None:
        self.conductor.step()
        if self.devices.mains is not None:
            self.devices.mains.want_on = self._light_wanted()
        if self.works.number:
            self.log.keep("job", str(self.works.number))
        self.lamp_history.note(self.lamps, date.today())
        self.changed()

    def end(self, *, leave_lit: bool) -> None:
        """Stop the work, cool the lamps (unless they are to stay lit for the next start), and let go of everything."""
        self.works.close(END_WORK_S)
        if not leave_lit:
            self.player.want = BLACK
            for projector in self.devices.projectors:
                projector.want_lit = False
            self._wait_until_dark()
        self._stop.set()
        for thread in self._threads:
            thread.join(5.0)
        if self.keys is not None:
            self.keys.close()
        self.lamp_history.note(self.lamps, date.today(), now=True)
        self.player.close()
        self.devices.close()
        self.log.tell(Decision("service-ended", "The kiosk ends."))

    def rows(self) -> tuple[DeviceRow, ...]:
        """Every device as the panel shows it."""
        return (*self.devices.rows(), *(() if self.keys is None else (self.keys.row,)))

    def ask(self, *requests: Request) -> None:
        self.conductor.ask(*requests)

    # -- inside

    def _settings(self, with_bundle: bool) -> PlayerSettings:
        return player_settings(self.checked.stage, self.runtime, plays=with_bundle)

    @property
    def lamps(self) -> tuple[Lamp, ...]:
        views = [keeper.view for keeper in self.devices.projectors]
        return tuple(Lamp(one.name, one.hours, one.strikes, one.condition is Condition.LIT) for one in views)

    def _scene(self) -> str | None:
        """What has lit the object since a while, for the light sensor."""
        shown = self.player.view.shown
        if self.conductor.machine.state not in (State.PLAYING, State.DEGRADED) or shown is None or not shown.appearance:
            return None
        views = [keeper.view for keeper in self.devices.projectors]
        if any(view.coming or (view.shines and view.stable_left_s > 0) for view in views):
            return None
        lit = " ".join(view.name for view in views if view.shines)
        return f"{shown.bundle} {shown.appearance} {lit}"

    def _calibrated(self) -> bool:
        # Asked four times a second while a task is due; opening every journal each time would be a waste.
        at_s, found = self._known_runs
        if time.monotonic() - at_s > 5.0 or not at_s:
            found = bool(finished_calibrations(self.stage))
            self._known_runs = time.monotonic(), found
        return found

    def _light_wanted(self) -> bool:
        machine = self.conductor.machine.state
        return machine not in (State.OFF, State.COOLING) or any(one.want_lit for one in self.devices.projectors)

    def _wait_until_dark(self) -> None:
        until_s = time.monotonic() + self.checked.stage.tables.safety.power_down_s
        while any(one.may_light for one in self.devices.projectors) and time.monotonic() < until_s:
            self.alive()
            time.sleep(0.1)
        names = [one.name for one in self.devices.projectors if one.view.maybe_lit]
        if names:
            self.log.tell(Decision("lamp-still-lit", f"The lamp of {', '.join(names)} could not be switched off.",
                                   "Switch it off by its remote control.", "error"))  # fmt: skip

    def _thread(self, name: str, step: Callable[[], None], every_s: float, *, first_s: float = 0.0) -> None:
        def loop() -> None:
            self._stop.wait(first_s)
            while not self._stop.is_set():
                try:
                    step()
                except Exception as error:  # noqa: BLE001 - the last boundary of this thread: told, and it goes on
                    what = f"{name} met an error that Velatura does not know ({type(error).__name__}: {error})."
                    self.log.tell(Decision("crash", what, "Export the diagnostics.", "error"))
                    self._stop.wait(AFTER_CRASH_S)
                self._stop.wait(every_s)

        thread = threading.Thread(target=loop, name=name, daemon=True)
        self._threads.append(thread)
        thread.start()

    def _keys_keeper(self) -> KeysKeeper | None:
        table = self.checked.stage.tables.key_panel
        if table is None:
            return None

        @contextlib.contextmanager
        def opened() -> Iterator[ButtonPanel]:
            with technicians_panel(self.checked, deadline=in_seconds(20.0)) as panel:
                assert panel is not None
                yield panel

        presses = (self.conductor.open, self.conductor.shut, self._recalibrate)
        return KeysKeeper(table.driver, opened, presses, lambda: self.conductor.machine.state, self.log.tell)

    def _recalibrate(self) -> None:
        # A refusal is in the log; the key has nothing to show it on.
        with contextlib.suppress(WorkError):
            self.conductor.ask(Request("quick", light=True))


@contextlib.contextmanager
def serving(
    stage: Path, cancel: threading.Event, *, leave_lit: bool = False, alive: Callable[[], None] = lambda: None
) -> Iterator[Service]:
    """A started service, its loop in a thread; ended, with the lamps cooled, on leaving. ``alive``: as ``Service``'s.

    Raises what ``check_stage`` raises, UsageError("already-running"), and UsageError("display-plays-no-bundles").
    """
    if (stage / archive.RESTORING).exists():
        with stage_lock(stage):
            archive.finish_restore(stage)
    checked = check_stage(stage)
    if checked.stage.tables.display.driver != "player":
        raise UsageError(
            "display-plays-no-bundles",
            what="A kiosk needs the player as its display.",
            remedy='Use the driver "player" under [display] in stage.toml.',
        )
    with stage_lock(checked.stage.folder):
        archive.clear_cut_off(checked.stage.folder)
        log = EventLog(checked.stage.folder / EventLog.FILE)
        with contextlib.closing(log):
            service = Service(checked, log)
            service.alive = alive
            ended = threading.Event()
            loop = threading.Thread(target=service.run, args=(ended,), name="conductor", daemon=True)
            try:
                service.start()
                loop.start()
                yield service
            finally:
                ended.set()
                if loop.is_alive():
                    loop.join(10.0)
                service.end(leave_lit=leave_lit)
