"""PTP over USB: the containers on the bulk and interrupt pipes, and the class requests (PIMA 15740, annex D). No I/O.

A container is u32 length, u16 kind, u16 code, u32 transaction, then parameters or data; little endian; the length
counts the twelve bytes of the header. A data container whose length does not fit says 0xFFFFFFFF and ends with the
first short packet.
"""

from __future__ import annotations

import enum
import struct
from dataclasses import dataclass
from typing import Final

from hal.codecs.ptp.values import MOST_PARAMETERS, Buffer, broken
from hal.errors import ProtocolError

HEADER: Final = struct.Struct("<IHHI")
UNKNOWN_LENGTH: Final = 0xFFFF_FFFF
COMMAND, DATA, RESPONSE, EVENT = 1, 2, 3, 4
LARGEST_EVENT: Final = 64
STILL_IMAGE_CLASS: Final = (6, 1, 1)
"""Interface class, subclass and protocol of a still camera."""
_LARGEST_CONTROL: Final = HEADER.size + 4 * MOST_PARAMETERS
_CANCELLATION: Final = 0x4001


class ClassRequest(enum.IntEnum):
    """Control requests of the still image class (annex D.5)."""

    CANCEL = 0x64
    RESET = 0x66
    STATUS = 0x67


@dataclass(frozen=True, slots=True)
class DeviceStatus:
    """The device's status (0x67): a response code, and its halted pipes."""

    code: int
    halted: tuple[int, ...] = ()


def parse_header(header: Buffer) -> tuple[int, int, int, int]:
    """(bytes after the header, kind, code, transaction); the bytes are -1 for a length that is not known yet.

    Raises ProtocolError for fewer than twelve bytes, an unknown kind or an impossible length.
    """
    if len(header) < HEADER.size:
        raise broken(f"a container of {len(header)} bytes")
    length, kind, code, transaction = HEADER.unpack_from(header)
    if kind == DATA:
        if length == UNKNOWN_LENGTH:
            return -1, kind, code, transaction
        if length >= HEADER.size:
            return length - HEADER.size, kind, code, transaction
    elif kind in (RESPONSE, EVENT, COMMAND) and HEADER.size <= length <= _LARGEST_CONTROL and not length & 3:
        return length - HEADER.size, kind, code, transaction
    raise broken(f"a container of kind {kind} that claims {length} bytes")


def parse_parameters(body: Buffer) -> tuple[int, ...]:
    """The parameters of a response or event: whole 32-bit numbers, at most five."""
    count, odd = divmod(len(body), 4)
    if odd or count > MOST_PARAMETERS:
        raise broken(f"an answer with {len(body)} bytes of parameters")
    return struct.unpack(f"<{count}I", body)


def parse_event(data: Buffer) -> tuple[int, tuple[int, ...]]:
    """(code, parameters) of an event container. Bytes beyond its length are ignored: some bodies pad the packet."""
    length, kind, code, _ = parse_header(data)
    if kind != EVENT or length > len(data) - HEADER.size:
        raise broken(f"{len(data)} bytes on its event pipe that are not an event")
    return code, parse_parameters(memoryview(data)[HEADER.size : HEADER.size + length])


def pack_command(code: int, transaction: int, parameters: tuple[int, ...] = ()) -> bytes:
    """A command container. Raises ProtocolError (ours) where a number does not fit."""
    count = len(parameters)
    try:
        return struct.pack(f"<IHHI{count}I", HEADER.size + 4 * count, COMMAND, code, transaction, *parameters)
    except struct.error as error:
        raise ProtocolError(
            "camera-packet",
            what=f"A command for the camera has a number that does not fit: {error}.",
            remedy="Report this mistake of the driver to the maintainers.",
            theirs=False,
        ) from error


def pack_data(code: int, transaction: int, data: bytes) -> bytes:
    """A data container with its data."""
    return HEADER.pack(min(HEADER.size + len(data), UNKNOWN_LENGTH), DATA, code, transaction) + data


def pack_cancel(transaction: int) -> bytes:
    """Data of the cancel request."""
    return struct.pack("<HI", _CANCELLATION, transaction)


def parse_status(data: Buffer) -> DeviceStatus:
    """The answer to the status request: u16 length, u16 code, then 32-bit numbers of halted pipes."""
    if len(data) < 4:
        raise broken(f"a status of {len(data)} bytes")
    length, code = struct.unpack_from("<HH", data)
    if not 4 <= length <= len(data) or length % 4 or length > 4 + 4 * 16:
        raise broken(f"a status of {len(data)} bytes that claims {length}")
    return DeviceStatus(code, struct.unpack_from(f"<{(length - 4) // 4}I", data, 4))
