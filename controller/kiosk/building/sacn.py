"""Streaming ACN (ANSI E1.31): three channels of a universe pick the appearance, dim, and set the fade."""

from __future__ import annotations

import asyncio
import ipaddress
import socket
import struct
import time
from typing import Any, Final

from pydantic import Field
from sacn import DataPacket

from controller.kiosk.building.dmx import DeskOptions, Frame, Sources, follow
from controller.kiosk.building.protocol import Protocol
from controller.kiosk.building.verbs import Verbs


class SacnOptions(DeskOptions):
    """``multicast``: also join the universe's group, on the interface of ``host``."""

    port: int = Field(default=5568, ge=1, le=65535)
    universe: int = Field(default=1, ge=1, le=63999)
    multicast: bool = False


def frame_of(datagram: bytes, options: SacnOptions) -> Frame | None:
    """The levels in a datagram; None for another universe, a preview, no dimmer levels, or what is not E1.31."""
    try:
        packet = DataPacket.make_data_packet(tuple(datagram))
    except (TypeError, ValueError, IndexError, OverflowError):
        return None
    if packet.universe != options.universe or packet.option_PreviewData or packet.dmxStartCode != 0:
        return None
    first = options.channel - 1
    one, two, three = packet.dmxData[first : first + 3]
    ended = bool(packet.option_StreamTerminated)
    return Frame(bytes(packet.cid), packet.priority, packet.sequence, ended, (one, two, three))


class _Listener(asyncio.DatagramProtocol):
    def __init__(self, options: SacnOptions, sources: Sources) -> None:
        self._options, self._sources = options, sources

    def datagram_received(self, data: bytes, addr: Any) -> None:
        if self._options.allows(addr[0]) and (frame := frame_of(data, self._options)) is not None:
            self._sources.take(frame, time.monotonic())


async def serve(options: SacnOptions, verbs: Verbs) -> None:
    """Serve until cancelled. Raises OSError if it can't listen."""
    sources = Sources()
    channel, _ = await asyncio.get_running_loop().create_datagram_endpoint(
        lambda: _Listener(options, sources), sock=_socket(options)
    )
    try:
        await follow(sources, options, verbs)
    finally:
        channel.close()


def _socket(options: SacnOptions) -> socket.socket:
    made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        made.setblocking(False)
        made.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        # A socket that is bound to one address hears no multicast; ``allow`` still says who counts.
        made.bind(("" if options.multicast else options.host, options.port))
        if options.multicast:
            group = ipaddress.IPv4Address("239.255.0.0") + options.universe
            member = struct.pack("4s4s", group.packed, ipaddress.IPv4Address(options.host).packed)
            made.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, member)
    except OSError:
        made.close()
        raise
    return made


PROTOCOL: Final = Protocol("sacn", "sACN", SacnOptions, serve)
