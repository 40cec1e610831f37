"""The bytes of the player's frame files and answers, as docs/reference/player-protocol.md has them."""

from __future__ import annotations

import contextlib
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hal.codecs.player import FrameLayout, accepted, parse_answer, parse_layout, parse_set
from hal.errors import DeviceRefused, ProtocolError

HEAD = (
    struct.pack("<8sIIQdQ24x", b"VELFRAME", 1, 2, 0, 0.0, 12288 + 27)
    + struct.pack("<40sIIQQ", b"P1", 40, 50, 4096, 0)
    + struct.pack("<40sIIQQ", b"P2", 3, 3, 12288, 0)
)


def test_the_head_is_the_documented_one_and_is_read_back() -> None:
    layout = FrameLayout.of([("P1", 40, 50), ("P2", 3, 3)])
    assert layout.head() == HEAD
    assert parse_layout(HEAD) == layout
    assert layout.slots[0].shape == (50, 40, 3)


def test_the_sequence_and_the_time_of_a_set_stand_at_their_bytes() -> None:
    head = bytearray(HEAD)
    struct.pack_into("<Qd", head, 16, 6, 12.5)
    assert parse_set(bytes(head)) == (6, 12.5)


@pytest.mark.parametrize(
    ("place", "value"),
    [(0, b"X"), (8, b"\2"), (12, b"\0"), (12, b"\xff"), (64 + 40, b"\0\0\0\0"), (64 + 48, b"\xff" * 8)],
)
def test_a_head_that_breaks_the_layout_is_refused(place: int, value: bytes) -> None:
    with pytest.raises(ProtocolError):
        parse_layout(HEAD[:place] + value + HEAD[place + len(value) :])


@given(st.binary(max_size=200), st.integers(0, len(HEAD)))
def test_any_bytes_are_a_layout_or_a_typed_error(data: bytes, kept: int) -> None:
    with contextlib.suppress(ProtocolError):
        parse_layout(HEAD[:kept] + data)


@given(st.binary(max_size=100))
def test_any_line_is_an_answer_or_a_typed_error(line: bytes) -> None:
    with contextlib.suppress(ProtocolError, DeviceRefused):
        accepted(parse_answer(line))


def test_a_refusal_has_the_players_own_sentences() -> None:
    with pytest.raises(DeviceRefused) as refused:
        accepted({"id": 1, "ok": False, "error": {"code": "c", "what": "W.", "remedy": "R."}})
    assert (refused.value.code, refused.value.what, refused.value.remedy) == ("c", "W.", "R.")
