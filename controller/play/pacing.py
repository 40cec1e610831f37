"""Time: the grid of moments at which pictures change, precise waiting, and how evenly the changes came."""

from __future__ import annotations

import math
import time
from typing import Final

import numpy as np

_SHORTEST_S: Final = 1e-5
_CLASS: Final = 5e-4
"""Logarithm of the ratio between the intervals of neighbouring classes."""
_CLASSES: Final = 58_000


class Grid:
    """Moments k / rate on the monotonic clock, k whole: deadlines that never drift."""

    def __init__(self, rate_hz: float) -> None:
        self.rate_hz = rate_hz

    def after(self, moment_s: float) -> int:
        """The first tick that is not before ``moment_s``."""
        return math.ceil(moment_s * self.rate_hz)

    def at_s(self, tick: int) -> float:
        return tick / self.rate_hz

    def ticks(self, seconds: float) -> int:
        """How many ticks last about ``seconds``; at least one."""
        return max(1, round(seconds * self.rate_hz))


def sleep_until(moment_s: float) -> None:
    """Sleep until a monotonic moment; return at once if it has passed."""
    left_s = moment_s - time.monotonic()
    if left_s > 0:
        time.sleep(left_s)


class Intervals:
    """The intervals between presentations of one sequence, counted in classes of 0.05 % from 10 us to a year.

    However many there are, they take no more memory than these classes.
    """

    def __init__(self) -> None:
        # Written to, so that all of it is there from the beginning and nothing seems to grow later.
        self._counts = np.full(_CLASSES, 0, np.uint32)
        self._passed = np.full(_CLASSES, 0, np.uint64)
        self._last_s: float | None = None
        # A client may ask for the status ten thousand times a second, and adding up all classes takes 50 us.
        self._found: dict[float, float | None] = {}

    def presented(self, moment_s: float) -> None:
        if self._last_s is not None:
            self.add(moment_s - self._last_s)
        self._last_s = moment_s

    def add(self, seconds: float) -> None:
        ratio = max(seconds, _SHORTEST_S) / _SHORTEST_S
        self._counts[min(_CLASSES - 1, int(math.log(ratio) / _CLASS))] += 1
        self._found.clear()

    def percentile(self, percent: float) -> float | None:
        """The interval that ``percent`` of all do not exceed (nearest rank), or None before the second picture."""
        if percent not in self._found:
            self._found[percent] = self._percentile(percent)
        return self._found[percent]

    def _percentile(self, percent: float) -> float | None:
        passed = np.cumsum(self._counts, dtype=np.uint64, out=self._passed)
        if not passed[-1]:
            return None
        rank = max(1, math.ceil(percent / 100 * int(passed[-1])))
        return _SHORTEST_S * math.exp(_CLASS * (int(np.searchsorted(passed, rank)) + 0.5))
