"""The lamp of an emulated projector: strike, warm-up, light, cooling, hours, how it fails, and a profile of its times.

The optical bench asks ``light_level``; the wire emulators strike and extinguish. Times are of the emulated lamp, not of
any driver's opinion of it.
"""

from __future__ import annotations

import enum
import math
import re
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib import resources
from typing import Final

from hal.errors import PluginError
from plugins.emulated.core.truth import DEFAULT_BOARD

FIRST_LIGHT: Final = 0.3
"""Share of full light right after the strike: an arc lamp starts dim and brightens while it warms."""


class LampPhase(enum.Enum):
    """What a lamp does: dark and cool, struck but not at full light, at full light, dark but hot."""

    STANDBY = "standby"
    WARMING = "warming"
    LIT = "lit"
    COOLING = "cooling"


@dataclass(frozen=True, slots=True)
class LampTiming:
    """Seconds from strike to full light, and from off to standby.

    ``drift``: share of light more at first, which falls by e in each ``drift_s``.
    """

    warm_up_s: float
    cool_down_s: float
    drift: float = 0.0
    drift_s: float = 300.0


class EmulatedLamp:
    """One lamp with its thermal state. Thread-safe; phases follow from the clock, nothing runs in the background.

    Parameters
    ----------
    timing : how long it warms and cools
    hours : burning hours on its counter at the start
    clock : seconds that only go up
    """

    def __init__(
        self, timing: LampTiming, *, hours: float = 1200.0, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._timing = timing
        self.clock = self._clock = clock
        self._lock = threading.RLock()
        self._lit_since: float | None = None
        self._off_since: float | None = None
        self._hours = hours
        self._mains = True
        self.strikes = 0
        self.shutter_closed = False
        self.failed = False
        self.too_hot = False
        self.damages = 0
        """How often its mains were cut before it had cooled: the fans stop, and the heat stays in the lamp."""
        self.passing: Callable[[], float] = lambda: 1.0
        """The share of its light that what stands before the lens lets through: a douser's."""

    def strike(self) -> bool:
        """Try to light the lamp; False while it cools or is too hot. Harmless when it burns already.

        A failed lamp takes the strike and stays dark.
        """
        with self._lock:
            if self.burning:
                return True
            if self.phase is LampPhase.COOLING or self.too_hot or not self._mains:
                return False
            self.strikes += 1
            if not self.failed:
                self._lit_since = self._clock()
            return True

    def extinguish(self) -> None:
        """Put the lamp out; it cools from now. Harmless when it is out."""
        with self._lock:
            if self._lit_since is not None:
                self._hours += (self._clock() - self._lit_since) / 3600
                self._lit_since, self._off_since = None, self._clock()

    @property
    def phase(self) -> LampPhase:
        with self._lock:
            now = self._clock()
            if self._lit_since is not None:
                warming = now - self._lit_since < self._timing.warm_up_s
                return LampPhase.WARMING if warming else LampPhase.LIT
            if self._off_since is not None and now - self._off_since < self._timing.cool_down_s:
                return LampPhase.COOLING
            return LampPhase.STANDBY

    @property
    def burning(self) -> bool:
        """Whether it warms or is lit."""
        return self.phase in (LampPhase.WARMING, LampPhase.LIT)

    @property
    def faulty(self) -> bool:
        """Whether its projector reports an error: it should burn, and the lamp failed or is too hot."""
        with self._lock:
            return not self.burning and (self.too_hot or (self.failed and self.strikes > 0))

    def light_level(self) -> float:
        """Share of the projector's full light: 0 when dark or behind shutter or douser, rising while it warms; then
        drifting towards 1.
        """
        with self._lock:
            if self._lit_since is None or self.shutter_closed:
                return 0.0
            burning_s = self._clock() - self._lit_since
            drift = 1.0 + self._timing.drift * math.exp(-burning_s / self._timing.drift_s)
            drift *= self.passing()
            if self._timing.warm_up_s <= 0:
                return drift
            warmth = min(1.0, burning_s / self._timing.warm_up_s)
            return drift * (FIRST_LIGHT + (1.0 - FIRST_LIGHT) * warmth)

    @property
    def hours(self) -> int:
        with self._lock:
            burning = 0.0 if self._lit_since is None else (self._clock() - self._lit_since) / 3600
            return int(self._hours + burning)

    def fail(self) -> None:
        """The lamp bursts: dark from now, and at every later strike until ``repair``."""
        with self._lock:
            self.failed = True
            self.extinguish()

    def overheat(self) -> None:
        """The thermal switch puts the lamp out and refuses strikes until ``repair``."""
        with self._lock:
            self.too_hot = True
            self.extinguish()

    def repair(self) -> None:
        """A new lamp is in, or the housing has cooled."""
        with self._lock:
            self.failed = self.too_hot = False

    def cut_mains(self) -> None:
        """The lamp goes dark at once. One that burned or cooled is damaged, and is as hot when the mains come back."""
        with self._lock:
            if not self._mains:
                return
            hot = self.phase is not LampPhase.STANDBY
            self.damages += hot
            self.extinguish()
            self._off_since = self._clock() if hot else None
            self._mains = False

    def restore_mains(self) -> None:
        """Standby; where it was cut hot, its fans begin to cool it only now."""
        with self._lock:
            if not self._mains and self._off_since is not None:
                self._off_since = self._clock()
            self._mains = True
            self.shutter_closed = False

    def warm_now(self) -> None:
        """Skip the waiting, for a bench that starts with a burning projector: lit and fully warm."""
        with self._lock:
            self._lit_since = self._clock() - self._timing.warm_up_s
            self._off_since = None


_TIMING_S = {
    # An emulated projector answers at once, but the machine that it is emulated on may be loaded.
    "answer_s": 2.0,
    "late_s": 3.0,
    "command_s": 3.0,
    "confirm_s": 15.0,
    "interval_s": 0.005,
    "boot_interval_s": 0.05,
}


def quick_profile(lamp: LampTiming, *, base: str = DEFAULT_BOARD, stable_s: float | None = None) -> str:
    """The TOML text of the shipped profile ``base`` with the times of an emulated lamp.

    ``stable_s`` is the time from strike to photometric stability (default: the warm-up time). Raises
    PluginError("profile-unchanged") if the shipped file lacks a key that must be shortened.
    """
    text = (resources.files("firmware_configs") / "projectors" / f"{base}.toml").read_text(encoding="utf-8")
    times = {
        **_TIMING_S,
        "warm_up_s": lamp.warm_up_s,
        "stable_s": max(lamp.warm_up_s, stable_s or 0.0),
        "cool_down_s": lamp.cool_down_s,
        "minimum_off_s": lamp.cool_down_s,
    }
    for key, seconds in times.items():
        text, count = re.subn(rf"(?m)^{key}\s*=\s*[0-9.]+.*$", f"{key} = {float(seconds)!r}", text)
        if count != 1:
            raise PluginError(
                "profile-unchanged",
                what=f"The shipped profile {base} does not set {key} once.",
                remedy="Reinstall velatura; the profile was changed.",
            )
    return f"# Written for an emulated stage: {base} with short times.\n{text}"
