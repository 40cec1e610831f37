"""Decides what the stage does, from the schedule, operators, lamps, player and jobs.

``step`` reads all of them, moves the state machine, and sets the wanted state of each. It waits for nothing, so a
device that hangs delays only its own supervisor.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

from controller.core.errors import WorkError
from controller.kiosk.decide.clock import Timetable
from controller.kiosk.decide.interfaces import (
    BLACK,
    Bundles,
    Jobs,
    PlayerPort,
    PlayerView,
    ProjectorPort,
    ProjectorView,
    Request,
    Showing,
)
from controller.kiosk.decide.job_queue import JobQueue
from controller.kiosk.decide.operator_overrides import LiveChanges, LiveChangesKept, OperatorOverrides
from controller.kiosk.decide.planner import Plan
from controller.kiosk.decide.stage_states import LightNeed, Limits, StageStates
from controller.kiosk.store.event_log import EventLog
from controller.kiosk.values import IN_TURN
from controller.run.state_machine import Event, Machine, State
from hal.notices import Level, Notice


class ContentSelector:
    """Call it only with the reconciler's lock held."""

    def __init__(
        self, bundles: Bundles, overrides: OperatorOverrides, live: LiveChangesKept, queue: JobQueue, log: EventLog
    ) -> None:
        self._bundles, self._overrides, self._queue, self._log = bundles, overrides, queue, log
        self._live = live
        self._empty = False
        self._asked_for: set[tuple[Path | None, frozenset[str]]] = set()

    def something(self, wanted: bool) -> bool:
        """Whether the stage is ``wanted`` open and has a bundle to play; a missing bundle is logged once."""
        installed = self._bundles.bundle() is not None
        if wanted and not installed and not self._empty:
            self._log.add(_EMPTY)
        self._empty = wanted and not installed
        return wanted and installed

    def picture(self, plan: Plan) -> str:
        """The appearance that is wanted now, or first; the same while it is black. Empty if nothing is installed."""
        return self._wanted(self._chosen(plan)).appearance

    def of(self, plan: Plan, missing: frozenset[str]) -> Showing:
        """What to show without the projectors ``missing``; missing frames are requested once per bundle."""
        live = self._live.now
        if live.black:
            return replace(BLACK, fade_s=live.fade_s or 0.0)
        wanted = self._wanted(self._chosen(plan))
        wanted = replace(wanted, brightness=live.brightness)
        if live.fade_s is not None:
            wanted = replace(wanted, fade_s=live.fade_s)
        if not missing:
            return wanted
        failover = self._without(wanted, missing)
        if failover is not None:
            return replace(wanted, bundle=failover)
        # Until then the frames of the whole stage stay: dimmer than they should be, but visible.
        request = Request("takeover", arguments=tuple(sorted(missing)))
        if (wanted.bundle, missing) not in self._asked_for and self._queue.offer(request):
            self._asked_for.add((wanted.bundle, missing))
        return wanted

    def _chosen(self, plan: Plan) -> str:
        names = self._bundles.names()
        held = self._live.now.held
        return held if held in names else self._overrides.appearance(plan, names)

    def after(self, plan: Plan, shown: str) -> tuple[str, bool]:
        """The appearance that follows ``shown``, and whether they are shown in turn; empty if nothing is installed."""
        names = list(self._bundles.names())
        turns = [name for name, _, _ in self._bundles.playlist()]
        in_turn = self._overrides.appearance(plan, names) == IN_TURN and len(turns) > 1 and not self._live.now.held
        order = list(dict.fromkeys(turns)) if shown in turns or in_turn else names
        if not order:
            return "", False
        return order[(order.index(shown) + 1) % len(order) if shown in order else 0], in_turn

    def _wanted(self, name: str) -> Showing:
        """``name``, or the bundle's playlist, as the whole stage shows it."""
        bundle, names, turns = self._bundles.bundle(), self._bundles.names(), tuple(self._bundles.playlist())
        if name == IN_TURN and len(turns) > 1:
            first = next((at for at, turn in enumerate(turns) if turn[0] == self._live.now.first), 0)
            turns = turns[first:] + turns[:first]
            return Showing(bundle, turns[0][0], turns, fade_s=turns[0][2])
        if name == IN_TURN:
            name = turns[0][0] if turns else names[0] if names else ""
        return Showing(bundle, name, fade_s=next((fade_s for other, _, fade_s in turns if other == name), 0.0))

    def _without(self, wanted: Showing, missing: frozenset[str]) -> Path | None:
        """The bundle for the other projectors, if it has all that is wanted."""
        names = dict.fromkeys([wanted.appearance, *(name for name, _, _ in wanted.in_turn)])
        found = {self._bundles.without(missing, name) for name in names}
        return found.pop() if len(found) == 1 else None


_EMPTY: Final = Notice(
    "nothing-installed", "The stage should be open, but no bundle is installed.",
    "Calibrate the stage and compute appearances. The lamps stay off until then.", Level.WARNING,
)  # fmt: skip


