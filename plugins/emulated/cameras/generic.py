"""Emulated cameras that keep to the standard, and Nikon's.

The standard: 100E, events 4002 and 400D, properties 5007, 500D, 500E, 500F. Nikon: also events by 90C7, release by
9207, exact times in D100.
"""

from __future__ import annotations

import struct
import time
from dataclasses import dataclass
from typing import Final

from plugins.emulated.cameras.body import JPEG, CameraNames, EmulatedBody, ExposedPicture
from plugins.emulated.cameras.wire import (
    BUSY,
    NO_SUCH_PROPERTY,
    NOT_READY,
    OK,
    WRONG_FORMAT,
    WRONG_VALUE,
    PtpOutcome,
    u16s,
)
from plugins.emulated.core.shot import ShotSettings

DNG: Final = 0x3811


@dataclass(slots=True)
class Setting:
    """A property that takes one of ``values``; ``pack`` is its struct character, ``kind`` its PTP data type."""

    kind: int
    pack: str
    current: int
    values: tuple[int, ...]

    def description(self, code: int) -> bytes:
        one = "<" + self.pack
        parts = [struct.pack("<HHB", code, self.kind, 1), struct.pack(one, self.values[0])]
        parts += [struct.pack(one, self.current), struct.pack("<BH", 2, len(self.values))]
        return b"".join(parts) + b"".join(struct.pack(one, value) for value in self.values)

    def read(self, data: bytes) -> int | None:
        """The value that ``data`` sets; None if it is not one of ``values``."""
        if len(data) != struct.calcsize("<" + self.pack):
            return None
        value = struct.unpack("<" + self.pack, data)[0]
        return value if value in self.values else None


class EmulatedGenericBody(EmulatedBody):
    """See ``EmulatedBody``. Which files a shot makes follows the format that InitiateCapture names; 0 means a JPEG."""

    operations: tuple[int, ...] = (0x100E, 0x1016, 0x101B)
    properties: tuple[int, ...] = (0x5001, 0x5007, 0x500D, 0x500E, 0x500F)
    capture_formats: tuple[int, ...] = (JPEG, DNG)

    settings: dict[int, Setting]

    def power_on(self) -> None:
        """Settings as after the battery was put in."""
        thirds = (round(10_000 * 2 ** (third / 3)) for third in range(-33, 16))
        isos = tuple(100 * 2**stop for stop in range(7))
        apertures = (280, 320, 350, 400, 450, 500, 560, 630, 710, 800, 900, 1000, 1100, 1300, 1400, 1600)
        self.settings = {
            0x5007: Setting(0x0004, "H", 560, apertures),
            0x500D: Setting(0x0006, "I", 1250, tuple(sorted({max(1, tenths) for tenths in thirds}))),
            0x500E: Setting(0x0004, "H", 2, (1, 2)),
            0x500F: Setting(0x0004, "H", 100, isos),
        }

    def vendor(self, code: int, parameters: tuple[int, ...], data: bytes) -> PtpOutcome:
        if code == 0x101B:
            return self.partial(parameters)
        if code == 0x100E:
            return self._capture(parameters[1])
        setting = self.settings.get(parameters[0])
        if setting is None:
            return PtpOutcome(NO_SUCH_PROPERTY)
        if code == 0x1014:
            return PtpOutcome(data=setting.description(parameters[0]))
        if code == 0x1015:
            return PtpOutcome(data=struct.pack("<" + setting.pack, setting.current))
        return self._set(setting, data)

    def _set(self, setting: Setting, data: bytes) -> PtpOutcome:
        if self.faults.take("busy") or self.exposing:
            return PtpOutcome(BUSY)
        if (value := setting.read(data)) is None:
            return PtpOutcome(WRONG_VALUE)
        setting.current = value
        return PtpOutcome()

    def _capture(self, format_code: int) -> PtpOutcome:
        if format_code not in (0, *self.capture_formats):
            return PtpOutcome(WRONG_FORMAT)
        raw = format_code == DNG
        settings = ShotSettings(
            exposure_s=self.settings[0x500D].current / 10_000,
            iso=self.settings[0x500F].current,
            aperture_f=self.settings[0x5007].current / 100,
            raw=raw,
            jpeg=not raw,
        )
        return self.open_shutter(settings, to_host=False)

    def exposed(self, exposed: ExposedPicture) -> None:
        for stored in exposed.stored:
            if not self.faults.take("lost_events"):
                self.on_event(0x4002, (stored.handle,))
        self.on_event(0x400D, ())


