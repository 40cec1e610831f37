"""One life of a simulated kiosk: its service is started, incidents come from outside, and monitors check it."""

from __future__ import annotations

import contextlib
import hashlib
import heapq
import itertools
import os
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Final

from controller.core.errors import VelaturaError
from controller.kiosk.api.kiosk import StageKiosk
from controller.kiosk.decide.interfaces import Condition
from controller.kiosk.operations.dispatch import socket_table
from controller.kiosk.service import Service
from controller.kiosk.serving import serving
from controller.kiosk.store.event_log import EventLog
from controller.kiosk.values import Schedule, ScheduleRow
from controller.run.state_machine import State
from hal.deadline import Stop
from hal.errors import CodedError, DeviceError
from lab.simulate.disk import STAGE, watched
from lab.simulate.jobs import SimulatedJobs
from lab.simulate.monitors.expectation import Calendar
from lab.simulate.monitors.invariants import Violation
from lab.simulate.monitors.monitor import KioskMonitor, check_restart
from lab.simulate.scenarios import injection
from lab.simulate.scenarios.commands import arguments_of, expect, unknown_outcome_if_killed, verify_doubtful_hours
from lab.simulate.scenarios.generator import random_scenario, random_site
from lab.simulate.scenarios.scenario import Incident, Site
from lab.simulate.scheduler import DAY_S, STACK_BYTES, Event, Program
from lab.simulate.stage import make_stage, write_log
from lab.simulate.world import SimulatedWorld

LIFE_DAYS: Final = 14.0
AGAIN_S: Final = 5.0
CALM: Final = (8.0, 32.0, 480.0, 7200.0)
"""How far pauses are stretched: while lamps come, while work or cooling takes its time, while something is wrong, and
while all is well.
"""
CALMER: Final = 3.0
END_S: Final = 150.0
SERVES_S: Final = 60.0
RENEWS_S: Final = 2 * SERVES_S
"""The same with saved settings, for which a service ends first: lamps go off, at projectors that may not answer."""
KEEPS_S: Final = 30.0
LOOKS_S: Final = 60.0
WAITS_S: Final = DAY_S
GOOD: Final = "kiosk/stage.toml.good"


