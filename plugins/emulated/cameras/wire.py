"""The emulated camera's own reading and writing of PTP/IP, from the specification and not from ``hal``.

Written twice on purpose: a mistake that the driver and the emulator shared would hide.
"""

from __future__ import annotations

import socket
import struct
from dataclasses import dataclass
from typing import Final

OK: Final = 0x2001
GENERAL_ERROR: Final = 0x2002
NOT_SUPPORTED: Final = 0x2005
NO_SUCH_HANDLE: Final = 0x2009
NO_SUCH_PROPERTY: Final = 0x200A
WRONG_FORMAT: Final = 0x200B
STORE_FULL: Final = 0x200C
NO_THUMBNAIL: Final = 0x2010
BUSY: Final = 0x2019
NOT_READY: Final = 0xA102
WRONG_VALUE: Final = 0x201C
NOT_OPEN: Final = 0x2003
ALREADY_OPEN: Final = 0x201E

INIT_COMMAND, INIT_COMMAND_ACK, INIT_EVENT, INIT_EVENT_ACK, INIT_FAIL = 1, 2, 3, 4, 5
REQUEST, RESPONSE, EVENT, START_DATA, DATA, CANCEL, END_DATA, PING, PONG = 6, 7, 8, 9, 10, 11, 12, 13, 14

_LARGEST: Final = 1 << 20
_BLOCK: Final = 1 << 20


@dataclass(frozen=True, slots=True)
class PtpOutcome:
    """What a request leads to: response code and parameters, and data to send first (None: no data phase)."""

    code: int = OK
    parameters: tuple[int, ...] = ()
    data: bytes | memoryview | None = None


class Gone(Exception):
    """The other side closed, or sent unreadable data."""


def text(value: str) -> bytes:
    """A PTP string."""
    return bytes([len(value) + 1]) + (value + "\0").encode("utf-16-le") if value else b"\0"


def u16s(*values: int) -> bytes:
    """A PTP array of 16-bit codes."""
    return struct.pack("<I", len(values)) + b"".join(struct.pack("<H", value) for value in values)


def u32s(*values: int) -> bytes:
    """A PTP array of 32-bit numbers."""
    return struct.pack("<I", len(values)) + b"".join(struct.pack("<I", value) for value in values)


def receive(connection: socket.socket) -> tuple[int, bytes]:
    """(type, body) of the next packet. Raises Gone."""
    length, kind = struct.unpack("<II", _exactly(connection, 8))
    if not 8 <= length <= _LARGEST:
        raise Gone
    return kind, _exactly(connection, length - 8)


def _exactly(connection: socket.socket, count: int) -> bytes:
    data = b""
    while len(data) < count:
        try:
            piece = connection.recv(count - len(data))
        except OSError as error:
            raise Gone from error
        if not piece:
            raise Gone
        data += piece
    return data


def send(connection: socket.socket, kind: int, body: bytes = b"") -> None:
    """Send one packet. Raises Gone."""
    try:
        connection.sendall(struct.pack("<II", 8 + len(body), kind) + body)
    except OSError as error:
        raise Gone from error


def send_data(connection: socket.socket, transaction: int, data: bytes | memoryview, *, announce: int) -> None:
    """A whole data phase towards the computer; ``announce`` is the total that StartData claims."""
    send(connection, START_DATA, struct.pack("<IQ", transaction, announce))
    view = memoryview(data)
    try:
        while len(view) > _BLOCK:
            connection.sendall(struct.pack("<III", 12 + _BLOCK, DATA, transaction))
            connection.sendall(view[:_BLOCK])
            view = view[_BLOCK:]
        connection.sendall(struct.pack("<III", 12 + len(view), END_DATA, transaction))
        connection.sendall(view)
    except OSError as error:
        raise Gone from error


def receive_data(connection: socket.socket) -> bytes:
    """The data phase that follows a request with phase 2."""
    kind, body = receive(connection)
    if kind != START_DATA:
        raise Gone
    data = b""
    while kind != END_DATA:
        kind, body = receive(connection)
        if kind not in (DATA, END_DATA):
            raise Gone
        data += body[4:]
    return data
