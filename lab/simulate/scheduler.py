"""Threads that take turns, in virtual time: one runs at a time, and a seed decides whose turn it is.

A task is a thread of the system, so the kiosk's code needs no change. It hands its turn on only where it waits: a
sleep, an event, a lock that is taken, the end of another task. Between two waits no one else runs.
"""

from __future__ import annotations

import heapq
import random
import threading
from collections.abc import Callable
from typing import Any, Final

STACK_BYTES: Final = 512 * 1024
DAY_S: Final = 86_400.0


class Killed(BaseException):
    """The process is gone at this point. Not an Exception: no code of a kiosk may catch its own end."""


class Task:
    """One thread of a program. ``program``: that with which it is killed; None: it belongs to the world."""

    def __init__(self, scheduler: Scheduler, run: Callable[[], object], name: str, program: Program | None) -> None:
        self.name, self.program = name, program
        self.done = self.begun = False
        self.asked_s: float | None = None
        """The pause for which it asked, while it is in one that may be stretched."""
        self.turn = 0
        self._scheduler, self._run = scheduler, run
        self.baton = threading.Lock()
        self.baton.acquire()
        self._joining: list[Task] = []

    # -- as threading.Thread

    def start(self) -> None:
        self.begun = True
        threading.Thread(target=self._main, name=self.name, daemon=True).start()
        self._scheduler.wake_at(self, self._scheduler.now_s)

    def join(self, timeout: float | None = None) -> None:
        if self.begun and not self.done:
            me = self._scheduler.present
            self._joining.append(me)
            self._scheduler.wait(timeout)
            if me in self._joining:
                self._joining.remove(me)

    def is_alive(self) -> bool:
        return self.begun and not self.done

    def _main(self) -> None:
        with self.baton:
            scheduler = self._scheduler
            scheduler.present = self
            try:
                if self.program is None or not self.program.dead:
                    self._run()
            except Killed:
                pass
            except BaseException as error:  # noqa: BLE001 - reported as what the life found
                scheduler.crashes.append((self.name, error))
            self.done = True
            for task in self._joining:
                scheduler.wake_at(task, scheduler.now_s)
            scheduler.leave()


class Program:
    """Tasks that are killed together: one process of the computer."""

    def __init__(self) -> None:
        self.dead = False
        self.tasks: list[Task] = []