WAY_S: Final = 30.0
"""Until a background job has made way for a change of files that it reads."""
BRIGHTNESS_FADE_S: Final = 0.25
"""As long as the player's supervisor waits between two looks, so that a slow change has no steps to see."""
_SHOWING: Final = (State.POWERING, State.WARMING, State.READY, State.PLAYING, State.DEGRADED, State.FAULT)
"""In a fault, too: a lamp whose control line is dead may be lit."""


class Reconciler:
    """The kiosk's decisions. One thread calls ``step`` about four times a second; commands may come from any thread.

    ``timetable``: the opening hours and the time, read at every step.
    """

    def __init__(
        self,
        supervisors: Sequence[ProjectorPort],
        player: PlayerPort,
        jobs: Jobs,
        bundles: Bundles,
        log: EventLog,
        timetable: Timetable,
        limits: Limits | None = None,
    ) -> None:
        self._supervisors, self._player, self._log = supervisors, player, log
        self._timetable, self._monotonic = timetable, timetable.clock.monotonic
        self._limits = limits or Limits()
        self._queue = JobQueue(jobs, log, monotonic=self._monotonic, patience_s=self._limits.power_up_s)
        self._states = StageStates(log, self._limits, self._monotonic)
        self.overrides = OperatorOverrides(log, without_time=timetable.hours.open_without_time)
        self._live = LiveChangesKept(log)
        self._content = ContentSelector(bundles, self.overrides, self._live, self._queue, log)
        self._lock = threading.RLock()
        self._plan = Plan(None)
        self._lit_until_s, self._lit_while_closed = float("-inf"), False

    # -- commands and questions

    @property
    def machine(self) -> Machine:
        """The state that the stage is in."""
        return self._states.machine

    @property
    def plan(self) -> Plan:
        return self._plan

    @property
    def working(self) -> bool:
        """Whether a job runs or waits."""
        with self._lock:
            return self._queue.head is not None

    @property
    def waiting(self) -> Request | None:
        """The job that starts next, once its lamps are steady; None while one runs."""
        with self._lock:
            return None if self._queue.running else self._queue.head

    def waits(self, number: int) -> bool:
        """Whether the job of this number waits to start."""
        with self._lock:
            return self._queue.waits(number)

    def open(self) -> None:
        """Play until the next scheduled change."""
        with self._lock:
            self.overrides.override(True, self._plan)
            self._states.retry_now()

    def shut(self) -> None:
        """Stop, and cool the lamps, until the next scheduled change."""
        with self._lock:
            self._queue.cancel()
            self._lit_until_s = float("-inf")
            self.overrides.override(False, self._plan)

    def choose(self, appearance: str, fade_s: float | None = None) -> None:
        """Play this appearance of the bundle from now on; it fades in for ``fade_s``, None: as the bundle says."""
        with self._lock:
            self._live.change(black=False, held="", first="", fade_s=fade_s)
            self.overrides.choose(appearance, self._plan)

    @property
    def live(self) -> LiveChanges:
        """What people changed of the picture."""
        return self._live.now

    def next(self, fade_s: float | None = None) -> None:
        """Show the appearance that comes after the present one. Raises WorkError("nothing-plays")."""
        with self._lock:
            name, in_turn = self._content.after(self._plan, self._shown())
            if in_turn:
                self._live.change(black=False, first=name, fade_s=fade_s)
            elif self._live.now.held:
                self._live.change(black=False, held=name, fade_s=fade_s)
            else:
                self.choose(name, fade_s)

    def black(self, on: bool, fade_s: float | None = None) -> None:
        """Show black with the lamps lit, or the picture again. Raises WorkError("nothing-plays") while closed."""
        with self._lock:
            if on:
                self._require_open()
            self._live.change(black=on, first=self._first(), fade_s=fade_s)

    def pause(self, on: bool) -> None:
        """Stay at the present appearance, or continue from there. Raises WorkError("nothing-plays")."""
        with self._lock:
            name = self._shown() if on else self._live.now.held
            self._live.change(held=name if on else "", first=name)

    def brighten(self, share: float) -> None:
        """Show this share of the light, until the stage closes. Raises WorkError("nothing-plays") while closed."""
        with self._lock:
            self._require_open()
            self._live.change(brightness=round(share, 3), first=self._first(), fade_s=BRIGHTNESS_FADE_S)

    def _first(self) -> str:
        """Where a list continues that starts again: with another brightness, or after black."""
        shown = self._player.view.shown
        return self._live.now.first if shown is None or not shown.appearance else shown.appearance

    def _require_open(self) -> None:
        if not self.overrides.open(self._plan):
            raise _nothing_plays()

    def _shown(self) -> str:
        self._require_open()
        shown = self._player.view.shown
        if self._live.now.held or shown is None or not shown.appearance:
            name = self._live.now.held or self._content.picture(self._plan)
            if not name:
                raise _nothing_plays()
            return name
        return shown.appearance

    def light_for(self, seconds: float, *, closed_too: bool = False) -> None:
        """Keep the lamps lit, even with nothing to play, while open or ``closed_too``. 0 or ``shut`` ends it."""
        with self._lock:
            self._lit_until_s, self._lit_while_closed = self._monotonic() + seconds, closed_too

    def submit(self, *requests: Request) -> None:
        """Queue jobs. Raises WorkError("busy") while another job runs or waits, or with the reason of a refusal."""
        with self._lock:
            self._queue.submit(*requests)

    def go_on(self) -> Sequence[tuple[Request, bool]]:
        """As ``JobQueue.go_on``."""
        with self._lock:
            return self._queue.go_on()

    @contextlib.contextmanager
    def idle(self) -> Iterator[None]:
        """No job starts inside this context, so files that jobs read may be changed. Only its thread may queue jobs.

        Raises WorkError("busy") while a job runs or waits, and while another thread is inside.
        """
        with self._lock:
            self._queue.hold()
        try:
            self._await_way()
            yield
        finally:
            with self._lock:
                self._queue.release()

    def _await_way(self) -> None:
        """Until a background job has ended that makes way. Raises WorkError("busy") if it does not end soon."""
        until_s = time.monotonic() + WAY_S
        while True:
            with self._lock:
                self._take_finished()
                if not self._queue.running:
                    return
            if time.monotonic() > until_s:
                raise WorkError("busy", what="A job in the background does not end.", remedy="Try again in a minute.")
            time.sleep(0.05)

    def cancel(self) -> None:
        """Raises WorkError("nothing-to-cancel")."""
        with self._lock:
            if self._queue.head is None:
                raise WorkError("nothing-to-cancel", what="No job is running.", remedy="There is nothing to cancel.")
            self._queue.cancel()

    # -- one step

    def step(self) -> None:
        with self._lock:
            # First: a task that has just ended must not be due in the plan.
            self._take_finished()
            self._update_plan()
            wanted_open = self.overrides.open(self._plan)
            self._queue.take_due(self._plan, playing=wanted_open and bool(self._timetable.hours.now.rows))
            views = [supervisor.view for supervisor in self._supervisors]
            open_now = self._content.something(wanted_open)
            if not wanted_open:
                self._live.end()
            lit_anyway = (wanted_open or self._lit_while_closed) and self._monotonic() < self._lit_until_s
            light = open_now or lit_anyway or self._queue.needs_light
            need = LightNeed(light, open_now, self._queue.needs_light)
            self._states.follow(views, self._player.view.problem, need)
            cooling = self.machine.state in (State.COOLING, State.OFF)
            for supervisor in self._supervisors:
                if supervisor.want_lit is not (wanted := light and not cooling):
                    supervisor.want_lit = wanted
            self._begin_work(views)
            self._show(views, open_now)

    def _update_plan(self) -> None:
        self._plan = self._timetable.plan(self._log.done())
        self.overrides.follow(self._plan)

    # -- jobs

    def _take_finished(self) -> None:
        finished = self._queue.take_finished()
        if finished is not None and self.machine.state is State.CALIBRATING:
            event = Event.CANCEL if finished.failed else Event.CALIBRATED
            self._states.go(event, finished.outcome.what)

    def _begin_work(self, views: Sequence[ProjectorView]) -> None:
        head = self._queue.head
        state = self.machine.state
        if state is State.FAULT and head is not None and head.light:
            self._queue.drop(_FAULTY)
        if head is not None and head.light and state not in (State.READY, State.PLAYING, State.DEGRADED):
            return
        if (request := self._queue.ready(views)) is None:
            return
        if request.light:
            self._states.go(Event.RECALIBRATE, f"{request.kind} starts")
            self._player.want = None
        self._queue.begin()

    # -- the player

    def _show(self, views: Sequence[ProjectorView], open_now: bool) -> None:
        state = self.machine.state
        if state is State.CALIBRATING:
            return
        # If every lamp is dark, no projector can replace another.
        missing = frozenset[str]() if len(self._states.missing) == len(views) else self._states.missing
        want = self._content.of(self._plan, missing) if open_now and state in _SHOWING else BLACK
        self._player.want = want
        shown = self._player.view.shown
        if self._live.now.fade_s is not None and shown is not None and _same_picture(shown, want):
            # It was for this one change: what comes back after a fault comes as usual.
            self._live.change(fade_s=None)

    @property
    def player(self) -> PlayerView:
        return self._player.view


def _same_picture(one: Showing, other: Showing) -> bool:
    return (one.bundle, one.appearance, one.brightness) == (other.bundle, other.appearance, other.brightness)


def _nothing_plays() -> WorkError:
    return WorkError(
        "nothing-plays", what="The stage is closed, or nothing is installed.", remedy="Open the stage first."
    )


_FAULTY: Final = Notice(
    "work-impossible", "The job was cancelled because the stage has a fault.",
    "Correct the fault, then start the job again.", Level.ERROR,
)  # fmt: skip