class Halt(Event, Stop):
    """A request to the service to end."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """The result of a life at ``site``.

    ``violated``: the name of the violated invariant, and ``violation``: how, "" if all held;
    ``digest``: of every line of its event log.
    """

    seed: str
    days: float
    site: Site
    incidents: tuple[Incident, ...]
    digest: str
    violated: str = ""
    violation: str = ""
    at_s: float = 0.0
    events: int = 0
    took_s: float = 0.0
    minutes: dict[str, float] = field(default_factory=dict)
    last: tuple[str, ...] = ()


class Life:
    """``incidents``: the scenario, and ``site``: where it happens; None: drawn from the seed.

    ``days``: for so long, less if an invariant is violated.
    """

    def __init__(
        self, seed: str, days: float = LIFE_DAYS, incidents: Sequence[Incident] | None = None, site: Site | None = None
    ) -> None:
        self.seed, self.days = seed, days
        self.incidents = tuple(random_scenario(seed, days) if incidents is None else incidents)
        self.site = random_site(seed) if site is None else site
        self.world = SimulatedWorld(seed, self.site.begins_unix_s)
        self.world.is_small = self.site.is_small
        for line in self.world.lines.values():
            line.lingers_s = self.site.lingers_s
        self.monitor = KioskMonitor(self.world, Calendar(self.site.zone, self.site.rows))
        self.program: Program | None = None
        self.kiosk: StageKiosk | None = None
        self.service: Service | None = None
        self.stop = Halt(self.world.scheduler)
        self.news = Event(self.world.scheduler)
        self.violation: Exception | None = None
        self.restart_in_s: float | None = None
        self.damaged: set[str] = set()
        self.unreadable: set[str] = set()
        self.originals: dict[str, bytes] = {}
        """The content of damaged files, which people write again later."""
        self.repaired_s, self.renewed_s = 0.0, -1e9
        self.doubtful_hours: Incident | None = None
        self._keep_by_s: float | None = None
        self._looked_s = 0.0
        self._order = itertools.count()
        self._waiting: list[Incident] = []
        """Incidents that wait for an event."""
        self.monitor.log.on_event = self._on_event
        self._repairs: list[tuple[float, int, Callable[[], None]]] = []
        self._last: tuple[Any, ...] = ()

    # -- living

    def run(self) -> Outcome:
        began_s = time.process_time()
        with _one_core(), _folder() as here, watched(self.world.disk):
            # It has another name each time, and the kiosk names files of which its disk takes no more.
            self.monitor.log.here = f"{here}/"
            rows = tuple(ScheduleRow(row["day"], row["opens"], row["closes"]) for row in self.site.rows)
            make_stage(STAGE, Schedule(self.site.zone, rows, self.site.drift_check), self.site.bundles)
            self.monitor.log.preload(write_log(STAGE, self.site.logged, self.site.begins_unix_s))
            self.world.scheduler.on_kill = self.news.set
            self.boot()
            try:
                self._pass()
                self._ends()
            except Violation as error:
                self.violation = self.violation or error
            finally:
                self.end_of_program()
        if self.violation is not None and not isinstance(self.violation, Violation):
            raise self.violation
        monitor = self.monitor
        text = "\n".join(monitor.log.digested)
        lamps = " ".join(f"{name} {lamp.strikes} {lamp.off_at_s!r}" for name, lamp in self.world.lamps.items())
        violation = self.violation
        return Outcome(
            self.seed, self.days, self.site, self.incidents, hashlib.sha256(f"{text}\n{lamps}".encode()).hexdigest(),
            "" if violation is None else violation.invariant, "" if violation is None else str(violation),
            self.world.scheduler.now_s, len(monitor.log.digested), time.process_time() - began_s, monitor.minutes,
            tuple(monitor.log.digested[-30:]),
        )  # fmt: skip

    def _pass(self) -> None:
        scheduler, left = self.world.scheduler, list(self.incidents)
        while scheduler.now_s < self.days * DAY_S and self.violation is None:
            soon = [self.days * DAY_S, self.monitor.next_edge_s()]
            soon += [left[0].at_s] if left else []
            soon += [self._repairs[0][0]] if self._repairs else []
            self.news.wait(max(0.0, min(soon) - scheduler.now_s))
            self.news.clear()
            if scheduler.crashes and self.violation is None:
                name, error = scheduler.crashes[0]
                self.violation = Violation("no crash", f"{name}: {type(error).__name__}: {error}")
            if self.violation is not None:
                return
            scheduler.rush()
            if self.program is not None and self.program.dead:
                # Killed while it wrote; systemd starts it again.
                self.end_of_program()
                scheduler.sleep(3.0)
                self.boot()
            while self._repairs and self._repairs[0][0] <= scheduler.now_s:
                heapq.heappop(self._repairs)[2]()
            while left and left[0].at_s <= scheduler.now_s and self.violation is None:
                incident = left.pop(0)
                if incident.after_event:
                    self._waiting.append(incident)
                else:
                    self._inject(incident)

    def _ends(self) -> None:
        """Checks the log of the last service; that of others is checked when the next one begins. Raises Violation."""
        if self.violation is None and self.service is not None and self.service.log.problem is None:
            self.monitor.log.in_file(STAGE / EventLog.FILE)

    def _inject(self, incident: Incident) -> None:
        injection.inject(self, incident)
        self.world.scheduler.rush()

    def _on_event(self, name: str) -> None:
        """The kiosk's log has this event: incidents that wait for it come soon. In a thread of the kiosk."""
        now_s = self.world.scheduler.now_s
        self._waiting = [incident for incident in self._waiting if now_s - incident.at_s < WAITS_S]
        for incident in [incident for incident in self._waiting if incident.after_event == name]:
            self._waiting.remove(incident)
            self.later(incident.delay_s, partial(self._inject, incident))
            self.news.set()

    def later(self, seconds: float, repair: Callable[[], None]) -> None:
        """Do this after so many seconds."""
        heapq.heappush(self._repairs, (self.world.scheduler.now_s + seconds, next(self._order), repair))

    # -- the service

    def boot(self) -> None:
        """Start the service's program."""
        self.program, self.stop = self.world.scheduler.program(), Halt(self.world.scheduler)
        self.world.program = self.program
        self.world.scheduler.task(self._serve, "service", self.program).start()
        self.later(SERVES_S, partial(self._serves, self.program))

    def _serves(self, program: Program) -> None:
        """A program that was not ended since has a service. Raises Violation."""
        spoilt = {"stage.toml", GOOD} <= self.unreadable
        spoilt = spoilt or self.world.scheduler.now_s - self.repaired_s < SERVES_S
        spoilt = spoilt or self.world.scheduler.now_s - self.renewed_s < RENEWS_S
        if self.program is program and not program.dead and self.service is None and not spoilt:
            why = None if self.kiosk is None else self.kiosk.snapshot().reason
            raise Violation("serves", f"{SERVES_S:.0f} s after its start it does not: {why}")

    def end_of_program(self) -> None:
        """Kill it, and let go of all that it had."""
        if self.program is not None:
            self.world.scheduler.kill(self.program)
            self.world.scheduler.bury(self.program)
        self.world.disk.kill_after = None
        self.world.release()
        self.program = self.kiosk = self.service = None
        self.monitor.killed()
        self.monitor.disturb(0.0)

    def restart(self, *, lit: bool) -> None:
        """As systemd does: asked to end, then started again. Raises Violation."""
        self.end(lit=lit)
        self.world.scheduler.sleep(1.0)
        self.boot()

    def end(self, *, lit: bool) -> None:
        """It is asked to end, and killed if it does not."""
        program, scheduler = self.program, self.world.scheduler
        assert program is not None
        self.stop.restarting = lit
        self.stop.set()
        if self.kiosk is not None:
            self.kiosk.reload.set()
        ends_s = scheduler.now_s + END_S
        while any(task.is_alive() for task in program.tasks) and scheduler.now_s < ends_s and not program.dead:
            scheduler.sleep(0.5)
        self.end_of_program()

    def _serve(self) -> None:
        """As ``controller.cli.kiosk_process.serve``, without panel and socket."""
        world, stop = self.world, self.stop
        kiosk = self.kiosk = StageKiosk(STAGE, world)
        while not stop.is_set():
            kiosk.reload.clear()
            try:
                with serving(STAGE, stop, world=world, jobs=SimulatedJobs(world)) as service:
                    kiosk.attach(service)
                    self._follow(kiosk, service)
                    # The end sets both; the real one looks at both several times a second.
                    while not (stop.is_set() or kiosk.reload.is_set()):
                        kiosk.reload.wait()
                    self.service, self.renewed_s = None, world.scheduler.now_s
                    if not stop.is_set():
                        assert self.program is not None
                        self.later(RENEWS_S, partial(self._serves, self.program))
                kiosk.detach()
                self.monitor.disturb(0.0)
            except CodedError as error:
                kiosk.attach(None, f"{error.what} {error.remedy}")
                # Nothing else of it runs, and whatever happens ends the pause.
                world.scheduler.stretch = min(world.scheduler.stretch * CALMER, CALM[2])
                stop.wait(AGAIN_S)

    def _follow(self, kiosk: StageKiosk, service: Service) -> None:
        self.service = service
        self._keep_by_s = None
        self.monitor.begins()
        verify_doubtful_hours(self, kiosk)
        refresh = service.changed

        def stepped() -> None:
            refresh()
            if self.violation is None and self.service is service:
                try:
                    self._keeps_good()
                    self._calm(service, news=self.monitor.check(kiosk, service))
                    self.monitor.paused_long = self.world.scheduler.stretch > 1
                except Exception as error:  # noqa: BLE001 - a mistake of the monitor is none of the kiosk
                    self.violation = error
                    self.news.set()

        try:
            check_restart(self.monitor, service, damaged=frozenset(self.damaged))
        except Violation as error:
            self.violation = error
            self.news.set()
        self.damaged.clear()
        service.changed = stepped

    def _keeps_good(self) -> None:
        """A running service has a copy of a sound stage.toml, soon after the disk has room. Raises Violation."""
        now_s = self.world.scheduler.now_s
        if now_s < self._looked_s + LOOKS_S and self._keep_by_s is not None:
            return
        self._looked_s = now_s
        if self.world.disk.full or "stage.toml" in self.unreadable:
            self._keep_by_s = None
        elif _content(STAGE / GOOD) == _content(STAGE / "stage.toml"):
            self.unreadable.clear()
            self._keep_by_s = now_s + KEEPS_S
        elif self._keep_by_s is None:
            self._keep_by_s = now_s + KEEPS_S
        elif now_s > self._keep_by_s:
            raise Violation("settings kept", f"{GOOD} is no copy of stage.toml")

    def _calm(self, service: Service, *, news: bool) -> None:
        """Stretch pauses while nothing happens."""
        scheduler, state, job = self.world.scheduler, service.reconciler.machine.state, service.jobs.job
        views = [supervisor.view for supervisor in service.devices.projectors]
        seen = (
            state, service.player.want, service.player.view.shown, service.player.view.restarts,
            [(view.condition, view.power, view.stable_left_s > 0, view.problem) for view in views],
            service.jobs.running, job and job.ended, service.disk.problem, service.devices.camera.problem,
        )  # fmt: skip
        if news or seen != self._last:
            self._last = seen
            scheduler.rush()
            return
        well = not any(view.problem for view in views) and service.player.view.problem is None
        settled = state in (State.PLAYING, State.OFF) and not service.reconciler.working
        steady = all(view.stable_left_s in (0, float("inf")) for view in views)
        rests = steady and all(view.condition in (Condition.LIT, Condition.DARK) for view in views)
        wrong = state in (State.DEGRADED, State.FAULT) or (not well and (settled or state is State.COOLING))
        waits = state in (State.OFF, State.CALIBRATING) and well
        limit = CALM[3] if settled and well and rests else CALM[2] if wrong else CALM[1] if waits else CALM[0]
        # A picture has to come in time: who hangs is asked up to 16 times, and starts are half a minute apart.
        limit = 1.0 if self.world.screen.hung else CALM[0] if self.monitor.bundles.dark else limit
        scheduler.stretch = min(scheduler.stretch * CALMER, limit)

    # -- people

    def command(self, incident: Incident) -> None:
        """A person's command, in a thread of the service, as the panel's."""
        kiosk, program = self.kiosk, self.program
        if kiosk is None or program is None:
            return

        def asked() -> None:
            with contextlib.suppress(VelaturaError, DeviceError), unknown_outcome_if_killed(self, incident):
                values = arguments_of(self, incident, kiosk)
                socket_table({"kiosk": kiosk})[incident.target](**values)
                expect(self, incident, values)

        self.world.scheduler.task(asked, "command", program).start()


