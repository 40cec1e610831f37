"""Art-Net, from two senders by other authors: one finds the stage by itself, one does not ask; bad packets."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import aioartnet.client
import pytest
from aioartnet import ArtNetClient
from aioartnet.client import ArtNetClientProtocol
from hypothesis import given, settings
from hypothesis import strategies as st
from stupidArtnet import StupidArtnet

from controller.kiosk.building import artnet
from controller.kiosk.building.artnet import ArtNetOptions, Levels, Poll, frame_of
from controller.kiosk.building.dmx import Frame, Sources
from controller.kiosk.building.protocol import read, serving
from tests.controller.panel.memory_kiosk import MemoryKiosk
from tests.waiting import eventually, wait_for

DESK = "127.0.0.2"
UNIVERSE = 0x1234
"""Net 18, sub-net 3, universe 4."""


@contextlib.contextmanager
def shown(kiosk: MemoryKiosk, folder: Path, more: str = "") -> Iterator[int]:
    """The stage as a node of Art-Net; yields its port."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = int(free.getsockname()[1])
    text = f"[artnet]\nport = {port}\nuniverse = {UNIVERSE}\nchannel = 10\n{more}"
    (folder / "building.toml").write_text(text)
    with serving(kiosk, read(folder)):
        yield port


def levels(one: int, two: int, three: int) -> bytes:
    return bytes((*[0] * 9, one, two, three)).ljust(512, b"\0")


@contextlib.asynccontextmanager
async def desk(port: int) -> Any:
    """A controller at another address of this machine; its library has one port for all, the standard's."""
    client = ArtNetClient()
    client.listen_ip, client.unicast_ip, client.broadcast_ip = DESK, DESK, "127.0.0.1"
    channel = await client.connect()
    try:
        yield client
    finally:
        channel.close()
        await asyncio.sleep(0)


