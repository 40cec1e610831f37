"""sACN, from a sender by other authors; what counts of several sources; bad packets."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st
from sacn import DataPacket, sACNsender

from controller.kiosk.building.dmx import Follower, Frame, Sources
from controller.kiosk.building.protocol import read, serving
from controller.kiosk.building.sacn import SacnOptions, frame_of
from controller.kiosk.state import KioskState
from tests.controller.panel.memory_kiosk import MemoryKiosk
from tests.ports import kept_port
from tests.waiting import wait_for

NAMES = ("marble", "warm wood")
OPEN = KioskState(1, "hall", "playing", "", 0.0, playing="marble")
CID = tuple(range(16))


@contextlib.contextmanager
def desk(port: int) -> Iterator[Any]:
    """A sending desk; its library has one port for all, the standard's."""
    sender = sACNsender(bind_address="127.0.0.1", bind_port=0, fps=30, universeDiscovery=False)
    sender.start()
    sender.activate_output(7)
    sender[7].destination = "127.0.0.1"
    try:
        yield sender
    finally:
        sender.stop()


def test_a_desk_picks_dims_and_fades_and_its_loss_is_black(kiosk: MemoryKiosk, tmp_path: Path) -> None:
    with kept_port() as port:
        text = f'[sacn]\nport = {port}\nuniverse = 7\nchannel = 10\nlost = "black"\n'
        (tmp_path / "building.toml").write_text(text)
        with serving(kiosk, read(tmp_path)), to_port(port), desk(port) as sender:
            sender[7].dmx_data = (0,) * 9 + (0, 255, 0)
            sender[7].dmx_data = (0,) * 9 + (2, 128, 25)
            wait_for(lambda: kiosk.snapshot().playing == "warm wood")
            assert kiosk.asked[-1] == ("play", ("warm wood", 2.5))
            wait_for(lambda: kiosk.snapshot().brightness == 50.2)
            sender[7].dmx_data = (0,) * 9 + (255, 255, 25)
            wait_for(lambda: kiosk.snapshot().in_turn)
            wait_for(lambda: kiosk.snapshot().brightness == 100)
            sender.deactivate_output(7)
            wait_for(lambda: kiosk.snapshot().black)
            sender.activate_output(7)
            sender[7].destination = "127.0.0.1"
            sender[7].dmx_data = (0,) * 9 + (255, 255, 25)
            wait_for(lambda: not kiosk.snapshot().black)
    assert logging.getLogger("sacn").handlers


@contextlib.contextmanager
def to_port(port: int) -> Iterator[None]:
    """The library sends to the standard's port alone; here the tests may run beside each other."""
    from sacn.sending import sender_socket_udp

    before = sender_socket_udp.DEFAULT_PORT
    sender_socket_udp.DEFAULT_PORT = port
    try:
        yield
    finally:
        sender_socket_udp.DEFAULT_PORT = before


def frame(*levels: int, source: object = "a", priority: int = 100, sequence: int = 0, ended: bool = False) -> Frame:
    one, two, three = levels
    return Frame(source, priority, sequence, ended, (one, two, three))


def test_the_highest_priority_counts_until_it_is_lost() -> None:
    sources = Sources()
    assert sources.levels(0.0) is None
    sources.take(frame(1, 1, 1), 0.0)
    sources.take(frame(2, 2, 2, source="b"), 0.1)
    assert sources.levels(0.2) == (1, 1, 1), "the first of two equals"
    sources.take(frame(3, 3, 3, source="c", priority=150), 0.3)
    assert sources.levels(0.4) == (3, 3, 3)
    sources.take(frame(2, 2, 9, source="b", sequence=1), 2.7)
    assert sources.levels(2.75) == (3, 3, 3)
    assert sources.levels(2.9) == (2, 2, 9), "both others have been silent for more than 2.5 s"
    sources.take(frame(0, 0, 0, source="b", sequence=2, ended=True), 3.0)
    assert sources.levels(3.0) is None


