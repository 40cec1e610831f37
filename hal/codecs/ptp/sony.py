"""Sony's extensions of PTP: all properties in one answer, exposure times, image formats. No I/O.

Source: the layouts that libgphoto2 (camlibs/ptp2) documents, protocol 3 (cameras since about 2020).
"""

from __future__ import annotations

import enum
from collections.abc import Mapping
from typing import Final

from hal.codecs.ptp.datasets import Form, PropertyDescription, read_value
from hal.codecs.ptp.values import Buffer, Reader, broken

PROTOCOL: Final = 0x012C
MEMORY_HANDLE: Final = 0xFFFF_C001
"""Handle of the picture in the body's memory."""
IN_MEMORY: Final = 0x8000
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


DOWN: Final = 2
UP: Final = 1
"""Values of HALF_PRESS and FULL_PRESS."""

FORMATS: Final[Mapping[SonyProperty, Mapping[bool, tuple[int, ...]]]] = {
    SonyProperty.FILE_FORMAT: {True: (1,), False: (3,)},
    SonyProperty.COMPRESSION: {True: (0x10,), False: (4, 3, 2, 1)},
}
"""By property, the values for RAW alone (True) and for a JPEG alone, the best first."""


def parse_properties(data: Buffer) -> dict[int, PropertyDescription]:
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


def seconds(value: int) -> float | None:
    """The exposure time of a shutter value: numerator and denominator of 16 bits; None for bulb (0)."""
    above, below = value >> 16, value & 0xFFFF
    return above / below if above > 0 and below else None


def iso(value: int) -> int | None:
    """The ISO speed of a value; None for automatic ones and those that mix several pictures."""
    return value if 0 < value < _AUTO_ISO else None
