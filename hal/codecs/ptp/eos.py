"""Canon EOS extensions of PTP: event records, property settings, image formats, exposure codes. No I/O.

Source: the layouts that libgphoto2 (camlibs/ptp2) documents from traces. A body answers 9116 with a list of records
{u32 size, u32 code, ...} that ends with {8, 0}. Exposure codes count eighths of a stop, in thirds or halves.
"""

from __future__ import annotations

import enum
import struct
from dataclasses import dataclass
from typing import Final

from hal.codecs.ptp.values import Buffer, Reader, broken, printable

_LONGEST_NAME: Final = 255
_MOST_VALUES: Final = 4096


class EosProperty(enum.IntEnum):
    APERTURE = 0xD101
    SHUTTER = 0xD102
    ISO = 0xD103
    EXPOSURE_MODE = 0xD105
    FOCUS_MODE = 0xD108
    BATTERY = 0xD111
    AVAILABLE_SHOTS = 0xD11B
    CAPTURE_DESTINATION = 0xD11C
    IMAGE_FORMAT = 0xD120
    VIEW_OUTPUT = 0xD1B0
    VIEW_MODE = 0xD1B1


class Destination(enum.IntEnum):
    """Value of CAPTURE_DESTINATION that means the computer; all others are cards."""

    HOST = 4


MANUAL_EXPOSURE: Final = 3
"""Value of EXPOSURE_MODE with the dial on M."""

MANUAL_FOCUS: Final = 3
"""Value of FOCUS_MODE with the lens' switch on MF."""

BULB_CODES: Final = (0x0C, 0x04)
"""Shutter codes of bulb."""

VIEW_TO_COMPUTER: Final = 2
"""Value of VIEW_OUTPUT that sends live view here."""

BATTERY_PERCENT: Final = {0: 10, 5: 25, 1: 50, 4: 75, 2: 100}
"""What the values of BATTERY mean, as libgphoto2 names them; 0 is "low"."""

_VIEW_JPEGS: Final = (1, 9, 11)


class EosCode(enum.IntEnum):
    """Record codes of 9116."""

    OBJECT_ADDED = 0xC181
    OBJECT_REMOVED = 0xC182
    TRANSFER_REQUESTED = 0xC186
    PROPERTY_CHANGED = 0xC189
    VALUES_CHANGED = 0xC18A
    STATUS_CHANGED = 0xC18B
    SHUTS_DOWN_SOON = 0xC18D


@dataclass(frozen=True, slots=True)
class PropertyChanged:
    """A property has this value now; ``data`` as sent, mostly a u32."""

    code: int
    data: bytes

    @property
    def number(self) -> int:
        """The value as an integer, from at most its first four bytes."""
        return int.from_bytes(self.data[:4], "little")


@dataclass(frozen=True, slots=True)
class ValuesChanged:
    """A property accepts these values now. For IMAGE_FORMAT see ``formats``; else 32-bit ``values``."""

    code: int
    values: tuple[int, ...] = ()
    formats: tuple[ImageFormat, ...] = ()


@dataclass(frozen=True, slots=True)
class ObjectAdded:
    """A new file: on a card (C181), or in the body's memory and waiting to be fetched (C186, ``waiting``)."""

    handle: int
    format: int
    size: int
    filename: str
    waiting: bool


@dataclass(frozen=True, slots=True)
class StatusChanged:
    """``busy`` while the body exposes or writes (C18B = 1)."""

    busy: bool


@dataclass(frozen=True, slots=True)
class OtherRecord:
    code: int


EosRecord = PropertyChanged | ValuesChanged | ObjectAdded | StatusChanged | OtherRecord


@dataclass(frozen=True, slots=True)
class ImagePart:
    """One file of a picture: ``kind`` 1 JPEG, 6 RAW; ``size`` 0 largest; ``compression`` 2 coarse, 3 fine, 4 none."""

    kind: int
    size: int
    compression: int

    @property
    def raw(self) -> bool:
        return self.kind == 6


ImageFormat = tuple[ImagePart, ...]
"""The one or two files of a picture."""


def parse_records(data: Buffer) -> tuple[EosRecord, ...]:
    """The records of one answer to 9116; no bytes at all mean no records.

    Raises ProtocolError for a record that does not fit, or whose content does not fit into it.
    """
    records: list[EosRecord] = []
    read = Reader(data, "a list of changes")
    while read.left:
        size, code = read.numbers("I", 2)
        if size < 8:
            raise broken(f"a change of {size} bytes")
        body = read.take(size - 8)
        if (size, code) == (8, 0):
            break
        records.append(_record(code, Reader(body, f"a change 0x{code:04x}")))
    return tuple(records)


def _record(code: int, read: Reader) -> EosRecord:
    match code:
        case EosCode.PROPERTY_CHANGED:
            return PropertyChanged(read.number("I"), bytes(read.take(read.left)))
        case EosCode.VALUES_CHANGED:
            return _values(read)
        case EosCode.OBJECT_ADDED:
            handle, _, format_code, _, _, size = read.numbers("I", 6)
            read.take(8)
            return ObjectAdded(handle, format_code & 0xFFFF, size, _name(read), waiting=False)
        case EosCode.TRANSFER_REQUESTED:
            handle, format_code, _, size, _ = read.numbers("I", 5)
            return ObjectAdded(handle, format_code & 0xFFFF, size, _name(read), waiting=True)
        case EosCode.STATUS_CHANGED:
            return StatusChanged(busy=read.number("I") == 1)
        case _:
            return OtherRecord(code)