def test_a_packet_that_was_overtaken_does_not_count() -> None:
    sources = Sources()
    for sequence, level, seen in ((254, 1, 1), (2, 2, 2), (255, 3, 2), (2, 4, 2), (3, 5, 5), (230, 6, 6)):
        sources.take(frame(level, 0, 0, sequence=sequence), 0.0)
        assert sources.levels(0.0) == (seen, 0, 0), sequence


def test_a_fader_on_its_way_shows_nothing_and_a_closed_stage_stays_closed() -> None:
    follower = Follower(dark_when_lost=False)
    closed = replace(OPEN, state="off")
    assert follower.verbs((2, 255, 0), closed, NAMES, 0.0) == []
    assert follower.verbs((1, 255, 0), OPEN, NAMES, 1.0) == []
    assert follower.verbs((2, 255, 0), OPEN, NAMES, 1.1) == []
    assert follower.verbs((2, 255, 7), OPEN, NAMES, 1.3) == [("play", {"name": "warm wood", "fade_s": 0.7})]
    assert follower.verbs((2, 255, 0), OPEN, NAMES, 2.0) == []
    assert follower.verbs((9, 255, 0), OPEN, NAMES, 3.0) == []
    assert follower.verbs((9, 255, 0), OPEN, NAMES, 4.0) == [], "there is no ninth"
    assert follower.verbs((9, 0, 0), OPEN, NAMES, 5.0) == [("brightness", {"percent": 0.0})]
    assert follower.verbs((9, 51, 0), OPEN, NAMES, 5.1) == [], "not more often than the player can"
    assert follower.verbs((9, 51, 0), OPEN, NAMES, 5.3) == [("brightness", {"percent": 20.0})]
    assert follower.verbs(None, OPEN, NAMES, 9.0) == [], "all stays as it is"


def test_black_of_somebody_else_is_not_ended_when_the_signal_comes_back() -> None:
    follower = Follower(dark_when_lost=True)
    assert follower.verbs(None, OPEN, NAMES, 0.0) == [], "there was no desk yet"
    follower.verbs((0, 255, 0), OPEN, NAMES, 1.0)
    assert follower.verbs(None, replace(OPEN, black=True), NAMES, 5.0) == []
    assert follower.verbs((0, 255, 0), replace(OPEN, black=True), NAMES, 6.0) == []
    assert follower.verbs(None, OPEN, NAMES, 10.0) == [("black", {"on": True})]
    assert follower.verbs((0, 255, 0), replace(OPEN, black=True), NAMES, 11.0) == [("black", {"on": False})]


WHOLE = bytes(DataPacket(CID, "desk", 1, (1, 2, 3), sequence=4).getBytes())


def test_only_levels_of_its_universe_count() -> None:
    options = SacnOptions()
    assert frame_of(WHOLE, options) == Frame(bytes(CID), 100, 4, False, (1, 2, 3))
    for more in ({"previewData": True}, {"dmxStartCode": 0xDD}, {"universe": 2}):
        values = {"cid": CID, "sourceName": "desk", "universe": 1, "dmxData": (1, 2, 3)} | more
        assert frame_of(bytes(DataPacket(**values).getBytes()), options) is None


@settings(max_examples=300, deadline=None)
@given(st.binary(max_size=700) | st.tuples(st.integers(0, len(WHOLE)), st.binary(max_size=8)).map(
    lambda cut: WHOLE[: cut[0]] + cut[1] + WHOLE[cut[0] + len(cut[1]) :]
) | st.integers(0, len(WHOLE)).map(lambda end: WHOLE[:end]))  # fmt: skip
def test_no_datagram_raises(datagram: bytes) -> None:
    found = frame_of(datagram, SacnOptions(channel=510))
    assert found is None or all(0 <= level <= 255 for level in found.levels)
