"""How often each source may ask: a leaky bucket for each, for the protocols of a building and the HTTP API."""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from controller.core.errors import WorkError

MOST_SOURCES: Final = 256


@dataclass(frozen=True, slots=True)
class Rate:
    """At most ``burst`` verbs at once, and ``per_s`` a second from then on, from each source."""

    burst: int = 20
    per_s: float = 10.0


class Rates:
    """What each source has used of a rate; thread-safe."""

    def __init__(self, rate: Rate, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._rate, self._clock = rate, clock
        self._used: OrderedDict[str, tuple[float, float]] = OrderedDict()
        self._lock = threading.Lock()

    def take(self, source: str) -> None:
        """Count one verb of a source, such as an address. Raises WorkError("too-many-verbs")."""
        with self._lock:
            now = self._clock()
            level, then = self._used.get(source, (0.0, now))
            level = max(0.0, level - (now - then) * self._rate.per_s)
            if level > self._rate.burst - 1:
                raise WorkError(
                    "too-many-verbs", what="Too many requests came from this source.", remedy="Send them more slowly."
                )
            self._used[source] = (level + 1, now)
            self._used.move_to_end(source)
            while len(self._used) > MOST_SOURCES:
                self._used.popitem(last=False)
