"""Picture Transfer Protocol: codes and the bounded reading and writing of its values (ISO 15740, little endian).

Bytes to values and back; no I/O. A camera's data is untrusted input: every error in it raises
``ProtocolError``, and no memory is reserved for more bytes than received.
"""

from __future__ import annotations

import enum
import struct
from collections.abc import Sequence
from typing import Final

from hal.errors import ProtocolError

Buffer = bytes | bytearray | memoryview

MOST_PARAMETERS: Final = 5
LONGEST_STRING: Final = 255
"""UTF-16 units of a string, with its terminator: its length is one byte."""


class Operation(enum.IntEnum):
    """Operation codes (ISO 15740 10.4) and those of Canon EOS (as libgphoto2 documents them)."""

    GET_DEVICE_INFO = 0x1001
    OPEN_SESSION = 0x1002
    CLOSE_SESSION = 0x1003
    GET_STORAGE_IDS = 0x1004
    GET_STORAGE_INFO = 0x1005
    GET_OBJECT_HANDLES = 0x1007
    GET_OBJECT_INFO = 0x1008
    GET_OBJECT = 0x1009
    DELETE_OBJECT = 0x100B
    INITIATE_CAPTURE = 0x100E
    GET_PROPERTY_DESCRIPTION = 0x1014
    GET_PROPERTY = 0x1015
    SET_PROPERTY = 0x1016
    GET_PARTIAL_OBJECT = 0x101B
    EOS_GET_PARTIAL_OBJECT = 0x9107
    EOS_RELEASE = 0x910F
    EOS_SET_PROPERTY = 0x9110
    EOS_SET_REMOTE_MODE = 0x9114
    EOS_SET_EVENT_MODE = 0x9115
    EOS_GET_EVENT = 0x9116
    EOS_TRANSFER_COMPLETE = 0x9117
    EOS_HOST_CAPACITY = 0x911A
    EOS_KEEP_DEVICE_ON = 0x911D
    EOS_BULB_START = 0x9125
    EOS_BULB_END = 0x9126
    EOS_RELEASE_ON = 0x9128
    EOS_RELEASE_OFF = 0x9129
    EOS_GET_VIEWFINDER = 0x9153


class Answer(enum.IntEnum):
    """Response codes (ISO 15740 11.2)."""

    OK = 0x2001
    GENERAL_ERROR = 0x2002
    SESSION_NOT_OPEN = 0x2003
    OPERATION_NOT_SUPPORTED = 0x2005
    PARAMETER_NOT_SUPPORTED = 0x2006
    INCOMPLETE_TRANSFER = 0x2007
    INVALID_OBJECT_HANDLE = 0x2009
    PROPERTY_NOT_SUPPORTED = 0x200A
    INVALID_OBJECT_FORMAT = 0x200B
    STORE_FULL = 0x200C
    WRITE_PROTECTED = 0x200D
    STORE_READ_ONLY = 0x200E
    ACCESS_DENIED = 0x200F
    STORE_NOT_AVAILABLE = 0x2013
    FORMAT_NOT_SELECTABLE = 0x2014
    DEVICE_BUSY = 0x2019
    INVALID_PROPERTY_VALUE = 0x201C
    SESSION_ALREADY_OPEN = 0x201E
    VENDOR_BUSY = 0xA102


class EventCode(enum.IntEnum):
    """Event codes (ISO 15740 12.5)."""

    OBJECT_ADDED = 0x4002
    OBJECT_REMOVED = 0x4003
    PROPERTY_CHANGED = 0x4006
    STORE_FULL = 0x400A
    CAPTURE_COMPLETE = 0x400D


class Format(enum.IntEnum):
    """Object formats (ISO 15740 6.2), and the vendors' raw formats."""

    UNDEFINED = 0x3000
    FOLDER = 0x3001
    JPEG = 0x3801
    DNG = 0x3811
    CANON_CRW = 0xB101
    CANON_CR2 = 0xB103
    CANON_CR3 = 0xB108


