"""An emulated Sony body with protocol 3: a picture waits in its memory until it was fetched."""

from __future__ import annotations

import struct
from typing import Final

from plugins.emulated.cameras.body import JPEG, CameraNames, EmulatedBody, ExposedPicture, Stored
from plugins.emulated.cameras.generic import Setting
from plugins.emulated.cameras.wire import BUSY, GENERAL_ERROR, NO_SUCH_HANDLE, OK, WRONG_VALUE, PtpOutcome, u16s
from plugins.emulated.core.shot import ShotSettings

_HANDLE: Final = 0xFFFF_C001
_SHUTTER, _ISO, _APERTURE, _FORMAT, _MEMORY, _BATTERY = 0xD20D, 0xD21E, 0x5007, 0xD253, 0xD215, 0xD218
_HALF, _FULL, _FOCUS = 0xD2C1, 0xD2C2, 0x500A
_COMPRESSION: Final = 0x5004
_OLD_FORMATS: Final = {1: 0x10, 2: 0x13, 3: 0x03}
"""The values of the older property for those of the newer one; both are one setting."""
_DOWN: Final = 2
_OPEN_SESSION: Final = 0x1002
_VERSION: Final = 300
_BELOW: Final = (
    *(8000, 6400, 5000, 4000, 3200, 2500, 2000, 1600, 1250, 1000, 800, 640, 500, 400, 320, 250, 200, 160, 125, 100),
    *(80, 60, 50, 40, 30, 25, 20, 15, 13, 10, 8, 6, 5, 4, 3),
)
_TENTHS: Final = (4, 5, 6, 8, 10, 13, 16, 20, 25, 32, 40, 50, 60, 80, 100, 130, 150, 200, 250, 300)
_TIMES: Final = (*((1, below) for below in _BELOW), *((above, 10) for above in _TENTHS))
"""Thirds of a stop, the shortest first."""


