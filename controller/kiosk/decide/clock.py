"""The time to plan with: the wall clock, checked against its earlier values and its synchronisation."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Callable, Collection
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Final, Protocol

from controller.kiosk.decide.planner import DOUBT_S, EARLIEST_S, HOLD_S, Plan, believed, plan
from controller.kiosk.store.event_log import EventLog
from controller.kiosk.values import Schedule
from hal.notices import Level, Notice

_UNSYNCHRONISED: Final = 0x40
_KEEP_EVERY_S: Final = 60.0
_PROVE_S: Final = 3600.0
"""A clock that jumped far ahead is trusted only after this time, so that a glitch leaves no trace. So is one that was
set far back while this service ran.
"""
_DOUBT_AT_MOST_S: Final = 86_400.0
"""A clock that begins far back, and then runs for so long, is trusted: it would be doubted for years."""
_SET_S: Final = 30.0
"""A clock that jumps by more than this between two checks was set; NTP moves it by less."""


def synchronised() -> bool:
    """Whether the kernel reports a synchronised clock (adjtimex(2), STA_UNSYNC)."""
    # struct timex begins with modes, offset, freq, maxerror, esterror, status; 256 bytes hold all of it.
    buffer = (ctypes.c_long * 32)()
    try:
        state = ctypes.CDLL(None, use_errno=True).adjtimex(ctypes.byref(buffer))
    except (OSError, AttributeError):
        return False
    status = ctypes.cast(ctypes.byref(buffer, 5 * ctypes.sizeof(ctypes.c_long)), ctypes.POINTER(ctypes.c_int))[0]
    return bool(state >= 0 and not status & _UNSYNCHRONISED) and os.name == "posix"


class TrustedClock:
    """The time to plan with; remembers the latest one over restarts. ``monotonic``: seconds that only go up."""

    def __init__(
        self,
        log: EventLog,
        wall: Callable[[], float],
        monotonic: Callable[[], float],
        is_synchronised: Callable[[], bool] = synchronised,
    ) -> None:
        self._log, self._wall, self._synchronised = log, wall, is_synchronised
        self.monotonic = monotonic
        kept = log.value("latest")
        self._latest: float | None = None if kept is None else float(kept)
        self._kept = self._latest
        before_leap = log.value("before-leap")
        self._before_leap = float(before_leap) if before_leap else None
        """The time before the clock was believed to be far ahead: a clock between both takes that back."""
        self._ahead_since_s: float | None = None
        self._behind_since_s: float | None = None
        self._set_here = False
        self._known: bool | None = None
        self._offset_s: float | None = None

    def now(self) -> float | None:
        """Unix seconds to plan with, or None while the time is unknown; logs when that changes."""
        wall_s = self._wall()
        self._check_jump(wall_s - self.monotonic())
        now_s = believed(wall_s, self._latest, synchronised=self._synchronised() or self._corrected(wall_s))
        if (now_s is not None) is not self._known and (self._known is not None or now_s is None):
            self._log.add(_LOST if now_s is None else _FOUND)
        self._known = now_s is not None
        if now_s is not None and self._proven(now_s):
            if self._latest is not None and abs(now_s - self._latest) > DOUBT_S:
                self._before_leap = self._latest if now_s > self._latest else None
                self._log.keep("before-leap", "" if self._before_leap is None else repr(self._before_leap))
            self._latest = now_s
            if self._kept is None or abs(now_s - self._kept) >= _KEEP_EVERY_S:
                self._kept = now_s
                self._log.keep("latest", repr(now_s))
        return now_s

    @property
    def since_s(self) -> float:
        """When this stage first knew the time; infinite before."""
        kept = self._log.value("since")
        if kept is None and self._latest is not None:
            kept = repr(self._latest)
            self._log.keep("since", kept)
        if kept is not None and self._latest is not None and float(kept) > self._latest:
            kept = repr(self._latest)  # the clock was ahead then: what is due each night would wait for years
            self._log.keep("since", kept)
        return float("inf") if kept is None else float(kept)

    def _corrected(self, wall_s: float) -> bool:
        """Whether a clock that is far behind the latest time is right all the same: that time was wrong."""
        if self._latest is None or self._latest - wall_s <= DOUBT_S or wall_s < EARLIEST_S:
            self._behind_since_s, self._set_here = None, False
            return False
        if self._behind_since_s is None:
            self._behind_since_s = self.monotonic()
        lasted_s = self.monotonic() - self._behind_since_s
        if lasted_s >= (_PROVE_S if self._set_here else _DOUBT_AT_MOST_S):
            return True
        return self._before_leap is not None and wall_s >= self._before_leap

    def _check_jump(self, offset_s: float) -> None:
        before_s, self._offset_s = self._offset_s, offset_s
        if before_s is not None and abs(offset_s - before_s) > _SET_S:
            self._log.add(_set(offset_s - before_s))
            self._set_here |= offset_s < before_s

    def _proven(self, now_s: float) -> bool:
        if self._latest is None or now_s - self._latest <= DOUBT_S or self._synchronised():
            self._ahead_since_s = None
            return True
        if self._ahead_since_s is None:
            self._ahead_since_s = self.monotonic()
        return self.monotonic() - self._ahead_since_s >= _PROVE_S


class Hours(Protocol):
    """The opening hours in use; ``open_without_time``: whether the stage is open while the time is unknown."""

    @property
    def now(self) -> Schedule: ...

    @property
    def open_without_time(self) -> bool: ...


@dataclass(frozen=True, slots=True)
class Timetable:
    """The opening hours and the time, from which the plan follows."""

    hours: Hours
    clock: TrustedClock

    def plan(self, done: Collection[str]) -> Plan:
        """What is wanted now; ``done``: the keys of the tasks that were done or skipped."""
        return plan(self.clock.now(), self.hours.now, done, since_s=self.clock.since_s)


def beginning(log: EventLog) -> Notice:
    """What a starting service logs, so that the log explains the time without one."""
    last = next((row.code for row in reversed(log.after(0)) if row.code in (_BEGAN, "service-ended")), "")
    if last != _BEGAN:
        return Notice(_BEGAN, "The kiosk is starting.")
    latest = log.value("latest")
    when = "" if latest is None else f" after {datetime.fromtimestamp(float(latest), UTC):%Y-%m-%d %H:%M} UTC"
    return Notice(
        _BEGAN, f"The kiosk is starting. The previous run ended unexpectedly{when}.",
        "If there was no power cut, check the system log.", Level.WARNING,
    )  # fmt: skip


def _set(by_s: float) -> Notice:
    how = f"The clock was set {'forward' if by_s > 0 else 'back'} by {_span(abs(by_s))}."
    held = -HOLD_S <= by_s < 0
    then = "The schedule waits until the clock has caught up." if held else ""
    return Notice("clock-set", how, then, Level.WARNING)


def _span(seconds: float) -> str:
    return f"{seconds / 86_400:.0f} days" if seconds > 2 * 86_400 else f"{max(1, round(seconds / 60))} min"


_BEGAN: Final = "service-started"
_LOST: Final = Notice(
    "clock-unknown",
    "The system time is unknown.",
    "Set the clock, or connect the network. Until then without_time under [schedule] applies.",
    Level.ERROR,
)
_FOUND: Final = Notice("clock-known", "The system time is known again.")
