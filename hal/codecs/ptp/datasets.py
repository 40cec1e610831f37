"""The datasets of PTP: DeviceInfo, StorageInfo, ObjectInfo, DevicePropDesc (ISO 15740 5.5 and 13.3.3).

``parse`` raises ProtocolError for an incomplete dataset. Further bytes are allowed: vendors append data.
"""

from __future__ import annotations

import enum
import struct
from dataclasses import dataclass
from typing import Final, Self

from hal.codecs.ptp.values import Buffer, Reader, broken, pack_array, pack_string
from hal.errors import ProtocolError

Value = int | str | tuple[int, ...]

_NUMBER_CODES: Final = {1: "b", 2: "B", 3: "h", 4: "H", 5: "i", 6: "I", 7: "q", 8: "Q"}
_ARRAY: Final = 0x4000
_STRING: Final = 0xFFFF


@dataclass(frozen=True, slots=True)
class DeviceInfo:
    """The device's identity and capabilities (answer to 1001)."""

    vendor_extension: int
    operations: frozenset[int]
    events: frozenset[int]
    properties: frozenset[int]
    capture_formats: tuple[int, ...]
    image_formats: tuple[int, ...]
    manufacturer: str
    model: str
    version: str
    serial: str

    @classmethod
    def parse(cls, data: Buffer) -> Self:
        read = Reader(data, "a device description")
        _, vendor, _ = read.number("H"), read.number("I"), read.number("H")
        read.string()
        read.number("H")
        sets = [frozenset(read.array("H")) for _ in range(3)]
        formats = [read.array("H") for _ in range(2)]
        maker, model, version, serial = (read.string() for _ in range(4))
        return cls(vendor, sets[0], sets[1], sets[2], formats[0], formats[1], maker, model, version, serial)

    def pack(self) -> bytes:
        sets = (sorted(self.operations), sorted(self.events), sorted(self.properties))
        return b"".join(
            (
                struct.pack("<HIH", 100, self.vendor_extension, 100),
                pack_string(""),
                struct.pack("<H", 0),
                *(pack_array("H", codes) for codes in (*sets, self.capture_formats, self.image_formats)),
                *(pack_string(text) for text in (self.manufacturer, self.model, self.version, self.serial)),
            )
        )


@dataclass(frozen=True, slots=True)
class StorageInfo:
    """One card or memory (answer to 1005); sizes in bytes. ``writable`` is false for read-only stores."""

    kind: int
    writable: bool
    capacity: int
    free: int
    free_images: int
    description: str
    label: str

    @classmethod
    def parse(cls, data: Buffer) -> Self:
        read = Reader(data, "a description of its card")
        kind, _, access = read.numbers("H", 3)
        capacity, free = read.numbers("Q", 2)
        return cls(kind, access == 0, capacity, free, read.number("I"), read.string(), read.string())

    def pack(self) -> bytes:
        head = struct.pack("<HHHQQI", self.kind, 2, int(not self.writable), self.capacity, self.free, self.free_images)
        return head + pack_string(self.description) + pack_string(self.label)


@dataclass(frozen=True, slots=True)
class ObjectInfo:
    """One file or folder on the device (answer to 1008); ``size`` in bytes, 0xFFFFFFFF meaning 4 GiB or more."""

    storage: int
    format: int
    size: int
    width_px: int
    height_px: int
    parent: int
    filename: str
    captured: str

    @classmethod
    def parse(cls, data: Buffer) -> Self:
        read = Reader(data, "a description of a picture")
        storage, format_code, _, size = read.number("I"), read.number("H"), read.number("H"), read.number("I")
        read.take(2 + 3 * 4)
        width_px, height_px, _, parent = read.numbers("I", 4)
        read.take(2 + 2 * 4)
        return cls(storage, format_code, size, width_px, height_px, parent, read.string(), read.string())

    def pack(self) -> bytes:
        thumbnail = struct.pack("<HIII", 0, 0, 0, 0)
        association = struct.pack("<HII", 0, 0, 0)
        return b"".join(
            (
                struct.pack("<IHHI", self.storage, self.format, 0, self.size),
                thumbnail,
                struct.pack("<IIII", self.width_px, self.height_px, 0, self.parent),
                association,
                *(pack_string(text) for text in (self.filename, self.captured, "", "")),
            )
        )


