"""Emulated Canon EOS bodies: ``new`` with 9128/9129, and ``old`` with 910F as the EOS 400D of the paper has it.

They report by records of 9116, keep pictures for the computer (D11C = 4) until 9117, and report those again to the
program that connects next, until they are confirmed.
"""

from __future__ import annotations

import struct
import time
from dataclasses import replace
from typing import Final

from plugins.emulated.cameras.body import JPEG, STORAGE, CameraNames, EmulatedBody, ExposedPicture, Stored
from plugins.emulated.cameras.wire import (
    BUSY,
    GENERAL_ERROR,
    NO_SUCH_HANDLE,
    NOT_READY,
    OK,
    STORE_FULL,
    WRONG_VALUE,
    PtpOutcome,
    u32s,
)
from plugins.emulated.core.shot import ShotSettings

_JPEG_FINE: Final = (1, 0, 3)
_JPEG_COARSE: Final = (1, 0, 2)
_RAW: Final = (6, 0, 4)
FORMATS: Final = ((_JPEG_FINE,), (_JPEG_COARSE,), (_RAW,), (_RAW, _JPEG_FINE))


def _thirds(first: int, last: int) -> tuple[int, ...]:
    """Exposure codes in thirds of a stop."""
    return tuple(code for code in range(first, last + 1) if code % 8 in (0, 3, 5))


BULB: Final = 0x0C
SHUTTER: Final = _thirds(0x10, 0x98)
APERTURES: Final = _thirds(0x20, 0x50)
ISO_NAMES: Final = dict(
    zip(
        _thirds(0x48, 0x78),
        (100, 125, 160, 200, 250, 320, 400, 500, 640, 800, 1000, 1250, 1600, 2000, 2500, 3200, 4000, 5000, 6400),
        strict=True,
    )
)
OLD_ISOS: Final = (0x48, 0x50, 0x58, 0x60, 0x68)
_EIGHTHS: Final = {0: 0.0, 3: 1 / 3, 5: 2 / 3}