RAW_FORMATS: Final = (Format.DNG, Format.CANON_CR2, Format.CANON_CR3, Format.CANON_CRW)


class Property(enum.IntEnum):
    """Device properties (ISO 15740 13.3.5)."""

    BATTERY_LEVEL = 0x5001
    F_NUMBER = 0x5007
    EXPOSURE_TIME = 0x500D
    EXPOSURE_PROGRAM = 0x500E
    EXPOSURE_INDEX = 0x500F
    COMPRESSION = 0x5004


def broken(what: str) -> ProtocolError:
    """The error for bytes that PTP does not allow; ``what`` completes "The camera sent ..."."""
    return ProtocolError(
        "camera-protocol",
        what=f"The camera sent {what}.",
        remedy="Switch the camera off and on. If it happens again, report it with a tape (`velatura record`).",
    )


def printable(text: str) -> str:
    """``text`` from a device with unprintable characters replaced, so that a log or terminal is not affected."""
    return "".join(letter if letter.isprintable() else "\N{REPLACEMENT CHARACTER}" for letter in text)


class Reader:
    """Reads little-endian values from one dataset, never past its end.

    Every method raises ProtocolError if there are too few bytes. ``name`` is for the message.
    """

    __slots__ = ("_at", "_data", "_name")

    def __init__(self, data: Buffer, name: str) -> None:
        self._data = memoryview(data).cast("B")
        self._at = 0
        self._name = name

    @property
    def left(self) -> int:
        """Bytes not read yet."""
        return len(self._data) - self._at

    def number(self, code: str) -> int:
        """One integer of struct's format character ``code`` ("B", "H", "I", "Q", "b", "h", "i" or "q")."""
        value: int = self._unpack(struct.calcsize("<" + code), "<" + code)[0]
        return value

    def numbers(self, code: str, count: int) -> tuple[int, ...]:
        """``count`` integers of one kind."""
        return self._unpack(struct.calcsize("<" + code) * count, f"<{count}{code}")

    def array(self, code: str) -> tuple[int, ...]:
        """A PTP array: a 32-bit count, then its integers (ISO 15740 5.3.4)."""
        count = self.number("I")
        if count * struct.calcsize("<" + code) > self.left:
            raise broken(f"{self._name} with an array of {count} values and only {self.left} bytes for them")
        return self.numbers(code, count)

    def string(self) -> str:
        """A PTP string: a count byte, then UTF-16 with a terminator (ISO 15740 5.3.3), made printable."""
        text = bytes(self.take(2 * self.number("B"))).decode("utf-16-le", errors="replace")
        return printable(text.split("\0", 1)[0])

    def take(self, count: int) -> memoryview:
        """The next ``count`` bytes."""
        if count > self.left:
            raise broken(f"{self._name} that ends {count - self.left} bytes too soon")
        self._at += count
        return self._data[self._at - count : self._at]

    def _unpack(self, size: int, code: str) -> tuple[int, ...]:
        if size > self.left:
            raise broken(f"{self._name} that ends {size - self.left} bytes too soon")
        values = struct.unpack_from(code, self._data, self._at)
        self._at += size
        return values


def pack_array(code: str, values: Sequence[int]) -> bytes:
    """A PTP array of integers of struct's format character ``code``."""
    return struct.pack(f"<I{len(values)}{code}", len(values), *values)


def pack_string(text: str) -> bytes:
    """A PTP string; "" is a single zero byte. Raises ProtocolError (ours) above 254 UTF-16 units."""
    if not text:
        return b"\0"
    data = (text + "\0").encode("utf-16-le")
    if len(data) > 2 * LONGEST_STRING or "\0" in text:
        raise ProtocolError(
            "camera-string",
            what="A text for the camera is too long or contains a zero character.",
            remedy="Use at most 254 plain characters.",
            theirs=False,
        )
    return bytes([len(data) // 2]) + data


def parse_handles(data: Buffer) -> tuple[int, ...]:
    """Object handles (answer to 1007) or storage ids (answer to 1004): a PTP array of u32."""
    return Reader(data, "a list of objects").array("I")
