"""Deadlines and cancellation: every blocking call takes a ``Deadline``."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Final, Protocol

from hal.errors import DeviceError, DeviceTimeout

SLICE_S: Final = 0.05
"""Longest single wait, so that a cancelled call ends soon."""


class Time(Protocol):
    """What deadlines measure time with; the module ``time`` is one."""

    def monotonic(self) -> float: ...

    def sleep(self, seconds: float, /) -> None: ...


class Cancelled(DeviceError):
    """The caller asked for the work to stop."""

    def __init__(self) -> None:
        super().__init__("cancelled", what="The work was stopped on request.", remedy="Start it again to continue.")


class Stop(threading.Event):
    """A request to stop the work. ``urgent``: it was made again, so wait for no driver that does not answer.

    ``restarting``: the program is started again at once.
    """

    def __init__(self) -> None:
        super().__init__()
        self.urgent = False
        self.restarting = False

    def again(self) -> None:
        """Ask; the second time it is urgent."""
        self.urgent = self.is_set()
        self.set()


@dataclass(frozen=True, slots=True)
class Deadline:
    """The time on the monotonic clock by which a call must end, and an event to end it sooner.

    ``at_s`` is in seconds of ``time.monotonic()``; ``cancel``, if given, is shared with code that may stop the work.
    """

    at_s: float
    cancel: threading.Event | None = field(default=None, compare=False)
    time: Time = field(default=time, compare=False, repr=False)

    def left_s(self) -> float:
        """Seconds left, never negative."""
        return max(0.0, self.at_s - self.time.monotonic())

    @property
    def passed(self) -> bool:
        return self.time.monotonic() >= self.at_s

    def within(self, seconds: float) -> Deadline:
        """The earlier of this deadline and ``seconds`` from now, with the same cancellation."""
        return Deadline(min(self.at_s, self.time.monotonic() + seconds), self.cancel, self.time)

    def check(self, code: str, *, what: str, remedy: str) -> None:
        """Raise ``Cancelled`` if cancelled and ``DeviceTimeout`` with these sentences if passed."""
        if self.cancel is not None and self.cancel.is_set():
            raise Cancelled
        if self.passed:
            raise DeviceTimeout(code, what=what, remedy=remedy)

    def sleep(self, seconds: float) -> None:
        """Sleep at most ``seconds``, at most until the deadline; raise ``Cancelled`` as soon as cancelled."""
        wait_s = min(seconds, self.left_s())
        if self.cancel is None:
            self.time.sleep(wait_s)
        elif self.cancel.wait(wait_s):
            raise Cancelled


@contextlib.contextmanager
def turn(lock: threading.Lock | threading.RLock, deadline: Deadline, check: Callable[[], object]) -> Iterator[None]:
    """Hold ``lock``. ``check`` is called while waiting for it.

    It raises Cancelled, and the error for a passed ``deadline`` (``Deadline.check``).
    """
    while not lock.acquire(timeout=min(SLICE_S, deadline.left_s())):
        check()
    try:
        yield
    finally:
        lock.release()


def in_seconds(seconds: float, cancel: threading.Event | None = None) -> Deadline:
    """A deadline ``seconds`` from now."""
    return Deadline(time.monotonic() + seconds, cancel)
