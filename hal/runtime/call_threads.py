"""Calls of code that may never return: they run on a thread that can be left behind.

``CallThreads`` is for drivers of other authors, whose methods may be called from several threads. ``CallThread`` is for
a library that must not get a second call while one hangs. What may crash, too, runs in a process instead
(``plugins.library_process``).
"""

from __future__ import annotations

import contextlib
import queue
import threading
import weakref
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Final, TypeVar

from hal.deadline import SLICE_S, Deadline, turn
from hal.errors import DeviceError

Result = TypeVar("Result")

LOOK_S: Final = 0.1
"""Time between two looks at whether to keep waiting."""
MOST_LEFT_BEHIND: Final = 4
"""Calls of one device that may hang at the same time; further ones are refused."""


class LeftBehind(Exception):
    """The call did not end; its thread still runs. ``again``: not started, because too many others hang."""

    def __init__(self, *, again: bool = False) -> None:
        super().__init__()
        self.again = again


@dataclass(slots=True)
class _Job:
    work: Callable[[], Any]
    late: Callable[[Any], object]
    result: Any = None
    error: BaseException | None = None
    done: threading.Event = field(default_factory=threading.Event)
    left: bool = False
    _turn: threading.Lock = field(default_factory=threading.Lock)

    def run(self) -> None:
        try:
            self.result = self.work()
        except BaseException as error:  # noqa: BLE001 - it is raised again in the waiting thread
            self.error = error
        with self._turn:
            self.done.set()
        if self.left and self.error is None:
            with contextlib.suppress(Exception):  # nothing is left that could take it
                self.late(self.result)

    def leave(self) -> bool:
        """Stop waiting for it; False if it has ended meanwhile."""
        with self._turn:
            self.left = not self.done.is_set()
            return self.left


_Jobs = queue.SimpleQueue[_Job | None]


class CallThreads:
    """The threads of one device's calls. One call after the other has the same thread, as some libraries need it.

    A call that comes while another runs has a thread of its own: a device can be closed while it hangs.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._turn = threading.Lock()
        self._idle: _Jobs | None = None
        self._hanging: list[_Job] = []

    def run(
        self, work: Callable[[], Any], *, given_up: Callable[[], bool], late: Callable[[Any], object] = lambda _: None
    ) -> Any:
        """The result of ``work``, or its error. ``given_up`` is asked again and again while it runs.

        Raises LeftBehind once that is true. ``late`` then gets the result, if it ever comes.
        """
        jobs = self._free_thread()
        job = _Job(work, late)
        jobs.put(job)
        try:
            while not job.done.wait(LOOK_S):
                if given_up() and job.leave():
                    raise LeftBehind
        except BaseException:
            # Ctrl-C may come while waiting, too.
            if job.left or job.leave():
                with self._turn:
                    self._hanging.append(job)
            raise
        self._keep(jobs)
        if job.error is not None:
            raise job.error
        return job.result

    def end(self) -> None:
        """End the idle thread; a later call begins a new one."""
        with self._turn:
            jobs, self._idle = self._idle, None
        if jobs is not None:
            jobs.put(None)

    def _free_thread(self) -> _Jobs:
        with self._turn:
            self._hanging = [job for job in self._hanging if not job.done.is_set()]
            if len(self._hanging) >= MOST_LEFT_BEHIND:
                raise LeftBehind(again=True)
            jobs, self._idle = self._idle, None
        if jobs is None:
            jobs = queue.SimpleQueue()
            threading.Thread(target=_serve, args=(jobs,), name=self._name, daemon=True).start()
            weakref.finalize(self, jobs.put, None)
        return jobs

    def _keep(self, jobs: _Jobs) -> None:
        with self._turn:
            if self._idle is None:
                self._idle = jobs
                return
        jobs.put(None)


class CallThread:
    """The thread of one device's calls, for one caller at a time.

    A call that exceeds its deadline stays behind with its thread. The next call waits for that thread to end, so that
    at most one stays behind, and a device that hangs gets no second call.

    Parameters
    ----------
    name : of the thread
    check : raises Cancelled, and the error for a passed deadline (``Deadline.check``)
    closed : the error of a call after ``close``
    at_end : called on each thread when it ends; releases what its calls have opened
    """

    def __init__(
        self,
        name: str,
        *,
        check: Callable[[Deadline], object],
        closed: Callable[[], DeviceError],
        at_end: Callable[[], object] = lambda: None,
    ) -> None:
        self._name, self._check, self._closed_error, self._at_end = name, check, closed, at_end
        self._turn = threading.Lock()
        self._starting = threading.Lock()
        self._running: tuple[threading.Thread, _Jobs] | None = None
        self._left_behind: threading.Thread | None = None
        self._closed = False

    def run(self, work: Callable[[Deadline], Result], deadline: Deadline) -> Result:
        """The result of ``work``, or its error. It gets a deadline that is cancelled when its caller gives up.

        Raises what ``check`` raises, and the error of ``closed``.
        """
        check = partial(self._check, deadline)
        with turn(self._turn, deadline, check):
            check()
            self.require_open()
            given_up = threading.Event()
            theirs = Deadline(deadline.at_s, given_up, deadline.time)
            if self._left_behind is not None:
                while not _ended(self._left_behind, min(SLICE_S, deadline.left_s())):
                    check()
                self._left_behind = None
            job = _Job(partial(work, theirs), late=lambda _: None)
            thread = self._start(job)
            try:
                while not job.done.wait(min(SLICE_S, deadline.left_s())):
                    check()
            except BaseException:
                given_up.set()
                if job.leave():
                    self._left_behind, self._running = thread, None
                raise
            if job.error is not None:
                raise job.error
            result: Result = job.result
            return result

    def require_open(self) -> None:
        """Raises the error of ``closed`` after ``close``."""
        if self._closed:
            raise self._closed_error()

    def close(self, patience_s: float) -> None:
        """End the thread; a hanging call is left behind after ``patience_s``. Harmless when called twice."""
        with self._starting:
            self._closed = True
            running, self._running = self._running, None
        if running is not None:
            thread, jobs = running
            jobs.put(None)
            thread.join(patience_s)

    def _start(self, job: _Job) -> threading.Thread:
        """The thread that does ``job``; none is made, and none gets a job, once ``close`` has looked for it."""
        with self._starting:
            self.require_open()
            if self._running is None:
                jobs: _Jobs = queue.SimpleQueue()
                thread = threading.Thread(target=_serve, args=(jobs, self._at_end), name=self._name, daemon=True)
                thread.start()
                self._running = thread, jobs
            thread, jobs = self._running
            jobs.put(job)
            return thread


def _ended(thread: threading.Thread, seconds: float) -> bool:
    thread.join(seconds)
    return not thread.is_alive()


def _serve(jobs: _Jobs, at_end: Callable[[], object] = lambda: None) -> None:
    """Do jobs until there are no more, or until one was left behind."""
    while (job := jobs.get()) is not None:
        job.run()
        if job.left:
            break
        del job  # an idle thread keeps no device alive
    at_end()
