"""A kiosk of models in virtual time: lamps that remember every sin, a player, work, and clocks that anybody may set."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from controller.kiosk.decide.clock import Timetable, TrustedClock, beginning
from controller.kiosk.decide.interfaces import BLACK, Finished, PlayerView, Request, Showing
from controller.kiosk.decide.reconciler import Reconciler
from controller.kiosk.decide.stage_states import Limits
from controller.kiosk.store.event_log import EventLog
from controller.kiosk.supervisors.projector_supervisor import LampBefore, ProjectorSupervisor
from controller.kiosk.values import Schedule, Turn
from controller.run.state_machine import State
from controller.stage.rig.lamp_guard import LampGuard
from controller.stage.rig.lamp_ledger import LampRecord
from hal.deadline import Deadline
from hal.errors import DeviceGone
from hal.notices import Level, Notice
from hal.values import Power, ProjectorStatus
from tests.controller.stage.rig.lamp_model import RULES, Lamp, Shelf, World

NAMES = ("left", "right", "above")
STEP_S = 1.0
BUNDLE = Path("bundles/one.vel")
LIMITS = Limits(power_up_s=120.0, cool_down_s=60.0)


class FragileLamp(Lamp):
    """Knobs beyond the session's model: ``dud`` takes strikes and stays dark; ``slow_s`` before each answer."""

    dud = False
    slow_s = 0.0

    def status(self, *, deadline: Deadline) -> ProjectorStatus:
        self.world.time_s += self.slow_s
        return super().status(deadline=deadline)

    def strike(self, *, sin: bool) -> None:
        before = self.strikes
        super().strike(sin=sin)
        if self.dud and self.strikes > before:
            self.lit_at_s, self.off_at_s = None, self.world.time_s

    def burst(self) -> None:
        self.dud = True
        self.go_dark()


@dataclass
class ModelPlayer:
    """Shows what is asked at once, unless it is hung or has trouble; a hung one comes back after 5 s."""

    world: World
    want: Showing | None = BLACK
    hung_at_s: float | None = None
    broken: bool = False
    problem: Notice | None = None
    shown: Showing | None = None

    @property
    def view(self) -> PlayerView:
        if self.hung_at_s is not None and self.world.time_s - self.hung_at_s > 5.0:
            self.hung_at_s = None
        if self.broken or self.hung_at_s is not None:
            return PlayerView(None, Notice("player-hung", "The player did not answer.", "It is started again."))
        if self.want is not None:
            self.shown = self.want
        return PlayerView(self.shown, self.problem)


@dataclass
class ModelJobs:
    """Work that takes virtual time. ``camera`` away: photographs are refused, and fail under way."""

    world: World
    seconds: dict[str, float] = field(default_factory=lambda: {"drift": 20.0, "quick": 60.0})
    camera: bool = True
    drifted: bool = False
    done: list[tuple[float, str, str]] = field(default_factory=list)
    _request: Request | None = None
    _ends_s: float = 0.0
    cancelled: bool = False

    def refusal(self, request: Request) -> Notice | None:
        if request.light and not self.camera:
            return Notice("camera-missing", "There is no camera.", "Plug it in.", Level.ERROR)
        return None

    def begin(self, request: Request) -> None:
        self._request, self.cancelled = request, False
        self._ends_s = self.world.time_s + self.seconds.get(request.kind, 10.0)

    @property
    def running(self) -> Request | None:
        return self._request

    def finished(self) -> Finished | None:
        request = self._request
        if request is None:
            return None
        fails = request.light and not self.camera
        if self.world.time_s < self._ends_s and not (fails or self.cancelled):
            return None
        self._request = None
        how = "failed" if fails else "cancelled" if self.cancelled else "done"
        self.done.append((self.world.time_s, request.kind, how))
        if how != "done":
            told = Notice(f"work-{how}", f"It was {how}.", "Try again.", Level.ERROR)
            return Finished(request, told, failed=True)
        then: tuple[Request, ...] = ()
        if request.kind == "drift" and self.drifted:
            self.drifted = False
            then = (Request("quick", light=True, key=request.key),)
        return Finished(request, Notice("work-done", "Done."), then=then)

    def cancel(self) -> None:
        self.cancelled = True


