"""Time: the grid of moments at which pictures change, precise waiting, and how evenly the changes came."""

from __future__ import annotations

import math
import time
from collections import deque
from typing import Final

_KEPT_INTERVALS: Final = 8192


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
    """The latest intervals between presentations of one sequence, in seconds."""

    def __init__(self) -> None:
        self._kept: deque[float] = deque(maxlen=_KEPT_INTERVALS)
        self._last_s: float | None = None

    def presented(self, moment_s: float) -> None:
        if self._last_s is not None:
            self._kept.append(moment_s - self._last_s)
        self._last_s = moment_s

    def percentile(self, percent: float) -> float | None:
        """The interval that ``percent`` of all do not exceed (nearest rank), or None before the second picture."""
        if not self._kept:
            return None
        ordered = sorted(self._kept)
        return ordered[min(len(ordered) - 1, max(0, math.ceil(percent / 100 * len(ordered)) - 1))]