class EmulatedSonyBody(EmulatedBody):
    """See ``EmulatedBody``. Format 1 is RAW, 3 a JPEG; its connection has three phases."""

    usual_names = CameraNames("Sony Corporation", "ILCE-7M2", "0003200104", "1.0")
    vendor_extension = 0x0000_0011
    operations = (0x101B, 0x9201, 0x9202, 0x9205, 0x9207, 0x9209)
    with_data = (0x1016, 0x9205, 0x9207)
    events = (0xC201, 0xC202, 0xC203)
    properties = ()
    capture_formats = (JPEG, 0xB101)
    raw_format = 0xB101
    raw_ending = "ARW"

    def power_on(self) -> None:
        times = tuple(above << 16 | below for above, below in _TIMES)
        isos = (0x00FF_FFFF, *(100 * 2**stop for stop in range(7)))
        self.settings = {
            _APERTURE: Setting(0x0004, "H", 560, (280, 400, 560, 800, 1100, 1600)),
            _FOCUS: Setting(0x0004, "H", 1, (1, 2)),
            _SHUTTER: Setting(0x0006, "I", times[_BELOW.index(125)], times),
            _ISO: Setting(0x0006, "I", 100, isos),
            _FORMAT: Setting(0x0002, "B", 3, tuple(_OLD_FORMATS)),
            _COMPRESSION: Setting(0x0002, "B", _OLD_FORMATS[3], tuple(_OLD_FORMATS.values())),
        }
        self._phase = 0
        self._version = 0
        self._down: set[int] = set()
        self._fetched = False

    def session_ended(self) -> None:
        self._phase = 0
        self._fetched = False  # what did not arrive whole stays in its memory

    def answer(self, code: int, parameters: tuple[int, ...], data: bytes) -> PtpOutcome:
        with self.lock:
            if self._fetched:
                self._fetched = False
                if code != _OPEN_SESSION:  # a client that begins again did not get it whole
                    self.card.waiting.pop(next(iter(self.card.waiting), 0), None)
            return super().answer(code, parameters, data)

    def standard(self, code: int, parameters: tuple[int, ...]) -> PtpOutcome | None:
        if code in (0x1008, 0x1009) and parameters[0] == _HANDLE:
            stored = self._next_picture()
            if stored is None:
                return PtpOutcome(NO_SUCH_HANDLE)
            self._fetched = code == 0x1009
            return PtpOutcome(data=stored.info() if code == 0x1008 else stored.data)
        return super().standard(code, parameters)

    def vendor(self, code: int, parameters: tuple[int, ...], data: bytes) -> PtpOutcome:  # noqa: PLR0911
        match code:
            case 0x9201:
                self._phase = parameters[0]
                return PtpOutcome(data=bytes(8))
            case 0x9202:
                codes = (*self.settings, _MEMORY, _BATTERY)
                self._version = min(parameters[0], _VERSION)
                return PtpOutcome(data=struct.pack("<H", self._version) + u16s(*codes) + u16s(_HALF, _FULL))
            case _ if self._phase != 3:
                return PtpOutcome(GENERAL_ERROR)
            case 0x9205:
                return self._set(parameters[0], data)
            case 0x9207:
                return self._button(parameters[0], data)
            case 0x9209:
                return PtpOutcome(data=self._properties())
            case _:
                return PtpOutcome(GENERAL_ERROR)

    def exposed(self, exposed: ExposedPicture) -> None:
        if not self.faults.take("lost_events"):
            self.on_event(0xC201, (_HANDLE,))

    def _next_picture(self) -> Stored | None:
        return next(iter(self.card.waiting.values()), None)

    def _set(self, code: int, data: bytes) -> PtpOutcome:
        if self.faults.take("busy") or self.exposing:
            return PtpOutcome(BUSY)
        setting = self.settings.get(code)
        if code == _SHUTTER and self._version < _VERSION:
            return PtpOutcome()  # the older protocol knows steps only, and ignores this
        if setting is None or (value := setting.read(data)) is None:
            return PtpOutcome(WRONG_VALUE)
        if code not in self.faults.unconfirmed:
            setting.current = value
        if code == _FORMAT:
            self.settings[_COMPRESSION].current = _OLD_FORMATS[setting.current]
        elif code == _COMPRESSION:
            self.settings[_FORMAT].current = next(new for new, old in _OLD_FORMATS.items() if old == setting.current)
        return PtpOutcome()

    def _button(self, button: int, data: bytes) -> PtpOutcome:
        if button == _SHUTTER and len(data) == 1:
            return self._step(struct.unpack("<b", data)[0])
        if len(data) != 2 or button not in (_HALF, _FULL):
            return PtpOutcome(WRONG_VALUE)
        if struct.unpack("<H", data)[0] != _DOWN:
            self._down.discard(button)
            return PtpOutcome()
        if button == _FULL:
            if _HALF not in self._down or _FULL in self._down:
                return PtpOutcome(BUSY)
            outcome = self._release()
            if outcome.code != OK:
                return outcome
        self._down.add(button)
        return PtpOutcome()

    def _step(self, steps: int) -> PtpOutcome:
        """The older way to set the exposure time: up is shorter."""
        setting = self.settings[_SHUTTER]
        at = setting.values.index(setting.current) - steps
        setting.current = setting.values[min(max(at, 0), len(setting.values) - 1)]
        return PtpOutcome()

    def _release(self) -> PtpOutcome:
        kind = self.settings[_FORMAT].current
        value = self.settings[_SHUTTER].current
        shot = ShotSettings(
            exposure_s=(value >> 16) / (value & 0xFFFF),
            iso=min(self.settings[_ISO].current, 6400),
            aperture_f=self.settings[_APERTURE].current / 100,
            raw=kind in (1, 2),
            jpeg=kind in (2, 3),
        )
        if self.faults.card_full:
            return PtpOutcome(0x200C)
        return self.open_shutter(shot, to_host=True)

    def _properties(self) -> bytes:
        entries = [_entry(code, setting) for code, setting in self.settings.items()]
        waiting = len(self.card.waiting)
        memory = Setting(0x0004, "H", (0x8000 if waiting else 0) + waiting, ())
        battery = Setting(0x0001, "b", self.battery_percent, ())
        entries += [_entry(_MEMORY, memory), _entry(_BATTERY, battery)]
        return struct.pack("<II", len(entries), 0) + b"".join(entries)


def _entry(code: int, setting: Setting) -> bytes:
    """A property that can be set where it has a list of values."""
    settable = int(bool(setting.values))
    head = struct.pack("<HHBB", code, setting.kind, settable, 1 if settable else 2)
    values = b"".join(struct.pack("<" + setting.pack, value) for value in (setting.current, setting.current))
    if not setting.values:
        return head + values + b"\0"
    listed = b"".join(struct.pack("<" + setting.pack, value) for value in setting.values)
    return head + values + struct.pack("<BH", 2, len(setting.values)) + listed
