"""Work on several projectors at the same time, as far as cores and memory allow."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Final, TypeVar

from hal.runtime.compute import threads_may_compute, usable_cpus
from hal.runtime.memory import free_bytes

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


def threads_at_once(bytes_each: int) -> int:
    """How many threads have a core and ``bytes_each`` of memory."""
    if not threads_may_compute():
        return 1
    free = free_bytes()
    return usable_cpus() if free is None else max(1, min(usable_cpus(), int(MOST_MEMORY * free) // max(bytes_each, 1)))


__all__ = ["side_by_side", "threads_at_once"]