_TIMES: Final = (
    *((1, below) for below in (4000, 2000, 1000, 500, 250, 125, 60, 30, 15, 8, 4, 2)),
    *((above, 1) for above in (1, 2, 4, 8, 15, 30)),
)
_SHUTTER, _TENTHS, _COMPRESSION = 0xD100, 0x500D, 0x5004
_WITH_RAW: Final = (4, 5, 6, 7)
_WITH_JPEG: Final = (0, 1, 2, 5, 6, 7)


class EmulatedNikonBody(EmulatedGenericBody):
    """See ``EmulatedBody``. It has live view, answers busy while it exposes, and keeps its events for who asks."""

    usual_names = CameraNames("Nikon Corporation", "D7100", "0003200103", "V1.04")
    vendor_extension = 0x0000_000A
    operations = (
        *(0x100E, 0x1016, 0x101B, 0x90C2, 0x90C7, 0x90C8, 0x90CA),
        *(0x9201, 0x9202, 0x9203, 0x9207),
    )
    properties = (0x5001, _COMPRESSION, 0x5007, _TENTHS, 0x500E, 0x500F)
    capture_formats = (JPEG,)
    events = (0x4002, 0x4003, 0x400D)
    raw_format = 0x3000
    raw_ending = "NEF"

    def power_on(self) -> None:
        super().power_on()
        times = tuple(above << 16 | below for above, below in _TIMES)
        self._tenths = {value: round(10_000 * (value >> 16) / (value & 0xFFFF)) for value in times}
        self.settings[_SHUTTER] = Setting(0x0006, "I", times[5], times)
        self.settings[_TENTHS] = Setting(0x0006, "I", self._tenths[times[5]], tuple(self._tenths.values()))
        self.settings[_COMPRESSION] = Setting(0x0002, "B", 2, (0, 1, 2, 4, 5, 6, 7))
        self._happened: list[tuple[int, int]] = []
        self._view_at: float | None = None

    def session_ended(self) -> None:
        self._view_at = None

    def vendor(self, code: int, parameters: tuple[int, ...], data: bytes) -> PtpOutcome:  # noqa: PLR0911
        match code:
            case 0x90C2:
                return PtpOutcome()
            case 0x90C7:
                happened, self._happened = self._happened, []
                events = b"".join(struct.pack("<HI", *event) for event in happened)
                return PtpOutcome(data=struct.pack("<H", len(happened)) + events)
            case 0x90C8:
                return PtpOutcome(BUSY) if self.exposing else PtpOutcome()
            case 0x90CA:
                return PtpOutcome(data=u16s(_SHUTTER))
            case 0x9201:
                self._view_at = time.monotonic() + 0.05
                return PtpOutcome()
            case 0x9202:
                self._view_at = None
                return PtpOutcome()
            case 0x9203:
                return self._view()
            case 0x100E | 0x9207:
                return self._release()
            case _:
                return self._linked(parameters[0], super().vendor(code, parameters, data))

    def exposed(self, exposed: ExposedPicture) -> None:
        for stored in exposed.stored:
            if not self.faults.take("lost_events"):
                self._happened.append((0x4002, stored.handle))
        self._happened.append((0x400D, 0))

    def _release(self) -> PtpOutcome:
        kind = self.settings[_COMPRESSION].current
        return self.open_shutter(self._shot(raw=kind in _WITH_RAW, jpeg=kind in _WITH_JPEG), to_host=False)

    def _shot(self, *, raw: bool, jpeg: bool) -> ShotSettings:
        value = self.settings[_SHUTTER].current
        return ShotSettings(
            exposure_s=(value >> 16) / (value & 0xFFFF),
            iso=self.settings[0x500F].current,
            aperture_f=self.settings[0x5007].current / 100,
            raw=raw,
            jpeg=jpeg,
        )

    def _view(self) -> PtpOutcome:
        if self._view_at is None:
            return PtpOutcome(NOT_READY)
        if time.monotonic() < self._view_at or self.exposing:
            return PtpOutcome(BUSY)
        return PtpOutcome(data=bytes(384) + (self._expose(self._shot(raw=False, jpeg=True)).jpeg or b""))

    def _linked(self, code: int, outcome: PtpOutcome) -> PtpOutcome:
        """Both properties of the exposure time are one setting."""
        if outcome.code == OK and code == _SHUTTER:
            self.settings[_TENTHS].current = self._tenths[self.settings[_SHUTTER].current]
        elif outcome.code == OK and code == _TENTHS:
            tenths = self.settings[_TENTHS].current
            self.settings[_SHUTTER].current = next(value for value, count in self._tenths.items() if count == tenths)
        return outcome
