"""Packets of Art-Net 4 as bytes: levels and polls read, the answer to a poll written. No I/O."""

from __future__ import annotations

import ipaddress
import struct
from dataclasses import dataclass
from typing import Final

ID: Final = b"Art-Net\0"
POLL: Final = 0x2000
POLL_REPLY: Final = 0x2100
DMX: Final = 0x5000
VERSION: Final = 14
"""The only version of the protocol that any product ever had; a receiver accepts newer ones."""
_HEAD: Final = struct.Struct("<8sH")
_DMX: Final = struct.Struct(">HBBBBH")
_TARGETED: Final = 0x20
_REPLY: Final = struct.Struct("<8sH4sH2sBB2sBBH18s64s64s2s4s4s4s4s4sBBB3xB6s4sBB4sB6s2s2sB10x")
_OEM_UNKNOWN: Final = b"\x00\xff"
_ESTA_PROTOTYPE: Final = 0x7FF0
_OUTPUT_OF_DMX: Final = 0x80
_RECEIVING: Final = 0x80
_SET_AT_THE_DEVICE: Final = 0xD0
"""Indicators normal; the universe can't be changed through the network."""
_LONG_UNIVERSES: Final = 0x08


@dataclass(frozen=True, slots=True)
class Levels:
    """ArtDmx: ``universe`` 0 to 32767 (net, sub-net and universe in one), ``sequence`` 1 to 255 or 0 for none."""

    universe: int
    sequence: int
    values: bytes


@dataclass(frozen=True, slots=True)
class Poll:
    """ArtPoll, which asks the nodes with ``lowest`` to ``highest`` universe who they are."""

    lowest: int = 0
    highest: int = 0x7FFF


@dataclass(frozen=True, slots=True)
class Node:
    """What we say of ourselves: our IPv4 ``address`` and UDP ``port``, names, and whether levels arrive."""

    address: str
    port: int
    universe: int
    name: str
    description: str
    receiving: bool
    answers: int
    """How many polls were answered before, for people who read the report."""


def read(datagram: bytes) -> Levels | Poll | None:
    """None for anything else: other packets of Art-Net, and what is damaged."""
    if len(datagram) < 14 or datagram[: len(ID)] != ID:
        return None
    code = _HEAD.unpack_from(datagram)[1]
    if int.from_bytes(datagram[10:12], "big") < VERSION:
        return None
    return _levels(datagram) if code == DMX else _poll(datagram) if code == POLL else None


def _levels(datagram: bytes) -> Levels | None:
    if len(datagram) < _HEAD.size + _DMX.size:
        return None
    _, sequence, _, low, high, length = _DMX.unpack_from(datagram, _HEAD.size)
    values = datagram[_HEAD.size + _DMX.size :]
    if not 1 <= length <= min(512, len(values)) or high > 0x7F:
        return None
    return Levels(high << 8 | low, sequence, values[:length])


def _poll(datagram: bytes) -> Poll:
    if not datagram[12] & _TARGETED or len(datagram) < 18:
        return Poll()
    highest, lowest = struct.unpack_from(">HH", datagram, 14)
    return Poll(lowest, highest)


def reply(node: Node) -> bytes:
    """ArtPollReply: one port that takes DMX levels from Art-Net."""
    address = ipaddress.IPv4Address(node.address).packed
    port = node.universe & 0xF
    return _REPLY.pack(
        ID, POLL_REPLY, address, node.port, bytes(2), node.universe >> 8, node.universe >> 4 & 0xF, _OEM_UNKNOWN, 0,
        _SET_AT_THE_DEVICE, _ESTA_PROTOTYPE, _text(node.name, 18), _text(node.description, 64),
        _text(f"#0001 [{node.answers % 10000:04d}] Power on tests passed", 64), b"\x00\x01",
        _first(_OUTPUT_OF_DMX), bytes(4), _first(_RECEIVING if node.receiving else 0), bytes(4), _first(port),
        0, 0, 0, 0, bytes(6), address, 1, _LONG_UNIVERSES, bytes(4), 0, bytes(6), bytes(2), bytes(2), 0,
    )  # fmt: skip


def _first(value: int) -> bytes:
    """An array for four ports, of which we have one."""
    return bytes((value, 0, 0, 0))


def _text(text: str, size: int) -> bytes:
    """With a zero at the end; ASCII, because the standard names no other."""
    return text.encode("ascii", "replace")[: size - 1].ljust(size, b"\0")
