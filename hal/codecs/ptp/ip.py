"""PTP/IP packets (CIPA DC-005) of the two TCP connections to a camera. No I/O.

Every packet is u32 length, u32 type, body; little endian; the length counts the eight bytes of the header.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import ClassVar, Final

from hal.codecs.ptp.values import MOST_PARAMETERS, Buffer, Reader, broken, printable
from hal.errors import ProtocolError

HEADER: Final = struct.Struct("<II")
LARGEST_CONTROL: Final = 4096
"""Largest size of packets other than Data and EndData; a friendly name is their longest part."""
LARGEST_DATA: Final = 0x1000_0000
VERSION: Final = 0x0001_0000
UNKNOWN_TOTAL: Final = frozenset({0xFFFF_FFFF, 0xFFFF_FFFF_FFFF_FFFF})
"""Totals of StartData that mean "I do not know yet"."""
DATA_TYPES: Final = frozenset({10, 12})
_LONGEST_NAME: Final = 256


@dataclass(frozen=True, slots=True)
class InitCommandRequest:
    """First packet on the command connection: the caller's name."""

    TYPE: ClassVar[int] = 1
    guid: bytes
    name: str
    version: int = VERSION


@dataclass(frozen=True, slots=True)
class InitCommandAck:
    """The camera accepts; ``connection`` identifies it on the event connection."""

    TYPE: ClassVar[int] = 2
    connection: int
    guid: bytes
    name: str
    version: int = VERSION


@dataclass(frozen=True, slots=True)
class InitEventRequest:
    TYPE: ClassVar[int] = 3
    connection: int


@dataclass(frozen=True, slots=True)
class InitEventAck:
    TYPE: ClassVar[int] = 4


@dataclass(frozen=True, slots=True)
class InitFail:
    """``reason``: 1 caller rejected, 2 busy with another one, 3 not specified."""

    TYPE: ClassVar[int] = 5
    reason: int


@dataclass(frozen=True, slots=True)
class Request:
    """An operation. ``phase`` is 2 where the caller sends data, else 1."""

    TYPE: ClassVar[int] = 6
    phase: int
    code: int
    transaction: int
    parameters: tuple[int, ...] = ()


@dataclass(frozen=True, slots=True)
class Response:
    TYPE: ClassVar[int] = 7
    code: int
    transaction: int
    parameters: tuple[int, ...] = ()


@dataclass(frozen=True, slots=True)
class Event:
    TYPE: ClassVar[int] = 8
    code: int
    transaction: int
    parameters: tuple[int, ...] = ()


@dataclass(frozen=True, slots=True)
class StartData:
    """``total`` bytes follow in Data and EndData packets."""

    TYPE: ClassVar[int] = 9
    transaction: int
    total: int


@dataclass(frozen=True, slots=True)
class Data:
    TYPE: ClassVar[int] = 10
    transaction: int
    payload: bytes


@dataclass(frozen=True, slots=True)
class Cancel:
    TYPE: ClassVar[int] = 11
    transaction: int


@dataclass(frozen=True, slots=True)
class EndData:
    TYPE: ClassVar[int] = 12
    transaction: int
    payload: bytes


@dataclass(frozen=True, slots=True)
class Ping:
    TYPE: ClassVar[int] = 13


@dataclass(frozen=True, slots=True)
class Pong:
    TYPE: ClassVar[int] = 14


Packet = (
    InitCommandRequest
    | InitCommandAck
    | InitEventRequest
    | InitEventAck
    | InitFail
    | Request
    | Response
    | Event
    | StartData
    | Data
    | Cancel
    | EndData
    | Ping
    | Pong
)


