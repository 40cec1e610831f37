"""Values between drivers and their callers: frozen, with units in their names."""

from __future__ import annotations

import enum
from dataclasses import dataclass
from pathlib import Path
from typing import Final


@dataclass(frozen=True, slots=True)
class DeviceIdentity:
    """A device's identity. Every string comes from the device: escape it before showing it in a page."""

    maker: str
    model: str
    serial: str = ""
    firmware: str = ""


class Power(enum.Enum):
    """Power state of a projector as reported by the device."""

    OFF = "off"
    WARMING = "warming"
    ON = "on"
    COOLING = "cooling"
    FAULT = "fault"
    UNKNOWN = "unknown"


@dataclass(frozen=True, slots=True)
class LampRules:
    """Times that protect a lamp, in seconds.

    ``warm_up_s``: from strike to light; ``stable_s``: from strike until photometric work is allowed;
    ``cool_down_s``: fans run on after off; ``minimum_off_s``: from off to the next strike.
    """

    warm_up_s: float
    stable_s: float
    cool_down_s: float
    minimum_off_s: float


@dataclass(frozen=True, slots=True)
class ProjectorCapabilities:
    """Capabilities of a projector's driver; callers use these, never the model's name.

    ``power``: it can be switched, and reports whether it is lit. Without it ``switch_on`` and ``switch_off`` raise
    DeviceRefused, and the power state is UNKNOWN or COOLING. ``answer_s``: the longest time of ``status`` in any
    state; ``switch_s``: the same for ``switch_on`` and ``switch_off``. With a shorter deadline, a healthy projector
    may time out.
    """

    lamp_hours: bool
    shutter: bool
    inputs: tuple[str, ...]
    errors: bool
    lamp_rules: LampRules
    power: bool = True
    answer_s: float = 10.0
    switch_s: float = 10.0


@dataclass(frozen=True, slots=True)
class ProjectorStatus:
    """One consistent answer about a projector. ``faults`` are the profile's words, e.g. ``"lamp-failed"``."""

    power: Power
    faults: tuple[str, ...] = ()
    lamp_hours: int | None = None


class FileKind(enum.Enum):
    RAW = "raw"
    JPEG = "jpeg"


@dataclass(frozen=True, slots=True)
class ExposureSettings:
    """Exposure of one photograph. ``aperture_f`` None: leave as it is."""

    exposure_s: float
    iso: int
    aperture_f: float | None = None
    raw: bool = True


@dataclass(frozen=True, slots=True)
class CameraCapabilities:
    """Capabilities of a camera's driver. Lists are ascending; empty means not settable.

    ``picture_s``: so many seconds beyond twice its exposure a picture takes at most, until the driver has it
    """

    exposures_s: tuple[float, ...]
    isos: tuple[int, ...]
    apertures_f: tuple[float, ...]
    raw: bool
    jpeg: bool
    live_view: bool = False
    bulb: bool = False
    picture_s: float = 15.0


@dataclass(frozen=True, slots=True)
class CameraStatus:
    """Battery and card of a camera; None for unknown values.

    ``battery_percent`` 0 to 100; ``free_bytes`` and ``free_pictures`` on its card. ``warnings``: ``"battery-low"``,
    ``"card-nearly-full"``, ``"card-unusable"``, ``"autofocus-on"``, ``"mode-dial"`` (not on M), ``"target-changed"``
    (it stored pictures at the wrong place, and the setting was sent again).
    """

    battery_percent: int | None = None
    free_bytes: int | None = None
    free_pictures: int | None = None
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class CapturedFile:
    """A file of one photograph, complete and fsynced. ``sha256`` is the hex digest of its bytes."""

    path: Path
    kind: FileKind
    size: int
    sha256: str


TECHNICIAN_KEYS: Final = ("state", "play", "stop", "recalibrate")
"""What the keys of a button panel do, by number; the first only shows the state."""


@dataclass(frozen=True, slots=True)
class PanelCapabilities:
    """Keys of a button panel, and the size (width, height) of the picture on each; None: they have none."""

    keys: int
    picture_px: tuple[int, int] | None = None


@dataclass(frozen=True, slots=True)
class OutputInfo:
    """One projector output of a display."""

    name: str
    width_px: int
    height_px: int


@dataclass(frozen=True, slots=True)
class Presented:
    """When a frame set became visible at the display's outputs: ``at_s`` on this machine's monotonic clock."""

    sequence: int
    at_s: float


@dataclass(frozen=True, slots=True)
class LiveStatus:
    """Figures of a display in live mode.

    ``shown`` pictures so far; ``source_there``: whether the source still writes; ``delay_p50_s``, ``delay_p99_s``
    from writing to presentation, None before any; ``by``: the display makes the frames ("shaders"), or gets
    finished ones ("frames").
    """

    shown: int
    source_there: bool
    by: str
    delay_p50_s: float | None
    delay_p99_s: float | None


@dataclass(frozen=True, slots=True)
class PlaybackStatus:
    """Figures of a display that plays its bundle.

    ``swaps`` since its start, the last ``presented_at_s`` (monotonic clock); ``running`` whether a sequence has more
    items; ``late`` items presented more than a tick after their time in this sequence; intervals between presentations
    of this or the last sequence, None before any; ``live`` is None outside live mode.
    """

    swaps: int
    presented_at_s: float
    running: bool
    late: int
    appearance: str | None
    bundle: str | None
    interval_p50_s: float | None
    interval_p99_s: float | None
    rss_bytes: int
    live: LiveStatus | None = None