def test_a_desk_finds_the_stage_picks_dims_and_fades_and_its_loss_is_black(
    kiosk: MemoryKiosk, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(artnet, "LOST_S", 1.2)

    async def until(so: Callable[[], object]) -> None:
        async with asyncio.timeout(20):
            while not so():
                await asyncio.sleep(0.02)

    async def story(port: int) -> None:
        async with desk(port) as client:
            universe = client.set_port_config("18:3:4", is_input=True)
            await until(lambda: universe.subscribers)
            node = universe.subscribers[0]
            assert (node.portName, node.longName) == ("Head of a boy", "Velatura: Head of a boy")
            assert (node.ip, node.udpport, node.style) == ("127.0.0.1", port, 0)
            assert [(one.is_input, one.media, one.portaddr) for one in node.ports] == [(False, 0, UNIVERSE)]
            universe.set_dmx(levels(2, 128, 25))
            await until(lambda: kiosk.snapshot().playing == "warm wood")
            assert kiosk.asked[-1] == ("play", ("warm wood", 2.5))
            await until(lambda: kiosk.snapshot().brightness == 50.2)
            universe.set_dmx(levels(255, 255, 25))
            await until(lambda: kiosk.snapshot().in_turn)
        await until(lambda: kiosk.snapshot().black)

    with shown(kiosk, tmp_path, 'lost = "black"\n') as port:
        monkeypatch.setattr(aioartnet.client, "ARTNET_PORT", port)
        asyncio.run(story(port))


@pytest.mark.parametrize(("target", "more"), [("127.0.0.1", ""), ("127.255.255.255", "broadcast = true\n")])
def test_a_desk_that_does_not_ask_and_does_not_count_its_packets_is_followed(
    kiosk: MemoryKiosk, tmp_path: Path, target: str, more: str
) -> None:
    with shown(kiosk, tmp_path, more) as port:
        sender = StupidArtnet(target, UNIVERSE, 512, 30, broadcast=True, port=port)

        def sends(one: int, two: int, so: Callable[[], object], *, universe: int = UNIVERSE) -> bool:
            sender.universe = universe
            sender.make_artdmx_header()
            sender.set(levels(one, two, 0))
            return eventually(lambda: sender.show() or so(), within_s=0.5 if universe != UNIVERSE else 20)

        try:
            assert sends(2, 255, lambda: kiosk.snapshot().playing == "warm wood")
            assert sends(1, 51, lambda: kiosk.snapshot().playing == "marble" and kiosk.snapshot().brightness == 20)
            assert not sends(2, 255, lambda: kiosk.snapshot().playing != "marble", universe=5)
        finally:
            sender.close()


def test_a_poll_sent_to_all_is_answered_with_the_address_at_which_the_asker_reaches_the_stage(
    kiosk: MemoryKiosk, tmp_path: Path
) -> None:
    def answer(poll: bytes) -> bytes | None:
        """None if none comes within a little more than the longest delay."""
        asker.sendto(poll, ("127.255.255.255", port))
        asker.settimeout(artnet.LONGEST_DELAY_S + 0.3)
        with contextlib.suppress(TimeoutError):
            while (datagram := asker.recv(1024)) == poll:
                pass  # we hear what is sent to all, too
            return datagram
        return None

    with (
        shown(kiosk, tmp_path, "broadcast = true\n") as port,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asker,
    ):
        for option in (socket.SO_REUSEADDR, socket.SO_BROADCAST):
            asker.setsockopt(socket.SOL_SOCKET, option, 1)
        asker.bind((DESK, port))
        wait_for(lambda: answer(POLL))
        datagram = answer(POLL)
        assert datagram is not None
        assert answer(POLL[:12] + bytes((0x20, 0, 0, 9, 0, 0))) is None, "only universes 0 to 9 are asked"
        client = ArtNetClient(passive=True)
        ArtNetClientProtocol(client).datagram_received(datagram, ("127.0.0.1", port))
        (node,) = client.get_nodes()
        assert (node.ip, [one.portaddr for one in node.ports]) == ("127.0.0.1", [UNIVERSE])


WHOLE = (
    b"Art-Net\0" + bytes((0x00, 0x50, 0, 14, 7, 0, 0x34, 0x12, 2, 0)) + levels(1, 2, 3)
)  # as the standard's table of ArtDmx has it
POLL = b"Art-Net\0" + bytes((0x00, 0x20, 0, 14, 0x02, 0x10))


def test_only_whole_packets_of_its_universe_count() -> None:
    options = ArtNetOptions(universe=UNIVERSE, channel=10)
    found = artnet.read(WHOLE)
    assert isinstance(found, Levels)
    assert frame_of(found, "10.0.0.7", options) == Frame("10.0.0.7", 0, 7, False, (1, 2, 3))
    assert frame_of(found, "10.0.0.7", ArtNetOptions(universe=UNIVERSE + 1)) is None
    short = WHOLE[:16] + bytes((0, 11)) + WHOLE[18:29]
    cut = artnet.read(short)
    assert isinstance(cut, Levels)
    assert frame_of(cut, "10.0.0.7", options) is None, "the third channel is missing: it is not 0"
    for damaged in (WHOLE[:-1], WHOLE[:17], b"art-net" + WHOLE[7:], WHOLE[:10] + b"\0\x0d" + WHOLE[12:]):
        assert artnet.read(damaged) is None
    assert artnet.read(WHOLE[:8] + b"\x00\x52" + WHOLE[10:]) is None, "ArtSync"
    assert artnet.read(WHOLE[:15] + bytes((0x12 | 0x80,)) + WHOLE[16:]) is None, "the net has seven bits"


def test_a_poll_may_ask_for_some_universes() -> None:
    assert artnet.read(POLL) == Poll(0, 0x7FFF)
    targeted = POLL[:12] + bytes((0x22, 0x10, 0x12, 0x40, 0x12, 0x30))
    assert artnet.read(targeted) == Poll(0x1230, 0x1240)


def test_the_first_controller_counts_until_it_is_lost() -> None:
    sources = Sources(lost_s=artnet.LOST_S)
    sources.take(Frame("10.0.0.7", 0, None, False, (1, 1, 1)), 0.0)
    sources.take(Frame("10.0.0.8", 0, None, False, (2, 2, 2)), 4.0)
    sources.take(Frame("10.0.0.7", 0, None, False, (3, 1, 1)), 4.1)
    assert sources.levels(13.0) == (3, 1, 1), "a desk that repeats its levels every 4 s is not lost"
    sources.take(Frame("10.0.0.8", 0, None, False, (2, 2, 2)), 13.0)
    assert sources.levels(14.2) == (2, 2, 2)
    assert sources.levels(24.0) is None


@settings(max_examples=300, deadline=None)
@given(st.binary(max_size=600) | st.tuples(st.integers(0, len(WHOLE)), st.binary(max_size=8)).map(
    lambda cut: WHOLE[: cut[0]] + cut[1] + WHOLE[cut[0] + len(cut[1]) :]
) | st.integers(0, len(WHOLE)).map(lambda end: WHOLE[:end]))  # fmt: skip
def test_no_datagram_raises(datagram: bytes) -> None:
    found = artnet.read(datagram)
    if isinstance(found, Levels):
        assert 1 <= len(found.values) <= 512
        frame_of(found, "10.0.0.7", ArtNetOptions(channel=510))
    elif found is not None:
        assert 0 <= found.lowest <= 0xFFFF


def test_of_sixty_that_ask_at_once_twenty_are_answered_and_the_others_when_they_ask_again(
    kiosk: MemoryKiosk, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("random.uniform", lambda _, longest: longest)
    with shown(kiosk, tmp_path) as port, contextlib.ExitStack() as asking:
        askers = [asking.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) for _ in range(60)]
        for number, asker in enumerate(askers):
            asker.bind((f"127.0.1.{number + 1}", port))
            asker.settimeout(0)

        def answered(asked: list[socket.socket]) -> list[socket.socket]:
            """In a little more than the longest delay."""
            for asker in asked:
                asker.sendto(POLL, ("127.0.0.1", port))
            time.sleep(artnet.LONGEST_DELAY_S + 0.5)
            return [asker for asker in asked if _has_one(asker)]

        wait_for(lambda: answered(askers[:1]))
        first = answered(askers)
        assert len(first) == artnet.MOST_POLLS_WAITING
        others = [asker for asker in askers if asker not in first]
        assert len(answered(others[:10])) == 10


def _has_one(asker: socket.socket) -> bool:
    with contextlib.suppress(BlockingIOError):
        return bool(asker.recv(1024))
    return False
