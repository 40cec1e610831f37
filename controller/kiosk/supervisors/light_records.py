"""Hours and strikes of each lamp, day by day, in one file of the stage."""

from __future__ import annotations

import json
import math
import threading
import time
from collections.abc import Callable, Sequence
from datetime import date
from pathlib import Path
from typing import Any, Final

from controller.core.errors import VelaturaError
from controller.core.files import read_bytes
from controller.core.storage import write_atomically
from controller.kiosk.state import Lamp
from controller.kiosk.values import LampDay

FILE: Final = "kiosk/lamps.json"
MOST_DAYS: Final = 400
EVERY_S: Final = 600.0


class LampHistory:
    """Thread-safe. A disk error loses history, and nothing else."""

    def __init__(self, stage: Path, *, monotonic: Callable[[], float] = time.monotonic) -> None:
        self._path, self._monotonic = stage / FILE, monotonic
        self._lock = threading.Lock()
        self._days = _read(self._path)
        self._next_s = float("-inf")

    def days(self) -> Sequence[LampDay]:
        """Oldest first."""
        with self._lock:
            return list(self._days)

    def note(self, lamps: Sequence[Lamp], today: date, *, now: bool = False) -> None:
        """Record the lamps' counters; saved every ten minutes, or at once if ``now``."""
        if not now and self._monotonic() < self._next_s:
            return
        self._next_s = self._monotonic() + EVERY_S
        with self._lock:
            for lamp in lamps:
                self._add(LampDay(lamp.projector, today.isoformat(), round(lamp.hours, 2), lamp.strikes))
            content = [[row.projector, row.day, row.hours, row.strikes] for row in self._days]
        try:
            write_atomically(self._path, json.dumps(content).encode())
        except (OSError, VelaturaError):
            # Tried again in ten minutes; the event log reports the disk error.
            return

    def _add(self, entry: LampDay) -> None:
        own = [row for row in self._days if row.projector == entry.projector]
        last = own[-1] if own else None
        if entry.strikes == 0 or (last is not None and (last.hours, last.strikes) == (entry.hours, entry.strikes)):
            return
        others = [row for row in self._days if row.projector != entry.projector]
        kept = [row for row in own if row.day != entry.day][-(MOST_DAYS - 1) :]
        self._days = sorted([*others, *kept, entry], key=lambda row: row.day)


def _read(path: Path) -> list[LampDay]:
    try:
        rows: Any = json.loads(read_bytes(path))
        return [LampDay(str(name), str(day), float(hours), int(strikes)) for name, day, hours, strikes in rows]
    except (OSError, ValueError, TypeError, RecursionError):
        return []


DOSE_FILE: Final = "kiosk/dose.json"
SAVED_EVERY_S: Final = 600.0
LONGEST_GAP_S: Final = 3600.0
"""Between two readings: a job that has the sensor for itself. Light in a longer gap is not known, and not counted."""


class LightDose:
    """Thread-safe. A disk error loses what came since the last save, and nothing else."""

    def __init__(self, stage: Path, *, monotonic: Callable[[], float] = time.monotonic) -> None:
        self._path, self._monotonic = stage / DOSE_FILE, monotonic
        self._lock = threading.Lock()
        self._lux_s = 3600 * _read_dose(self._path)
        self._last: tuple[float, float] | None = None
        self._next_s = monotonic() + SAVED_EVERY_S

    @property
    def lux_hours(self) -> float:
        """All light since the first reading ever, in lux hours."""
        with self._lock:
            return self._lux_s / 3600

    def add(self, lux: float) -> None:
        """Add the light since the reading before, taken as bright as the brighter of both; saved every ten minutes."""
        now_s, lux = self._monotonic(), max(lux, 0.0) if math.isfinite(lux) else 0.0
        with self._lock:
            if self._last is not None and now_s - self._last[0] <= LONGEST_GAP_S:
                self._lux_s += (now_s - self._last[0]) * max(lux, self._last[1])
            self._last = now_s, lux
        if now_s >= self._next_s:
            self.save()

    def save(self) -> None:
        """Write it to the disk, if anything was measured."""
        self._next_s = self._monotonic() + SAVED_EVERY_S
        if self._last is None:
            return
        try:
            write_atomically(self._path, json.dumps({"lux_hours": round(self.lux_hours, 3)}).encode())
        except (OSError, VelaturaError):
            # Tried again in ten minutes; the event log reports the disk error.
            return


def _read_dose(path: Path) -> float:
    try:
        content: Any = json.loads(read_bytes(path))
        found = float(content["lux_hours"])
    except (OSError, ValueError, TypeError, KeyError, RecursionError):
        return 0.0
    return found if math.isfinite(found) and found > 0 else 0.0