def _values(read: Reader) -> ValuesChanged:
    code, kind, count = read.numbers("I", 3)
    if kind != 3:
        return ValuesChanged(code)  # strings and blobs, which this driver does not set
    if count > _MOST_VALUES:
        raise broken(f"a setting with {count} allowed values")
    if code == EosProperty.IMAGE_FORMAT:
        return ValuesChanged(code, formats=tuple(_image_format(read) for _ in range(count)))
    return ValuesChanged(code, read.numbers("I", count))


def parse_image_format(data: Buffer) -> ImageFormat:
    """The value of IMAGE_FORMAT: u32 number of files, then for each {u32 16, kind, size, compression}."""
    return _image_format(Reader(data, "an image format"))


def _image_format(read: Reader) -> ImageFormat:
    parts = read.number("I")
    if parts not in (1, 2):
        raise broken(f"an image format of {parts} files")
    return tuple(_image_part(read) for _ in range(parts))


def _image_part(read: Reader) -> ImagePart:
    length, kind, size, compression = read.numbers("I", 4)
    if length != 16:
        raise broken(f"an image format with an entry of {length} bytes")
    return ImagePart(kind, size, compression)


def _name(read: Reader) -> str:
    raw = bytes(read.take(min(read.left, _LONGEST_NAME)))
    return printable(raw.split(b"\0", 1)[0].decode("ascii", errors="replace"))


def parse_view(data: Buffer) -> bytes:
    """The JPEG in an answer to 9153: records {u32 size, u32 kind, ...}, of which kinds 1, 9 and 11 are the frame.

    Raises ProtocolError where there is none, or a record does not fit.
    """
    read = Reader(data, "a frame of live view")
    while read.left >= 8:
        size, kind = read.numbers("I", 2)
        if size < 8:
            break
        body = read.take(size - 8)
        if kind in _VIEW_JPEGS and bytes(body[:2]) == b"\xff\xd8":
            return bytes(body)
    raise broken("a frame of live view without a picture")


def pack_image_format(image_format: ImageFormat) -> bytes:
    """The bytes of an image format, for ``pack_setting``."""
    entries = (struct.pack("<IIII", 16, part.kind, part.size, part.compression) for part in image_format)
    return struct.pack("<I", len(image_format)) + b"".join(entries)


def pack_setting(code: int, value: int | ImageFormat) -> bytes:
    """Data of 9110: u32 size of all of it, u32 property, then the value."""
    data = struct.pack("<I", value) if isinstance(value, int) else pack_image_format(value)
    return struct.pack("<II", 8 + len(data), code) + data


def exposure_of(code: int) -> float | None:
    """Seconds of a shutter code; None for bulb, auto and other codes without a time.

    0x38 is one second and eight codes are a stop. The exact power of two is what the shutter does: a body that shows
    1/60 exposes for 1/64 second, one that shows 30 for 32; photometry needs the exact one.
    """
    stops = _stops(code - 0x38)
    return None if stops is None or not 0x10 <= code <= 0xA8 else 2.0**-stops


def iso_of(code: int) -> int | None:
    """ISO speed of a code as bodies name it; None for auto and the like. 0x48 is ISO 100."""
    stops = _stops(code - 0x48)
    if stops is None or not 0x28 <= code <= 0xB0:
        return None
    whole, fraction = divmod(code - 0x48, 8)
    named = {0: 100.0, 3: 125.0, 4: 140.0, 5: 160.0 if whole < 3 else 156.25}[fraction] * 2.0**whole
    return _ODD_ISOS.get(code, round(named))


_ODD_ISOS: Final = {0x30: 12, 0x43: 64}


def aperture_of(code: int) -> float | None:
    """f-number of a code as bodies name it; None for auto. 0x08 is f/1 and eight codes are a stop (of two)."""
    if code in _ODD_APERTURES:
        return _ODD_APERTURES[code]
    stops = _stops(code - 0x08)
    if stops is None or not 0x08 <= code <= 0x70:
        return None
    number = 2.0 ** (stops / 2)
    return round(number, 1) if number < 9.75 else float(round(number))


# Where the engraved number is not the rounded one.
_ODD_APERTURES: Final = {0x0D: 1.2, 0x14: 1.8, 0x1C: 2.5, 0x24: 3.5, 0x25: 3.5, 0x2C: 4.5, 0x30: 5.6, 0x50: 22.0}


def _stops(eighths: int) -> float | None:
    """Stops of a difference of codes; within a stop 3, 4 and 5 eighths mean one third, a half, two thirds."""
    whole, fraction = divmod(eighths, 8)
    part = {0: 0.0, 3: 1 / 3, 4: 0.5, 5: 2 / 3}.get(fraction)
    return None if part is None else whole + part
