"""Calls of code that may never return: they run on a thread that can be left behind."""

from __future__ import annotations

import contextlib
import queue
import threading
import weakref
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Final

LOOK_S: Final = 0.1
"""Time between two looks at whether to go on waiting."""
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


def _serve(jobs: _Jobs) -> None:
    while (job := jobs.get()) is not None:
        job.run()
        if job.left:
            return
        del job  # an idle thread keeps no device alive
