"""Art-Net 4: three channels of a universe pick the appearance, dim, and set the fade; controllers find the stage.

First the packets as bytes, without input or output: levels and polls are read, the answer to a poll is written.
"""

from __future__ import annotations

import asyncio
import ipaddress
import random
import socket
import struct
import time
from dataclasses import dataclass
from typing import Any, Final

from pydantic import Field

from controller.kiosk.building.dmx import DeskOptions, Frame, Sources, follow
from controller.kiosk.building.protocol import Protocol
from controller.kiosk.building.verbs import Verbs

ID: Final = b"Art-Net\0"
POLL: Final = 0x2000
POLL_REPLY: Final = 0x2100
DMX: Final = 0x5000
VERSION: Final = 14
"""The only version of the protocol that any product ever had; a receiver accepts newer ones."""
_HEAD: Final = struct.Struct("<8sH")
_DMX: Final = struct.Struct(">HBBBBH")
_TARGETED: Final = 0x20
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
    # In the order and with the names of the standard.
    fields = {
        "ID": ID,
        "OpCode": POLL_REPLY.to_bytes(2, "little"),
        "IpAddress": address,
        "Port": node.port.to_bytes(2, "little"),
        "VersInfo": bytes(2),
        "NetSwitch, SubSwitch": bytes((node.universe >> 8, node.universe >> 4 & 0xF)),
        "Oem": _OEM_UNKNOWN,
        "UbeaVersion, Status1": bytes((0, _SET_AT_THE_DEVICE)),
        "EstaMan": _ESTA_PROTOTYPE.to_bytes(2, "little"),
        "PortName": _text(node.name, 18),
        "LongName": _text(node.description, 64),
        "NodeReport": _text(f"#0001 [{node.answers % 10000:04d}] Power on tests passed", 64),
        "NumPorts": b"\x00\x01",
        "PortTypes": _first(_OUTPUT_OF_DMX),
        "GoodInput": bytes(4),
        "GoodOutputA": _first(_RECEIVING if node.receiving else 0),
        "SwIn": bytes(4),
        "SwOut": _first(port),
        "AcnPriority, SwMacro, SwRemote, Spare, Style": bytes(7),
        "MAC": bytes(6),
        "BindIp": address,
        "BindIndex, Status2": bytes((1, _LONG_UNIVERSES)),
        "GoodOutputB": bytes(4),
        "Status3, DefaultRespUID, User, RefreshRate, BackgroundQueuePolicy, Filler": bytes(22),
    }
    return b"".join(fields.values())


def _first(value: int) -> bytes:
    """An array for four ports, of which we have one."""
    return bytes((value, 0, 0, 0))


def _text(text: str, size: int) -> bytes:
    """With a zero at the end; ASCII, because the standard names no other."""
    return text.encode("ascii", "replace")[: size - 1].ljust(size, b"\0")


LOST_S: Final = 10.0
"""A controller repeats unchanged levels after 4 s at the latest; two may be lost on the way."""
LONGEST_DELAY_S: Final = 1.0
"""Answers to a poll are spread over this time, as the standard asks."""
MOST_POLLS_WAITING: Final = 20


class ArtNetOptions(DeskOptions):
    """``universe``: net, sub-net and universe in one number, from 0. ``broadcast``: also hear what is sent to all."""

    port: int = Field(default=6454, ge=1, le=65535)
    universe: int = Field(default=0, ge=0, le=0x7FFF)
    broadcast: bool = False


def frame_of(levels: Levels, source: str, options: ArtNetOptions) -> Frame | None:
    """None for another universe, and for fewer channels than ours."""
    first = options.channel - 1
    ours = levels.values[first : first + 3]
    if levels.universe != options.universe or len(ours) < 3:
        return None
    # There are no priorities: the first controller counts until it is lost.
    return Frame(source, 0, levels.sequence or None, False, (ours[0], ours[1], ours[2]))


class _Listener(asyncio.DatagramProtocol):
    def __init__(self, options: ArtNetOptions, sources: Sources, verbs: Verbs) -> None:
        self._options, self._sources, self._verbs = options, sources, verbs
        self._waiting: dict[str, asyncio.TimerHandle] = {}
        self._answers = 0

    def connection_made(self, transport: Any) -> None:
        self._channel: asyncio.DatagramTransport = transport

    def connection_lost(self, exc: Exception | None) -> None:
        for answer in self._waiting.values():
            answer.cancel()

    def datagram_received(self, data: bytes, addr: Any) -> None:
        peer, options = str(addr[0]), self._options
        if not options.allows(peer):
            return
        match read(data):
            case Levels() as levels:
                if (frame := frame_of(levels, peer, options)) is not None:
                    self._sources.take(frame, time.monotonic())
            case Poll(lowest, highest) if lowest <= options.universe <= highest:
                if peer not in self._waiting and len(self._waiting) < MOST_POLLS_WAITING:
                    delay_s = random.uniform(0, LONGEST_DELAY_S)
                    self._waiting[peer] = asyncio.get_running_loop().call_later(delay_s, self._answer, peer)

    def _answer(self, peer: str) -> None:
        del self._waiting[peer]
        now, options = self._verbs.status(), self._options
        receiving = self._sources.levels(time.monotonic()) is not None
        node = Node(
            _own_address(self._channel, peer), options.port, options.universe, now.stage, f"Velatura: {now.stage}",
            receiving, self._answers,
        )  # fmt: skip
        self._answers += 1
        # Controllers hear at the port of the protocol, wherever they ask from.
        self._channel.sendto(reply(node), (peer, options.port))


async def serve(options: ArtNetOptions, verbs: Verbs) -> None:
    """Serve until cancelled. Raises OSError if it can't listen."""
    sources = Sources(lost_s=LOST_S)
    channel, _ = await asyncio.get_running_loop().create_datagram_endpoint(
        lambda: _Listener(options, sources, verbs), sock=_socket(options)
    )
    try:
        await follow(sources, options, verbs)
    finally:
        channel.close()


def _socket(options: ArtNetOptions) -> socket.socket:
    made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        made.setblocking(False)
        # A socket that is bound to one address hears no broadcasts; ``allow`` still says who counts. Other programs on
        # this computer may hear them too.
        made.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, int(options.broadcast))
        made.bind(("" if options.broadcast else options.host, options.port))
    except OSError:
        made.close()
        raise
    return made


def _own_address(channel: asyncio.DatagramTransport, peer: str) -> str:
    """The address at which ``peer`` reaches us."""
    bound = ipaddress.IPv4Address(channel.get_extra_info("sockname")[0])
    if not bound.is_unspecified:
        return str(bound)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.connect((peer, 9))  # sends nothing
        return str(probe.getsockname()[0])


PROTOCOL: Final = Protocol("artnet", "Art-Net", ArtNetOptions, serve)