class Form(enum.IntEnum):
    """How a property says which values it takes."""

    NONE = 0
    RANGE = 1
    ENUMERATION = 2


@dataclass(frozen=True, slots=True)
class PropertyDescription:
    """A device property (answer to 1014).

    ``values`` holds the allowed values of an enumeration, or (minimum, maximum, step) of a range.
    """

    code: int
    data_type: int
    writable: bool
    default: Value
    current: Value
    form: Form = Form.NONE
    values: tuple[Value, ...] = ()

    @classmethod
    def parse(cls, data: Buffer) -> Self:
        read = Reader(data, "a description of a setting")
        code, data_type, access = read.number("H"), read.number("H"), read.number("B")
        default, current = read_value(read, data_type), read_value(read, data_type)
        form = read.number("B") if read.left else 0
        if form not in (Form.NONE, Form.RANGE, Form.ENUMERATION):
            raise broken(f"a setting whose values have form {form}")
        count = (0, 3, read.number("H") if form == Form.ENUMERATION else 0)[form]
        # Every value takes at least a byte, so a wrong count raises here and allocates no memory.
        values = tuple(read_value(read, data_type) for _ in range(count))
        return cls(code, data_type, access == 1, default, current, Form(form), values)

    def pack(self) -> bytes:
        parts = [
            struct.pack("<HHB", self.code, self.data_type, int(self.writable)),
            pack_value(self.data_type, self.default),
            pack_value(self.data_type, self.current),
            struct.pack("<B", self.form),
        ]
        if self.form is Form.ENUMERATION:
            parts.append(struct.pack("<H", len(self.values)))
        return b"".join(parts + [pack_value(self.data_type, value) for value in self.values])

    def numbers(self) -> tuple[int, ...]:
        """The allowed values of an enumeration of integers, ascending and without repeats; else empty."""
        if self.form is not Form.ENUMERATION:
            return ()
        return tuple(sorted({value for value in self.values if isinstance(value, int)}))


def read_value(read: Reader, data_type: int) -> Value:
    """One value of a PTP data type (ISO 15740 5.3): integers to 64 bits, their arrays, strings."""
    if data_type == _STRING:
        return read.string()
    if data_type in _NUMBER_CODES:
        return read.number(_NUMBER_CODES[data_type])
    if data_type ^ _ARRAY in _NUMBER_CODES:
        return read.array(_NUMBER_CODES[data_type ^ _ARRAY])
    raise broken(f"a value of the unknown type 0x{data_type:04x}")


def parse_value(data: Buffer, data_type: int) -> Value:
    """A bare value (answer to 1015)."""
    return read_value(Reader(data, "the value of a setting"), data_type)


def pack_value(data_type: int, value: Value) -> bytes:
    """A bare value (data of 1016). Raises ProtocolError (ours) where the value does not fit the type."""
    try:
        if data_type == _STRING and isinstance(value, str):
            return pack_string(value)
        if isinstance(value, int) and data_type in _NUMBER_CODES:
            return struct.pack("<" + _NUMBER_CODES[data_type], value)
        if isinstance(value, tuple) and data_type ^ _ARRAY in _NUMBER_CODES:
            return pack_array(_NUMBER_CODES[data_type ^ _ARRAY], value)
    except struct.error:
        pass  # the message fits here, too: the number is too large for the type
    raise ProtocolError(
        "camera-value",
        what=f"The value {value!r} does not fit the camera's type 0x{data_type:04x}.",
        remedy="Report this to the maintainers: the driver and the camera disagree about a setting.",
        theirs=False,
    )
