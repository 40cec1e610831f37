"""A frame of EOS live view: the JPEG is found among the other records, and nothing else is taken for it."""

from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hal.codecs.ptp.eos import parse_view
from hal.errors import ProtocolError

JPEG = b"\xff\xd8 a picture \xff\xd9"


def record(kind: int, body: bytes) -> bytes:
    return struct.pack("<II", 8 + len(body), kind) + body


@pytest.mark.parametrize("kind", [1, 9, 11])
def test_the_picture_is_found_behind_other_records(kind: int) -> None:
    assert parse_view(record(3, bytes(20)) + record(kind, JPEG) + record(33, bytes(4))) == JPEG


@pytest.mark.parametrize(
    "data", [b"", record(3, bytes(20)), record(1, b"no picture"), record(1, JPEG)[:-1], struct.pack("<II", 0, 1) + JPEG]
)
def test_a_frame_without_a_whole_picture_is_refused(data: bytes) -> None:
    with pytest.raises(ProtocolError):
        parse_view(data)


@given(st.binary(max_size=200))
def test_any_bytes_end_in_a_picture_or_a_refusal(data: bytes) -> None:
    try:
        found = parse_view(data)
    except ProtocolError:
        return
    assert found.startswith(b"\xff\xd8")
    assert found in data