def parse_header(header: Buffer) -> tuple[int, int]:
    """(length of the body in bytes, type). Raises ProtocolError for an unknown type or an impossible length."""
    if len(header) != HEADER.size:
        raise broken("a packet without a whole header")
    length, kind = HEADER.unpack(header)
    if not 1 <= kind <= 14:
        raise broken(f"a packet of the unknown type {kind}")
    if not HEADER.size <= length <= (LARGEST_DATA if kind in DATA_TYPES else LARGEST_CONTROL):
        raise broken(f"a packet of type {kind} that claims {length} bytes")
    return length - HEADER.size, kind


def parse(kind: int, body: Buffer) -> Packet:  # noqa: PLR0911 - one line a packet type reads best
    """The packet of type ``kind`` with this body (without the header)."""
    read = Reader(body, f"a packet of type {kind}")
    match kind:
        case 1:
            return InitCommandRequest(bytes(read.take(16)), _name(read), read.number("I"))
        case 2:
            return InitCommandAck(read.number("I"), bytes(read.take(16)), _name(read), read.number("I"))
        case 3:
            return InitEventRequest(read.number("I"))
        case 4:
            return InitEventAck()
        case 5:
            return InitFail(read.number("I"))
        case 6:
            return Request(read.number("I"), read.number("H"), read.number("I"), _parameters(read))
        case 7 | 8:
            return (Response if kind == 7 else Event)(read.number("H"), read.number("I"), _parameters(read))
        case 9:
            return StartData(read.number("I"), read.number("Q"))
        case 10 | 12:
            return (Data if kind == 10 else EndData)(read.number("I"), bytes(read.take(read.left)))
        case 11:
            return Cancel(read.number("I"))
        case 13 | 14:
            return Ping() if kind == 13 else Pong()
        case _:
            raise broken(f"a packet of the unknown type {kind}")


def pack(packet: Packet) -> bytes:
    """The packet with its header. Raises ProtocolError (ours) where a number does not fit."""
    try:
        body = _body(packet)
    except struct.error as error:
        raise ProtocolError(
            "camera-packet",
            what=f"A packet for the camera has a number that does not fit: {error}.",
            remedy="Report this mistake of the driver to the maintainers.",
            theirs=False,
        ) from error
    return HEADER.pack(HEADER.size + len(body), packet.TYPE) + body


def _body(packet: Packet) -> bytes:  # noqa: PLR0911 - one line a packet type reads best
    match packet:
        case InitCommandRequest(guid, name, version):
            return struct.pack("<16s", guid) + _utf16(name) + struct.pack("<I", version)
        case InitCommandAck(connection, guid, name, version):
            return struct.pack("<I16s", connection, guid) + _utf16(name) + struct.pack("<I", version)
        case InitEventRequest(number) | InitFail(number) | Cancel(number):
            return struct.pack("<I", number)
        case Request(phase, code, transaction, parameters):
            return struct.pack(f"<IHI{len(parameters)}I", phase, code, transaction, *parameters)
        case Response(code, transaction, parameters) | Event(code, transaction, parameters):
            return struct.pack(f"<HI{len(parameters)}I", code, transaction, *parameters)
        case StartData(transaction, total):
            return struct.pack("<IQ", transaction, total)
        case Data(transaction, payload) | EndData(transaction, payload):
            return struct.pack("<I", transaction) + payload
        case _:
            return b""


def _parameters(read: Reader) -> tuple[int, ...]:
    count, odd = divmod(read.left, 4)
    if odd or count > MOST_PARAMETERS:
        raise broken(f"an answer with {read.left} bytes of parameters")
    return read.numbers("I", count)


def _utf16(name: str) -> bytes:
    return (name[:_LONGEST_NAME] + "\0").encode("utf-16-le")


def _name(read: Reader) -> str:
    """A name ends with its terminator, and the version follows; some cameras omit the terminator."""
    units: list[int] = []
    while read.left > 4 and len(units) <= _LONGEST_NAME:
        unit = read.number("H")
        if unit == 0:
            break
        units.append(unit)
    return printable(struct.pack(f"<{len(units)}H", *units).decode("utf-16-le", errors="replace"))
