"""Refused log-ins and tokens for the event log, as many as it bears."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any, Final

EVERY_S: Final = 10.0


class Refusals:
    """``record``: adds a line to the event log. Whoever tries many names or tokens must not push all else out of it."""

    def __init__(self, record: Callable[..., Any], clock: Callable[[], float] = time.monotonic) -> None:
        self._record, self._clock = record, clock
        self._lock = threading.Lock()
        self._told_s, self._untold = float("-inf"), 0

    def add(self, what: str) -> None:
        """``what`` without its full stop; one line in ``EVERY_S``, which counts those in between."""
        with self._lock:
            if self._clock() - self._told_s < EVERY_S:
                self._untold += 1
                return
            more, self._untold, self._told_s = self._untold, 0, self._clock()
        self._record("refused", f"{what}, and {more} before it." if more else f"{what}.", "warning")