class Scheduler:
    """``stretch``: how much longer than asked the pauses of calm tasks are; see ``rush``. ``brisk``: the name of tasks
    whose pauses are not, or empty.
    """

    def __init__(self, seed: str) -> None:
        self._random = random.Random(f"{seed} turns")
        self.now_s = 0.0
        self.stretch = 1.0
        self.longest_s = 1800.0
        self.brisk = ""
        self.crashes: list[tuple[str, BaseException]] = []
        self.turns = 0
        self.on_kill: Callable[[], None] = lambda: None
        self._heap: list[tuple[float, float, int, Task]] = []
        self._calm: dict[Task, None] = {}
        self._program: Program | None = None
        self.present = Task(self, lambda: None, "world", None)

    # -- tasks

    def program(self) -> Program:
        return Program()

    def task(self, run: Callable[[], object], name: str, program: Program | None) -> Task:
        task = Task(self, run, name, program)
        if program is not None:
            program.tasks.append(task)
        return task

    def kill(self, program: Program) -> None:
        """From now on every task of the program ends where it waits, and what it would do in its end is not done."""
        program.dead = True
        for task in program.tasks:
            if task.is_alive() and task is not self.present:
                self.wake_at(task, self.now_s)
        self.on_kill()

    def bury(self, program: Program) -> None:
        """Wait until all tasks of a killed program have ended. For the world's own task."""
        for task in program.tasks:
            if task.is_alive():
                task.join()
        program.tasks.clear()

    # -- waiting

    def check(self) -> None:
        """Raises Killed in a task whose program is dead."""
        program = self.present.program
        if program is not None and program.dead:
            raise Killed

    def sleep(self, seconds: float) -> None:
        self.wait(max(0.0, seconds))

    def wait(self, seconds: float | None, *, calm: bool = False) -> None:
        """Hand the turn on, until so many seconds have passed or somebody wakes this task. None: until then.

        ``calm``: a pause that may be stretched.
        """
        self.check()
        me = self.present
        if seconds is not None:
            asked_s = seconds
            if calm and self.stretch > 1 and me.name != self.brisk:
                me.asked_s = asked_s
                self._calm[me] = None
                seconds = max(asked_s, min(asked_s * self.stretch, self.longest_s))
            self.wake_at(me, self.now_s + seconds)
        else:
            me.turn += 1
        following = self._next()
        if following is not me:
            following.baton.release()
            me.baton.acquire()
            self.present = me
        self.check()

    def wake_at(self, task: Task, at_s: float) -> None:
        """Its turn comes then; an earlier appointment no longer counts."""
        task.turn += 1
        heapq.heappush(self._heap, (at_s, self._random.random(), task.turn, task))

    def leave(self) -> None:
        """The present task has ended."""
        self._next().baton.release()

    def rush(self) -> None:
        """Something happened: pauses are as long as asked again, those that have begun included."""
        if self.stretch > 1:
            self.stretch = 1.0
            for task in list(self._calm):
                if task.asked_s is not None and not task.done:
                    self.wake_at(task, self.now_s + self._random.random() * task.asked_s)
            self._calm.clear()

    def _next(self) -> Task:
        while True:
            at_s, _, turn, task = heapq.heappop(self._heap)
            if turn == task.turn and not task.done:
                self.now_s = max(self.now_s, at_s)
                task.asked_s = None
                self._calm.pop(task, None)
                self.turns += 1
                return task


class Event(threading.Event):
    """As ``threading.Event``, for tasks. ``calm``: whether waits for it may be stretched."""

    def __init__(self, scheduler: Scheduler) -> None:
        super().__init__()
        self._scheduler = scheduler
        self._waiting: dict[Task, None] = {}

    def set(self) -> None:
        super().set()
        for task in list(self._waiting):
            self._scheduler.wake_at(task, self._scheduler.now_s)
        self._waiting.clear()

    def wait(self, timeout: float | None = None) -> bool:
        if not self.is_set():
            scheduler = self._scheduler
            me = scheduler.present
            self._waiting[me] = None
            try:
                scheduler.wait(timeout, calm=me.program is not None and not me.name.startswith("work-"))
            finally:
                self._waiting.pop(me, None)
        return self.is_set()


class Lock:
    """As ``threading.Lock``; with ``again``, as ``threading.RLock``."""

    def __init__(self, scheduler: Scheduler, *, again: bool) -> None:
        self._scheduler, self._again = scheduler, again
        self._owner: Task | None = None
        self._depth = 0
        self._waiting: dict[Task, None] = {}

    def acquire(self, blocking: bool = True, timeout: float = -1) -> bool:
        scheduler = self._scheduler
        me = scheduler.present
        ends_s = float("inf") if timeout < 0 else scheduler.now_s + timeout
        while self._owner is not None and not (self._again and self._owner is me):
            if not blocking or scheduler.now_s >= ends_s:
                return False
            self._waiting[me] = None
            try:
                scheduler.wait(None if timeout < 0 else ends_s - scheduler.now_s)
            finally:
                self._waiting.pop(me, None)
        self._owner, self._depth = me, self._depth + 1
        return True

    def release(self) -> None:
        self._depth -= 1
        if self._depth == 0:
            self._owner = None
            for task in self._waiting:
                self._scheduler.wake_at(task, self._scheduler.now_s)

    def locked(self) -> bool:
        return self._owner is not None

    def __enter__(self) -> bool:
        return self.acquire()

    def __exit__(self, *_: Any) -> None:
        self.release()
