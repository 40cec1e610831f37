"""Art-Net 4: three channels of a universe pick the appearance, dim, and set the fade; controllers find the stage."""

from __future__ import annotations

import asyncio
import ipaddress
import random
import socket
import time
from typing import Any, Final

from pydantic import Field

from controller.kiosk.building import artnet_packets as packets
from controller.kiosk.building.desk import DeskOptions, follow
from controller.kiosk.building.dmx import Frame, Sources
from controller.kiosk.building.protocol import Protocol
from controller.kiosk.building.verbs import Verbs

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


def frame_of(levels: packets.Levels, source: str, options: ArtNetOptions) -> Frame | None:
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
        match packets.read(data):
            case packets.Levels() as levels:
                if (frame := frame_of(levels, peer, options)) is not None:
                    self._sources.take(frame, time.monotonic())
            case packets.Poll(lowest, highest) if lowest <= options.universe <= highest:
                if peer not in self._waiting and len(self._waiting) < MOST_POLLS_WAITING:
                    delay_s = random.uniform(0, LONGEST_DELAY_S)
                    self._waiting[peer] = asyncio.get_running_loop().call_later(delay_s, self._answer, peer)

    def _answer(self, peer: str) -> None:
        del self._waiting[peer]
        now, options = self._verbs.status(), self._options
        receiving = self._sources.levels(time.monotonic()) is not None
        node = packets.Node(
            _own_address(self._channel, peer), options.port, options.universe, now.stage, f"Velatura: {now.stage}",
            receiving, self._answers,
        )  # fmt: skip
        self._answers += 1
        # Controllers hear at the port of the protocol, wherever they ask from.
        self._channel.sendto(packets.reply(node), (peer, options.port))


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
