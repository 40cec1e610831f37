"""Nikon's and Sony's extensions of PTP: events, properties, exposure times, image formats, live view. No I/O.

Source: the layouts that libgphoto2 (camlibs/ptp2) documents; of Sony's, protocol 3 (cameras since about 2020).
"""

from __future__ import annotations

import enum
from collections.abc import Mapping
from typing import Final

from hal.codecs.ptp.datasets import Form, PropertyDescription, read_value
from hal.codecs.ptp.values import Buffer, Reader, broken

NIKON_RAW: Final = 4
"""Value of COMPRESSION for RAW alone."""
NIKON_RAW_AND_JPEG: Final = (7, 6, 5)
"""Values of COMPRESSION for RAW with a JPEG, the best JPEG first."""
NIKON_JPEGS: Final = (2, 1, 0)
"""Values of COMPRESSION for a JPEG alone, the best first."""
_NIKON_NO_TIME: Final = 0xFFFF_FFFD
"""Shutter values from here on mean bulb, time and flash synchronisation."""
_JPEG_START: Final = b"\xff\xd8\xff"
_LONGEST_HEADER: Final = 4096


def parse_nikon_events(data: Buffer) -> tuple[tuple[int, int], ...]:
    """(code, parameter) of each event in an answer to 90C7: a 16-bit count, then 16 and 32 bits for each."""
    read = Reader(data, "a list of events")
    count = read.number("H") if read.left else 0
    if count * 6 > read.left:
        raise broken(f"a list of {count} events with only {read.left} bytes for them")
    return tuple((read.number("H"), read.number("I")) for _ in range(count))


def parse_nikon_codes(data: Buffer) -> tuple[int, ...]:
    """The further properties of the body (answer to 90CA): a PTP array of u16."""
    return Reader(data, "a list of properties").array("H")


def nikon_seconds(value: int) -> float | None:
    """The exposure time of a shutter value (D100): numerator and denominator of 16 bits; None for bulb and the like."""
    above, below = value >> 16, value & 0xFFFF
    return above / below if 0 <= value < _NIKON_NO_TIME and above and below else None


def parse_nikon_view(data: Buffer) -> bytes:
    """The JPEG in an answer to 9203, which follows a header of unknown length. Raises ProtocolError without one."""
    frame = bytes(data)
    start = frame.find(_JPEG_START, 0, _LONGEST_HEADER)
    if start < 0:
        raise broken("a frame of live view without a picture")
    return frame[start:]


SONY_PROTOCOL: Final = 0x012C
SONY_MEMORY_HANDLE: Final = 0xFFFF_C001
"""Handle of the picture in the body's memory."""
SONY_IN_MEMORY: Final = 0x8000
"""Bit of OBJECT_IN_MEMORY: the picture can be fetched."""
_MOST_PROPERTIES: Final = 1024
_LARGEST_SECOND_LIST: Final = 0x200
_AUTO_ISO: Final = 0x00FF_FFFF


class SonyProperty(enum.IntEnum):
    F_NUMBER = 0x5007
    COMPRESSION = 0x5004
    SHUTTER = 0xD20D
    OBJECT_IN_MEMORY = 0xD215
    BATTERY = 0xD218
    ISO = 0xD21E
    FILE_FORMAT = 0xD253
    HALF_PRESS = 0xD2C1
    FULL_PRESS = 0xD2C2


BUTTON_DOWN: Final = 2
BUTTON_UP: Final = 1
"""Values of HALF_PRESS and FULL_PRESS."""

SONY_FORMATS: Final[Mapping[SonyProperty, Mapping[bool, tuple[int, ...]]]] = {
    SonyProperty.FILE_FORMAT: {True: (1,), False: (3,)},
    SonyProperty.COMPRESSION: {True: (0x10,), False: (4, 3, 2, 1)},
}
"""By property, the values for RAW alone (True) and for a JPEG alone, the best first."""


def parse_sony_properties(data: Buffer) -> dict[int, PropertyDescription]:
    """All properties of the body by their codes (answer to 9209).

    u32 count, u32 zero; for each: u16 code, u16 type, u8 settable, u8 enabled, default, current, form. A second list of
    values, which newer bodies add, is the one that counts. Raises ProtocolError.
    """
    read = Reader(data, "its settings")
    count, _ = read.numbers("I", 2)
    if count > _MOST_PROPERTIES:
        raise broken(f"a list of {count} settings")
    found: dict[int, PropertyDescription] = {}
    while read.left and len(found) < _MOST_PROPERTIES:
        one = _property(read)
        found[one.code] = one
    return found


def _property(read: Reader) -> PropertyDescription:
    code, kind, settable, enabled = read.number("H"), read.number("H"), read.number("B"), read.number("B")
    default, current = read_value(read, kind), read_value(read, kind)
    form = read.number("B") if read.left else 0
    if form not in (Form.NONE, Form.RANGE, Form.ENUMERATION):
        raise broken(f"a setting whose values have form {form}")
    values = tuple(
        read_value(read, kind) for _ in range((0, 3, read.number("H") if form == Form.ENUMERATION else 0)[form])
    )
    if form == Form.ENUMERATION and read.left >= 2 and read.peek_u16() < _LARGEST_SECOND_LIST:
        values = tuple(read_value(read, kind) for _ in range(read.number("H")))
    return PropertyDescription(code, kind, bool(settable) and enabled == 1, default, current, Form(form), values)


def sony_seconds(value: int) -> float | None:
    """The exposure time of a shutter value: numerator and denominator of 16 bits; None for bulb (0)."""
    above, below = value >> 16, value & 0xFFFF
    return above / below if above > 0 and below else None


def sony_iso(value: int) -> int | None:
    """The ISO speed of a value; None for automatic ones and those that mix several pictures."""
    return value if 0 < value < _AUTO_ISO else None
