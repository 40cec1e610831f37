"""Work on several projectors at the same time, as far as cores and memory allow; a calculation beside a photograph."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Final, TypeVar

from hal.runtime.compute import free_bytes, threads_may_compute, usable_cpus

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


__all__ = ["beside", "side_by_side", "threads_at_once"]
