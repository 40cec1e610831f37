"""Emulated cameras that keep to the standard: 100E, events 4002 and 400D, properties 5007, 500D, 500E, 500F."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Final

from plugins.emulated.cameras.body import JPEG, EmulatedBody, ExposedPicture
from plugins.emulated.cameras.wire import BUSY, NO_SUCH_PROPERTY, WRONG_FORMAT, WRONG_VALUE, PtpOutcome
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
