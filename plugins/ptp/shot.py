"""One press of a camera's button with its results, and the driver's time limits."""

from __future__ import annotations

import time
from dataclasses import dataclass, field

from hal.errors import DeviceError, DeviceGone, DeviceTimeout


@dataclass(frozen=True, slots=True)
class Timing:
    """The driver's time limits, in seconds.

    ``answer_s``: for an ordinary answer; ``confirm_s``: for the report of a setting; ``busy_s``: with a busy camera;
    ``margin_s``: for a picture, beyond twice its exposure; ``grace_s``: for an event, before its information is
    requested; ``come_back_s``: for a camera to answer when it is opened or was lost, ``reconnect_s``: the same during
    a picture; ``keep_alive_s``: between two signs of life while it works, ``idle_s``: without any call; ``slow_s``: an
    answer that took longer is noted.
    """

    answer_s: float = 15.0
    confirm_s: float = 5.0
    busy_s: float = 20.0
    margin_s: float = 15.0
    grace_s: float = 1.0
    come_back_s: float = 2.0
    reconnect_s: float = 30.0
    keep_alive_s: float = 5.0
    idle_s: float = 20.0
    slow_s: float = 2.0


@dataclass(frozen=True, slots=True)
class Picture:
    """A file on the camera; ``waiting`` in its memory until its transfer is confirmed, else on the card."""

    handle: int
    format: int
    size: int
    filename: str
    waiting: bool = False


@dataclass(slots=True)
class Shot:
    """One press of the button. ``fired`` from just before the request until the camera reports that it did nothing.

    ``known``: handles on the card before it; ``recovering``: the connection was lost since; ``held``: the shutter is
    open and waits to be closed by us (bulb).
    """

    exposure_s: float
    known: frozenset[int] = frozenset()
    fired: bool = False
    fired_at_s: float = 0.0
    waiting_since_s: float = 0.0
    recovering: bool = False
    held: bool = False
    found: dict[int, Picture] = field(default_factory=dict)

    def fire(self) -> None:
        self.fired = True
        self.fired_at_s = self.waiting_since_s = time.monotonic()

    def not_fired(self) -> None:
        self.fired = False

    def resume(self) -> None:
        """Search for the picture on a new connection."""
        self.recovering = True
        self.waiting_since_s = time.monotonic()
        self.found.clear()

    def age_s(self) -> float:
        """Seconds since the button was pressed."""
        return time.monotonic() - self.fired_at_s

    def overdue(self, timing: Timing) -> bool:
        """Whether the picture is overdue: after twice its exposure and a margin."""
        return time.monotonic() - self.waiting_since_s > 2 * self.exposure_s + timing.margin_s

    def missing(self) -> DeviceError:
        """The error for a picture that was fired and did not come, or was exposed for too long."""
        if self.held:
            return DeviceGone(
                "camera-bulb-cut",
                what="The connection to the camera was lost during a long exposure, so its exposure time is wrong.",
                remedy="Check cable, network and battery, then take this picture again.",
            )
        if self.recovering:
            return DeviceGone(
                "camera-shot-lost",
                what="The connection to the camera was lost during a picture, and the camera has no new picture.",
                remedy="Check cable, network and battery, then take this picture again. It was not taken twice.",
            )
        return DeviceTimeout(
            "camera-no-picture",
            what="The camera was released, but no picture came in time.",
            remedy="Check that its lens is on manual focus and its drive mode on single shot, then take it again.",
        )
