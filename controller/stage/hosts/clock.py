"""The common clock of several computers: the wall clock that chrony keeps, which Velatura reads and never sets.

The monotonic clock runs at the wall clock's pace, also while chrony corrects that. So the distance of both changes
only when somebody sets the wall clock. What is shown follows that only if chrony says that the new time is right.
"""

from __future__ import annotations

import subprocess
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

STEP_S: Final = 0.001
LOOK_S: Final = 2.0
_MOST_ERROR_S: Final = 0.05
"""A clock that chrony calls less sure than this is not one to follow."""
_CHRONYC: Final = ("chronyc", "-c", "tracking")


@dataclass(frozen=True, slots=True)
class Tracking:
    """What chrony says of a clock: the largest ``error_s`` that it may have, and whether it is ``synchronised``."""

    synchronised: bool
    error_s: float


def tracking(run: Callable[[Sequence[str]], str] | None = None) -> Tracking | None:
    """``chronyc -c tracking``; None without chrony. ``run`` gives what the command prints, or raises OSError."""
    try:
        fields = (run or printed)(_CHRONYC).strip().split(",")
        error_s = abs(float(fields[4])) + float(fields[10]) / 2 + float(fields[11])
        return Tracking(fields[13] != "Not synchronised", error_s)
    except (OSError, subprocess.SubprocessError, ValueError, IndexError):
        return None


def printed(command: Sequence[str]) -> str:
    """What a command says. Raises OSError, SubprocessError."""
    return subprocess.run(command, capture_output=True, text=True, timeout=2, check=True).stdout  # noqa: S603


class HostClock:
    """How far this computer's part of the common clock is ahead of its monotonic one."""

    def __init__(
        self,
        wall: Callable[[], float] = time.time,
        monotonic: Callable[[], float] = time.monotonic,
        track: Callable[[], Tracking | None] = tracking,
    ) -> None:
        self._wall, self._monotonic, self._track = wall, monotonic, track
        self.ahead_s = self._distance()
        self.stepped_s = 0.0
        self.tracking = track()
        self._looked_s = monotonic()

    def now_s(self) -> float:
        return self._monotonic() + self.ahead_s

    def look(self) -> None:
        """Every ``LOOK_S``: was the clock set, and is the new time the right one?

        ``stepped_s`` is by how much it was set away from what players follow.
        """
        if self._monotonic() - self._looked_s < LOOK_S:
            return
        self._looked_s, self.tracking = self._monotonic(), self._track()
        distance = self._distance()
        sure = self.tracking is not None and self.tracking.synchronised and self.tracking.error_s < _MOST_ERROR_S
        if sure and abs(distance - self.ahead_s) > STEP_S:
            self.ahead_s = distance
        self.stepped_s = distance - self.ahead_s if abs(distance - self.ahead_s) > STEP_S else 0.0

    @property
    def trouble(self) -> str:
        """What is wrong with it, "" if nothing."""
        if self.stepped_s:
            return f"its clock was set by {self.stepped_s:+.3f} s, and the players keep the time of before"
        if self.tracking is None:
            return "chrony does not run, so its clock may drift away from the others"
        if not self.tracking.synchronised or self.tracking.error_s > _MOST_ERROR_S:
            return "chrony has not synchronised its clock"
        return ""

    def _distance(self) -> float:
        """Wall minus monotonic: the closest of a few readings, because the process may rest in between."""
        distances = []
        for _ in range(5):
            before = self._monotonic()
            wall = self._wall()
            after = self._monotonic()
            distances.append((after - before, wall - (before + after) / 2))
        return min(distances)[1]
