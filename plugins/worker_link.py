"""Calls of a library that may hang, with deadlines: they run on a thread of their own.

A call that exceeds its deadline stays behind with its thread. The next call waits for that thread to end before it
opens anything, so that at most one thread stays behind.
"""

from __future__ import annotations

import contextlib
import queue
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Final, Generic, TypeVar

from hal.deadline import SLICE_S, Deadline, turn
from hal.errors import DeviceError, DeviceGone, DeviceRefused, ProtocolError

Opened = TypeVar("Opened")
Result = TypeVar("Result")

_CLOSE_S: Final = 0.7
_LISTED_S: Final = 2.0
"""Time limit for a listed device that can't be opened: it was just unplugged, or udev has not applied its rules yet."""


@dataclass(slots=True)
class _Job(Generic[Result]):
    work: Callable[[_Worker[Any]], Result]
    done: threading.Event = field(default_factory=threading.Event)
    result: list[Result] = field(default_factory=list)
    error: BaseException | None = None


class _Worker(Generic[Opened]):
    """One thread and its open device. It always closes what it opened."""

    def __init__(self, close: Callable[[Opened], None]) -> None:
        self.open: Opened | None = None
        self._close = close
        self._jobs: queue.SimpleQueue[_Job[Any] | None] = queue.SimpleQueue()
        self.thread = threading.Thread(target=self._run, name="hid", daemon=True)
        self.thread.start()

    def start(self, job: _Job[Any]) -> None:
        self._jobs.put(job)

    def end(self) -> None:
        self._jobs.put(None)

    def drop(self) -> None:
        """Close the device. On the worker's thread."""
        was_open, self.open = self.open, None
        if was_open is not None:
            self._close(was_open)

    def _run(self) -> None:
        while (job := self._jobs.get()) is not None:
            try:
                job.result.append(job.work(self))
            except BaseException as error:  # noqa: BLE001 - it is raised again in the waiting thread
                job.error = error
            job.done.set()
        self.drop()


class NotOpened(DeviceRefused):
    """The device is listed, but cannot be opened."""


class WorkerLink(ABC, Generic[Opened]):
    """The connection to one device: opened when needed, and again after it was lost. One caller at a time.

    ``name``: of the device, for sentences, e.g. "relay board"; ``broken``: what the library raises when the way to the
    device breaks.
    """

    def __init__(self, name: str, *, broken: tuple[type[Exception], ...]) -> None:
        self._name = name
        self._broken = broken
        self._turn = threading.Lock()
        self._worker: _Worker[Opened] | None = None
        self._left_behind: _Worker[Opened] | None = None
        self._opening = threading.Lock()
        self._closed = False

    @abstractmethod
    def find(self) -> Opened:
        """Find and open the device; on the worker's thread. Raises DeviceError or ``broken``; nothing is open then.

        After ``NotOpened`` it is called again for a while.
        """

    @abstractmethod
    def let_go(self, opened: Opened) -> None:
        """Close the device; on the worker's thread. Raises nothing."""

    def call(self, work: Callable[[Opened], Result], *, deadline: Deadline) -> Result:
        """Do ``work`` with the open device; again if the connection had broken, so it must be repeatable.

        Raises what ``find`` and ``work`` raise, DeviceGone for one that was closed, DeviceTimeout, ProtocolError where
        the device is there and fails the transfer, or Cancelled.
        """
        with turn(self._turn, deadline, partial(self._still_time, deadline)):
            self._still_time(deadline)
            self._check_open()
            given_up = threading.Event()
            theirs = Deadline(deadline.at_s, given_up)
            return self._on_worker(lambda worker: self._try(worker, work, theirs), deadline, given_up)

    def close(self) -> None:
        """Close the device; a hanging call is left behind after 0.7 s."""
        with self._opening:
            self._closed = True
            worker, self._worker = self._worker, None
        if worker is not None:
            worker.end()
            worker.thread.join(_CLOSE_S)

    def _try(self, worker: _Worker[Opened], work: Callable[[Opened], Result], deadline: Deadline) -> Result:
        for again in (False, True):
            try:
                if worker.open is None:
                    worker.open = self._find_device(deadline)
                deadline.sleep(0.0)  # the caller has given up: a relay must not move minutes later
                return work(worker.open)
            except self._broken as error:
                worker.drop()
                if again:
                    self._check_there(worker, deadline)
                    raise self._failed(error) from error
            except ProtocolError:
                worker.drop()
                raise
        raise AssertionError

    def _find_device(self, deadline: Deadline) -> Opened:
        """``find``, but what cannot be opened is given half of the time, at most 2 s, to leave the list or to open."""
        listed = deadline.within(min(_LISTED_S, deadline.left_s() / 2))
        while True:
            try:
                return self.find()
            except NotOpened:
                if listed.passed:
                    raise
                listed.sleep(SLICE_S)

    def _check_there(self, worker: _Worker[Opened], deadline: Deadline) -> None:
        """Raises DeviceGone if the device was unplugged during the second attempt."""
        with contextlib.suppress(*self._broken):
            try:
                worker.open = self._find_device(deadline)
            except DeviceError as error:
                if isinstance(error, DeviceGone):
                    raise

    def _on_worker(
        self, work: Callable[[_Worker[Opened]], Result], deadline: Deadline, given_up: threading.Event
    ) -> Result:
        if (behind := self._left_behind) is not None:
            self._wait(lambda seconds: _ended(behind, seconds), deadline)
            self._left_behind = None
        job: _Job[Result] = _Job(work)
        worker = self._begun(job)
        try:
            self._wait(job.done.wait, deadline)
        except DeviceError:
            given_up.set()
            if not job.done.is_set():
                worker.end()
                self._left_behind, self._worker = worker, None
            raise
        if job.error is not None:
            raise job.error
        return job.result[0]

    def _begun(self, job: _Job[Result]) -> _Worker[Opened]:
        """The worker that does ``job``; none is made, and none gets a job, once ``close`` has looked for it."""
        with self._opening:
            self._check_open()
            worker = self._worker = self._worker or _Worker(self.let_go)
            worker.start(job)
        return worker

    def _check_open(self) -> None:
        if self._closed:
            raise DeviceGone("hid-closed", what=f"The {self._name} was closed.", remedy=f"Open the {self._name} again.")

    def _wait(self, ready: Callable[[float], bool], deadline: Deadline) -> None:
        while not ready(min(SLICE_S, deadline.left_s())):
            self._still_time(deadline)

    def _still_time(self, deadline: Deadline) -> None:
        deadline.check(
            "hid-no-answer",
            what=f"The {self._name} did not answer in time.",
            remedy="Unplug it and plug it in again. If this happens often, use another cable or hub.",
        )

    def not_opened(self, error: Exception) -> NotOpened:
        """For ``find``: the device is listed, and ``error`` came of opening it."""
        return NotOpened(
            "hid-not-opened",
            what=f"The {self._name} is plugged in, but can't be opened ({error}).",
            remedy="Unplug it and plug it in again. If that does not help, end other programs that use it, and install"
            " firmware_configs/udev/70-velatura-hid.rules.",
        )

    def _failed(self, error: Exception) -> ProtocolError:
        return ProtocolError(
            "hid-transfer",
            what=f"The {self._name} is plugged in, but refuses commands ({error}).",
            remedy="Unplug it and plug it in again. If this happens again, replace it.",
        )


def _ended(worker: _Worker[Any], seconds: float) -> bool:
    worker.thread.join(seconds)
    return not worker.thread.is_alive()
