"""Waiting for what happens elsewhere: in another thread, another process, on another machine."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager


def eventually(so: Callable[[], object], *, within_s: float = 30.0, every_s: float = 0.02) -> bool:
    """Whether it becomes so; ``within_s`` is long for a loaded machine, and is waited in full only if it does not."""
    ends_s = time.monotonic() + within_s
    while not so():
        if time.monotonic() > ends_s:
            return False
        time.sleep(every_s)
    return True


def wait_for(so: Callable[[], object], *, within_s: float = 30.0, every_s: float = 0.02) -> None:
    assert eventually(so, within_s=within_s, every_s=every_s), f"it did not happen within {within_s:g} s"


@contextmanager
def meanwhile(do: Callable[[], object], *, every_s: float = 0.0) -> Iterator[None]:
    """Another thread does it again and again."""
    over = threading.Event()

    def doing() -> None:
        while not over.wait(every_s):
            do()

    thread = threading.Thread(target=doing)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()
