"""Faults of an emulated device's wire: knobs, which a test or a script of velatura-lab turns."""

from __future__ import annotations

import threading
from dataclasses import dataclass, replace
from typing import Any, Protocol


@dataclass(slots=True)
class FaultCounts:
    """Knobs of which some are counts, which go down as they are used."""

    def take(self, name: str) -> bool:
        """Use up one of a count; False when none is left."""
        left: int = getattr(self, name)
        if left > 0:
            setattr(self, name, left - 1)
        return left > 0


@dataclass(frozen=True, slots=True)
class WireFaults:
    """How the wire misbehaves now.

    ``silent``: nothing is answered; ``garbage``: answers are noise; ``slow_s``: seconds before every answer;
    ``drop``, ``cut``, ``garble``: that many next answers are lost on the way, end in the middle, or become noise;
    ``late_s``: seconds before the next answer alone; ``busy``: every command is refused for now.
    """

    silent: bool = False
    garbage: bool = False
    slow_s: float = 0.0
    drop: int = 0
    busy: bool = False
    cut: int = 0
    garble: int = 0
    late_s: float = 0.0


class Faults:
    """Thread-safe holder of ``WireFaults``: a bench or a test sets, an emulator's thread reads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._now = WireFaults()

    @property
    def now(self) -> WireFaults:
        with self._lock:
            return self._now

    def set(self, **knobs: Any) -> None:
        """Turn some knobs, by the names of ``WireFaults``; the others stay. TypeError for a name it has not."""
        with self._lock:
            self._now = replace(self._now, **knobs)

    def clear(self) -> None:
        with self._lock:
            self._now = WireFaults()

    def loses_this_one(self) -> bool:
        """Whether the answer about to be sent is lost; counts ``drop`` down."""
        with self._lock:
            if self._now.silent:
                return True
            if self._now.drop > 0:
                self._now = replace(self._now, drop=self._now.drop - 1)
                return True
            return False

    def bent(self, answer: bytes) -> tuple[bytes, float]:
        """An answer about to be sent, as the wire carries it, and the seconds that it takes; uses up what counts."""
        with self._lock:
            now = self._now
            self._now = replace(now, cut=max(0, now.cut - 1), garble=max(0, now.garble - 1), late_s=0.0)
        if now.garbage or now.garble:
            answer = noise(answer)
        if now.cut:
            answer = answer[: len(answer) // 2]
        return answer, now.slow_s + now.late_s


def noise(answer: bytes) -> bytes:
    """Bytes of the same length that mean nothing, with the line end kept so that they look like an answer."""
    return bytes((byte * 7 + 0x81) & 0xFF | 0x80 for byte in answer[:-1]) + answer[-1:]


class FaultScript(Protocol):
    """Turns the knobs of one device. Its emulator calls ``tick`` often, and ``heard`` for every message."""

    def tick(self) -> None: ...

    def heard(self, count: int) -> None: ...
