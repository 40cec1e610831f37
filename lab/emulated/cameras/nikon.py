"""An emulated Nikon body: the standard, with events by 90C7, release by 9207, exact times in D100, and live view."""

from __future__ import annotations

import struct
import time
from typing import Final

from plugins.emulated.cameras.body import JPEG, CameraNames, ExposedPicture
from plugins.emulated.cameras.generic import EmulatedGenericBody, Setting
from plugins.emulated.cameras.wire import BUSY, NOT_READY, OK, PtpOutcome, u16s
from plugins.emulated.core.shot import ShotSettings

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