def _content(path: Path) -> bytes | None:
    return path.read_bytes() if path.is_file() else None


@contextlib.contextmanager
def _one_core() -> Iterator[None]:
    """Inside, threads that this one starts share its core: they take turns, and turns between cores take far longer."""
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    # Where it runs now, field 39 of proc(5): another life may have another core.
    fields = Path("/proc/thread-self/stat").read_text("ascii", "replace").rpartition(")")[2].split()
    allowed = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {int(fields[36])})
    try:
        yield
    finally:
        os.sched_setaffinity(0, allowed)


@contextlib.contextmanager
def _folder() -> Iterator[Path]:
    """A folder in memory as the present one, and UTC as this computer's time zone; gives its path."""
    before, memory = Path.cwd(), Path("/dev/shm")  # noqa: S108 - the folder in it has a name of its own
    kept = {name: os.environ.get(name) for name in ("TZ", "XDG_RUNTIME_DIR")}
    stack = threading.stack_size(STACK_BYTES)
    with tempfile.TemporaryDirectory(dir=memory if os.access(memory, os.W_OK) else None) as name:
        os.environ |= {"TZ": "UTC", "XDG_RUNTIME_DIR": name}
        time.tzset()
        os.chdir(name)
        try:
            yield Path.cwd()
        finally:
            os.chdir(before)
            threading.stack_size(stack)
            for variable, value in kept.items():
                os.environ.pop(variable, None)
                os.environ |= {} if value is None else {variable: value}
            time.tzset()
