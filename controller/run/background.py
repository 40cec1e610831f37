"""Calculations in threads: steps beside the steps that use devices, and work on several projectors at once."""

from __future__ import annotations

import contextlib
import queue
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Final, TypeVar

from controller.run.step_id import StepId
from hal.deadline import SLICE_S, Deadline
from hal.runtime.compute import free_bytes, threads_may_compute, usable_cpus

Advance = Callable[[float, str], None]
Work = Callable[[int, Advance, Deadline], bool]
"""Does the step of a number, reports its progress, and stops at its deadline; False: an earlier run had done it."""
PATIENCE_S: Final = 5.0
"""How long a run that failed waits until its calculation notices."""


class BackgroundSteps:
    """A thread for steps, begun with the first one.

    Parameters
    ----------
    work : does one step; is called in the thread
    deadline : of the run; the steps get one that also ends when the run has failed
    """

    def __init__(self, work: Work, deadline: Deadline) -> None:
        self._work, self._stop = work, EitherEvent(deadline.cancel)
        self._deadline = Deadline(deadline.at_s, self._stop, deadline.time)
        self._waiting: queue.SimpleQueue[int | None] = queue.SimpleQueue()
        self._finished: queue.SimpleQueue[tuple[int, bool]] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None
        self._left: dict[int, StepId] = {}
        self._fraction = 0.0
        self._error: BaseException | None = None

    def begin(self, number: int, step: StepId) -> None:
        """Do the step after those that were begun before."""
        self._left[number] = step
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name="velatura-calculates", daemon=True)
            self._thread.start()
        self._waiting.put(number)

    def check(self) -> None:
        """Raise the error of a step that failed."""
        if self._error is not None:
            raise self._error

    def finished(self) -> list[tuple[int, bool]]:
        """Number of each step that is done since the last call, and whether it was done now. Raises as ``check``."""
        self.check()
        found = []
        with contextlib.suppress(queue.Empty):
            while True:
                found.append(self._finished.get_nowait())
        for number, _ in found:
            del self._left[number]
        return found

    def awaited(self, steps: Sequence[StepId] | None) -> tuple[int, float] | None:
        """Number and progress (0..1) of the step that runs, if one of ``steps`` (None: any) is not ``finished``."""
        if not self._left or (steps is not None and not set(steps) & set(self._left.values())):
            return None
        return next(iter(self._left)), self._fraction

    def wait(self) -> None:
        """A moment."""
        self._deadline.time.sleep(SLICE_S)

    @contextlib.contextmanager
    def ending(self) -> Iterator[None]:
        """Ends the thread. After an error its step is asked to stop, and waited for only a little."""
        try:
            yield
        except BaseException:
            self._stop.set()
            self._join(PATIENCE_S)
            raise
        self._join(None)

    def _join(self, patience_s: float | None) -> None:
        if self._thread is not None:
            self._waiting.put(None)
            self._thread.join(patience_s)

    def _run(self) -> None:
        try:
            while (number := self._waiting.get()) is not None and not self._stop.is_set():
                done_now = self._work(number, self._advance, self._deadline)
                self._fraction = 0.0  # of the next one, which may be looked at once this one is finished
                self._finished.put((number, done_now))
        except BaseException as error:  # noqa: BLE001 - it is raised in the run's own thread
            self._error = error

    def _advance(self, fraction: float, note: str) -> None:
        self._fraction = max(self._fraction, min(1.0, fraction))


class EitherEvent(threading.Event):
    """Set by itself, or by another event."""

    def __init__(self, other: threading.Event | None) -> None:
        super().__init__()
        self._other = other

    def is_set(self) -> bool:
        return super().is_set() or (self._other is not None and self._other.is_set())


T = TypeVar("T")
MOST_MEMORY: Final = 0.5
"""Of the memory that is free."""


def side_by_side(work: Callable[[int], T], count: int, *, bytes_each: int) -> Iterator[T]:
    """The results of ``work`` for 0 to ``count`` - 1, in order, each when it is done.

    Threads do it, which pays where it is mostly NumPy's and not done by all cores already.
    ``bytes_each``: how much memory one takes. Raises what ``work`` raises; then what has not begun is left.
    """
    together = min(count, threads_at_once(bytes_each))
    if together < 2:
        yield from map(work, range(count))
        return
    with ThreadPoolExecutor(together, thread_name_prefix="velatura-side-by-side") as pool:
        yield from pool.map(work, range(count))


def beside(calculation: Callable[[], T], meanwhile: Callable[[], object]) -> T:
    """The result of ``calculation``, which a thread does while ``meanwhile`` is done here.

    ``calculation`` writes nothing that is kept. One after the other where two threads may not run kernels.
    Raises what either raises; an error of ``meanwhile`` does not wait for the calculation.
    """
    if not threads_may_compute():
        found = calculation()
        meanwhile()
        return found
    future: Future[T] = Future()

    def run() -> None:
        try:
            future.set_result(calculation())
        except BaseException as error:  # noqa: BLE001 - it is raised to the caller
            future.set_exception(error)

    threading.Thread(target=run, name="velatura-beside", daemon=True).start()
    meanwhile()
    return future.result()


def threads_at_once(bytes_each: int) -> int:
    """How many threads have a core and ``bytes_each`` of memory."""
    if not threads_may_compute():
        return 1
    free = free_bytes()
    return usable_cpus() if free is None else max(1, min(usable_cpus(), int(MOST_MEMORY * free) // max(bytes_each, 1)))