def seconds(code: int) -> float:
    """The exposure time of a shutter code."""
    return float(2.0 ** (7 - code // 8 - _EIGHTHS[code % 8]))


def f_number(code: int) -> float:
    """The f-number of an aperture code."""
    return float(2.0 ** ((code // 8 - 1 + _EIGHTHS[code % 8]) / 2))


def record(code: int, body: bytes) -> bytes:
    """One report: its length, its code, its body in whole words of 32 bits."""
    padded = body + bytes(-len(body) % 4)
    return struct.pack("<II", 8 + len(padded), code) + padded


def new_object(stored: Stored, *, waiting: bool) -> bytes:
    """The report of a new file; ``waiting``: it waits in memory for the computer, else it is on the card."""
    name = stored.name.encode("ascii") + b"\0"
    size = len(stored.data)
    if waiting:
        return record(0xC186, struct.pack("<IIIII", stored.handle, stored.format, 0, size, 0) + name)
    head = struct.pack("<IIIII", stored.handle, STORAGE, stored.format, 0, 0)
    return record(0xC181, head + struct.pack("<III", size, stored.parent, 0) + name)


def format_bytes(parts: tuple[tuple[int, int, int], ...]) -> bytes:
    """An image format as an EOS writes it: for each file its kind, size and compression."""
    return struct.pack("<I", len(parts)) + b"".join(struct.pack("<IIII", 16, *part) for part in parts)


def read_format(data: bytes) -> tuple[tuple[int, int, int], ...]:
    """What ``format_bytes`` wrote; () for anything else."""
    parts = struct.unpack_from("<I", data)[0]
    if parts not in (1, 2) or len(data) != 4 + 16 * parts:
        return ()
    return tuple(struct.unpack_from("<III", data, 8 + 16 * index) for index in range(parts))


_HOST: Final = 4
_CARD: Final = 2
_MANUAL: Final = 3
_MIRROR_REASON: Final = 3
_FULL_REASON: Final = 7


class EmulatedEosBody(EmulatedBody):
    """See ``EmulatedBody``."""

    usual_names = CameraNames("Canon Inc.", "Canon EOS 1300D", "0320010001", "3-1.1.0")
    vendor_extension = 0x0000_000B
    raw_format = 0xB103
    capture_formats = (JPEG, 0xB103)
    events = (0x4002, 0x4003, 0x4004, 0x4005, 0xC101)
    isos: tuple[int, ...] = tuple(ISO_NAMES)
    operations: tuple[int, ...] = (
        *(0x101B, 0x9101, 0x9102, 0x9107, 0x910F, 0x9110, 0x9114, 0x9115, 0x9116, 0x9117),
        *(0x911A, 0x911B, 0x911C, 0x911D, 0x911E, 0x9125, 0x9126, 0x9128, 0x9129, 0x9153),
    )

    def power_on(self) -> None:
        """Settings as after the battery was put in; the dial stands on M, the lens on manual focus."""
        self._values: dict[int, int] = {
            **{0xD101: 0x30, 0xD102: 0x60, 0xD103: 0x48, 0xD105: _MANUAL, 0xD106: 0, 0xD108: 3, 0xD111: 0, 0xD11B: 0},
            **{0xD11C: _CARD, 0xD11E: STORAGE, 0xD1B0: 0, 0xD1B1: 0},
        }
        shutter = (*((BULB,) if 0x9125 in self.operations else ()), *SHUTTER)
        self._lists = {0xD101: APERTURES, 0xD102: shutter, 0xD103: self.isos, 0xD11C: (_CARD, _HOST)}
        self._format: tuple[tuple[int, int, int], ...] = FORMATS[0]
        self._reports: list[bytes] = []
        self._reporting = False
        self._announced: set[int] = set()
        self._pressed = 0
        self._view_at = 0.0

    def shutter_codes(self, codes: tuple[int, ...] = ()) -> tuple[int, ...]:
        """The shutter codes that can be set, bulb left out; ``codes`` replaces them."""
        with self.lock:
            kept = tuple(code for code in self._lists[0xD102] if code == BULB)
            if codes:
                self._lists[0xD102] = (*kept, *codes)
                self._report_list(0xD102)
            return self._lists[0xD102][len(kept) :]

    def falls_asleep_soon(self) -> None:
        """Warn the computer, as a body does before it switches itself off."""
        with self.lock:
            self._report(0xC18D, b"")

    def disconnected(self) -> None:
        super().disconnected()
        with self.lock:
            self._reporting = False
            self._reports.clear()

    def session_ended(self) -> None:
        """The mirror comes down again."""
        if 0xD1B0 in self._values:
            self._values[0xD1B0] = 0
        self._view_at = 0.0

    def vendor(self, code: int, parameters: tuple[int, ...], data: bytes) -> PtpOutcome:  # noqa: PLR0911, PLR0912
        match code:
            case 0x101B | 0x9107:
                return self.partial(parameters)
            case 0x9101:
                return PtpOutcome(data=u32s(STORAGE))
            case 0x9102:
                return PtpOutcome(data=self.card.storage_info())
            case 0x9110:
                return self._set(data)
            case 0x9115:
                return self._report_everything(on=parameters[0] != 0)
            case 0x9116:
                return self._changes()
            case 0x9117:
                return PtpOutcome() if self.card.waiting.pop(parameters[0], None) else PtpOutcome(NO_SUCH_HANDLE)
            case 0x911A if self.faults.space_refused:
                self._values[0xD11B] = 1000
                return PtpOutcome(GENERAL_ERROR)
            case 0x911A:
                self._change(0xD11B, 1000)
                return PtpOutcome()
            case 0x910F:
                return self._release_old()
            case 0x9128 | 0x9129:
                return self._button(parameters[0], down=code == 0x9128)
            case 0x9125:
                return self._fire(bulb=True) if self._values[0xD102] == BULB else PtpOutcome(GENERAL_ERROR)
            case 0x9126:
                return self.close_shutter()
            case 0x9153:
                return self._view()
            case _:
                return PtpOutcome()  # remote mode, locks, keep-alive: accepted, nothing to see

    def exposed(self, exposed: ExposedPicture) -> None:
        for stored in exposed.stored:
            if not self.faults.take("lost_events"):
                self._reports.append(new_object(stored, waiting=exposed.to_host))
        self._report(0xC18B, struct.pack("<I", 0))

    def _button(self, button: int, *, down: bool) -> PtpOutcome:
        if not down:
            self._pressed &= ~button
            return PtpOutcome()
        if button & 1 and self.faults.take("autofocus_fails"):
            self._pressed |= button
            return PtpOutcome(parameters=(1,))
        if button & 2 and not self._pressed & 1:
            return PtpOutcome(BUSY)  # a full press begins with a half one
        if button & 2 and self._pressed & 2:
            return PtpOutcome(BUSY)  # the button is still pressed
        if button & 2:
            outcome = self._fire()
            if outcome.code != OK or outcome.parameters:
                return outcome
        self._pressed |= button
        return PtpOutcome()

    def _release_old(self) -> PtpOutcome:
        if self.faults.take("autofocus_fails"):
            return PtpOutcome(parameters=(1,))
        outcome = self._fire()
        if outcome.code == STORE_FULL:
            return PtpOutcome(parameters=(_FULL_REASON,))
        return PtpOutcome(outcome.code, outcome.parameters or ((0,) if outcome.code == OK else ()))

    def _battery_code(self) -> int:
        return next(
            code for least, code in ((88, 2), (63, 4), (38, 1), (15, 5), (0, 0)) if self.battery_percent >= least
        )

    def _view(self) -> PtpOutcome:
        """A frame of live view: a record of type 1 with a JPEG, after one of a type that is of no interest here."""
        if self._values[0xD1B0] & 2 == 0:
            return PtpOutcome(GENERAL_ERROR)
        if self._view_at == 0.0:
            self._view_at = time.monotonic() + 0.05
        if time.monotonic() < self._view_at or self.exposing:
            return PtpOutcome(NOT_READY)
        frame = self._expose(self._settings(raw=False)).jpeg or b""
        return PtpOutcome(data=struct.pack("<IIQ", 16, 3, 0) + struct.pack("<II", 8 + len(frame), 1) + frame)

    def _settings(self, *, raw: bool) -> ShotSettings:
        code = self._values[0xD102]
        return ShotSettings(
            exposure_s=0.0 if code == BULB else seconds(code),
            iso=ISO_NAMES[self._values[0xD103]],
            aperture_f=f_number(self._values[0xD101]),
            raw=raw,
            jpeg=not raw,
        )

    def _fire(self, *, bulb: bool = False) -> PtpOutcome:
        if self._values.get(0xD1B0, 0):
            return PtpOutcome(parameters=(_MIRROR_REASON,))
        if self._values[0xD102] == BULB and not bulb:
            return PtpOutcome(BUSY)
        if self._values[0xD11C] == _HOST and self.faults.take("target_flips"):
            self._values[0xD11C] = _CARD
        to_host = self._values[0xD11C] == _HOST
        if to_host and (self.faults.card_full or self._values[0xD11B] == 0):
            return PtpOutcome(STORE_FULL)
        kinds = {kind for kind, _, _ in self._format}
        settings = replace(self._settings(raw=6 in kinds), jpeg=1 in kinds)
        outcome = self.open_shutter(settings, to_host=to_host, bulb=bulb)
        if outcome.code == OK and not outcome.parameters:
            self._report(0xC18B, struct.pack("<I", 1))
            if to_host:
                self._change(0xD11B, self._values[0xD11B] - 1)
        return outcome

    def _set(self, data: bytes) -> PtpOutcome:
        if self.faults.take("busy") or self.exposing:
            return PtpOutcome(BUSY)
        if len(data) < 12 or struct.unpack_from("<I", data)[0] != len(data):
            return PtpOutcome(WRONG_VALUE)
        code, value = struct.unpack_from("<II", data, 4)
        if code == 0xD120:
            formats = read_format(data[8:])
            if formats not in FORMATS:
                return PtpOutcome(WRONG_VALUE)
            self._format = formats
            self._report(0xC189, struct.pack("<I", code) + format_bytes(formats))
            return PtpOutcome()
        if code not in self._values or value not in self._lists.get(code, (value,)):
            return PtpOutcome(WRONG_VALUE)
        self._change(code, value)
        if code == 0xD1B0:
            self._view_at = 0.0
        return PtpOutcome()

    def _change(self, code: int, value: int) -> None:
        if self._values[code] != value:
            self._values[code] = value
            if code not in self.faults.unconfirmed:
                self._report(0xC189, struct.pack("<II", code, value))

    def _changes(self) -> PtpOutcome:
        records = b"".join(self._reports)
        self._reports.clear()
        return PtpOutcome(data=records + struct.pack("<II", 8, 0))

    def _report_everything(self, *, on: bool) -> PtpOutcome:
        self._reporting = on
        self._reports.clear()
        for code, value in {**self._values, 0xD111: self._battery_code()}.items():
            if code in self.faults.unconfirmed and code in self._announced:
                continue
            self._announced.add(code)
            self._report(0xC189, struct.pack("<II", code, value))
        self._report(0xC189, struct.pack("<I", 0xD120) + format_bytes(self._format))
        self._report(0xC189, struct.pack("<I", 0xD1AF) + self.names.serial.encode("ascii", "replace") + b"\0")
        for code in self._lists:
            self._report_list(code)
        formats = b"".join(format_bytes(one) for one in FORMATS)
        self._report(0xC18A, struct.pack("<III", 0xD120, 3, len(FORMATS)) + formats)
        self._report(0xC18B, struct.pack("<I", int(self.exposing)))
        if on:
            self._reports += [new_object(stored, waiting=True) for stored in self.card.waiting.values()]
        return PtpOutcome()

    def _report_list(self, code: int) -> None:
        values = self._lists[code]
        self._report(0xC18A, struct.pack(f"<III{len(values)}I", code, 3, len(values), *values))

    def _report(self, code: int, body: bytes) -> None:
        if self._reporting:
            self._reports.append(record(code, body))


class EmulatedOldEosBody(EmulatedEosBody):
    """The operations of the EOS 400D: one release, no buttons, whole stops of ISO."""

    usual_names = CameraNames("Canon Inc.", "Canon EOS 400D DIGITAL", "0320010002", "3-1.1.1")
    isos = OLD_ISOS
    operations = (
        *(0x101B, 0x9101, 0x9102, 0x9107, 0x910F, 0x9110, 0x9114, 0x9115, 0x9116, 0x9117),
        *(0x911A, 0x911B, 0x911C, 0x911D, 0x911E),
    )

    def power_on(self) -> None:
        super().power_on()
        del self._values[0xD1B0], self._values[0xD1B1]  # no live view