@dataclass
class ModelStock:
    installed: Path | None = BUNDLE
    beside: dict[frozenset[str], Path] = field(default_factory=dict)
    turns: tuple[Turn, ...] = ()

    def bundle(self) -> Path | None:
        return self.installed

    def names(self) -> Sequence[str]:
        return ("shine", "marble")

    def playlist(self) -> Sequence[Turn]:
        return self.turns

    def without(self, missing: Collection[str], appearance: str) -> Path | None:
        return self.beside.get(frozenset(missing))


@dataclass
class Kiosk:
    """Everything, on a clock of its own. ``wall_offset_s``: what the wall clock is off from ``world.time_s``."""

    folder: Path
    schedule: Schedule = field(default_factory=lambda: Schedule("UTC"))
    world: World = field(default_factory=World)
    wall_offset_s: float = 1_780_000_000.0
    without_time: bool = False

    def __post_init__(self) -> None:
        self.lamps = {name: FragileLamp(self.world) for name in NAMES}
        self.shelf = Shelf()
        self.gone: set[str] = set()
        self.bundles = ModelStock()
        self.jobs = ModelJobs(self.world)
        self.player = ModelPlayer(self.world)
        self.boot()

    def boot(self) -> None:
        """The service begins, after whatever ended it; lamps, ledger and disk are as they were."""
        self.log = EventLog(self.folder / "events.sqlite", wall=self.wall, durable=False)
        self.log.add(beginning(self.log))
        self.jobs = ModelJobs(self.world, camera=self.jobs.camera, done=self.jobs.done, drifted=self.jobs.drifted)
        self.player = ModelPlayer(self.world)
        self.supervisors = [self._supervisor(name) for name in NAMES]
        self.reconciler = Reconciler(
            self.supervisors, self.player, self.jobs, self.bundles, self.log,
            Timetable(ModelHours(self), TrustedClock(self.log, self.wall, self.world.now_s, lambda: False)), LIMITS,
        )  # fmt: skip

    def wall(self) -> float:
        return self.world.time_s + self.wall_offset_s

    def _supervisor(self, name: str) -> ProjectorSupervisor:
        def open_guard(deadline: Deadline) -> LampGuard:
            if name in self.gone:
                raise DeviceGone("port-gone", what=f"The cable of {name} is away.", remedy="Plug it in.")
            return LampGuard(name, self.lamps[name], self.shelf, clock=self.world)

        record = self.shelf.read(name) or LampRecord()
        lamp = LampBefore(failed=record.failed_in(self.world.boot()))
        return ProjectorSupervisor(name, open_guard, self.log.add, clock=self.world, lamp=lamp)

    def power_cut(self, seconds: float) -> None:
        """Everything goes dark for so long."""
        self.log.close()
        for lamp in self.lamps.values():
            lamp.go_dark()
        self.world.time_s += seconds
        self.world.reboot()
        self.boot()

    def step(self, seconds: float = STEP_S) -> None:
        for supervisor in self.supervisors:
            supervisor.step()
        self.reconciler.step()
        self.world.time_s += seconds

    def run(self, seconds: float, step_s: float = STEP_S) -> None:
        ends_s = self.world.time_s + seconds
        while self.world.time_s < ends_s:
            self.step(step_s)

    def run_until(self, *states: State, within_s: float = 400.0) -> float:
        """Seconds until one of these states; an assertion error if none comes in time."""
        began_s = self.world.time_s
        while self.state not in states:
            assert self.world.time_s - began_s < within_s, f"{self.state} {self.reconciler.machine.reason}\n{self.told}"
            self.step()
        return self.world.time_s - began_s

    @property
    def state(self) -> State:
        return self.reconciler.machine.state

    @property
    def told(self) -> list[str]:
        return [f"{row.code}: {row.text}" for row in self.log.after(0)[-25:]]

    @property
    def codes(self) -> list[str]:
        return [row.code for row in self.log.after(0)]

    @property
    def lit(self) -> list[str]:
        return [name for name, lamp in self.lamps.items() if lamp.lit_at_s is not None]

    @property
    def sins(self) -> list[str]:
        return [sin for lamp in self.lamps.values() for sin in lamp.sins]


__all__ = ["BUNDLE", "NAMES", "RULES", "STEP_S", "FragileLamp", "Kiosk", "ModelJobs", "ModelPlayer", "Power"]


@dataclass(frozen=True)
class ModelHours:
    """The opening hours of a model, as they are now."""

    kiosk: Kiosk

    @property
    def now(self) -> Schedule:
        return self.kiosk.schedule

    @property
    def open_without_time(self) -> bool:
        return self.kiosk.without_time
