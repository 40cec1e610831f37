"""Transcripts can be written, read back and replayed."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hal.deadline import in_seconds
from hal.errors import DeviceTimeout, ProtocolError
from hal.escapes import escaped, unescaped
from hal.transcript import HEADER, Direction, Entry, ReplayLink, Transcript, line_of, parse_transcript


@given(st.binary(max_size=200))
def test_any_bytes_survive_the_notation(data: bytes) -> None:
    text = escaped(data)
    assert text.isascii()
    assert text.isprintable()
    assert unescaped(text) == data


@given(st.text(max_size=100))
def test_no_text_is_read_as_bytes_by_mistake(text: str) -> None:
    try:
        data = unescaped(text)
    except ProtocolError:
        return
    assert unescaped(escaped(data)) == data


@given(
    st.lists(
        st.builds(
            Entry, st.integers(0, 10**6).map(lambda n: n / 64), st.sampled_from(Direction), st.binary(max_size=30)
        ),
        max_size=10,
    )
)
def test_a_transcript_reads_back_as_it_was(entries: list[Entry]) -> None:
    text = "\n".join([HEADER, *map(line_of, entries), ""])
    assert parse_transcript(text) == tuple(entries)


@given(st.text(max_size=200))
def test_what_is_no_transcript_is_a_protocol_error(text: str) -> None:
    try:
        entries = parse_transcript(HEADER + "\n" + text)
    except ProtocolError:
        return
    assert len(entries) <= len(text.split("\n"))


def test_the_wrong_line_is_named() -> None:
    with pytest.raises(ProtocolError, match="line 3"):
        parse_transcript(f"{HEADER}\n0.1 > a\n0.2 ? b\n")


def test_a_file_holds_every_byte_at_once(tmp_path: Path) -> None:
    transcript = Transcript(tmp_path / "t.txt", keep=1)
    transcript.sent(b"~00124 1\r")
    transcript.received(b"OK\xff\\")
    transcript.remark("unplugged")
    on_disk = parse_transcript((tmp_path / "t.txt").read_text())
    assert [(entry.way, entry.data) for entry in on_disk] == [
        (Direction.SENT, b"~00124 1\r"),
        (Direction.RECEIVED, b"OK\xff\\"),
        (Direction.REMARK, b"unplugged"),
    ]
    assert len(transcript.entries) == 1, "memory is bounded, the file is not"
    transcript.close()
    transcript.sent(b"after the end is harmless")


RECORD = [
    Entry(0.0, Direction.SENT, b"ab"),
    Entry(0.0, Direction.SENT, b"c\r"),
    Entry(0.1, Direction.RECEIVED, b"one\rtw"),
    Entry(0.2, Direction.RECEIVED, b"o\r"),
    Entry(0.3, Direction.SENT, b"d\r"),
    Entry(0.4, Direction.RECEIVED, b"!"),
]


def test_a_replay_answers_as_recorded() -> None:
    link = ReplayLink(RECORD)
    soon = in_seconds(20)
    link.write(b"abc\r", deadline=soon)
    assert link.read_until(b"\r", limit=10, deadline=soon) == b"one\r"
    assert link.read_until(b"\r", limit=10, deadline=soon) == b"two\r"
    assert not link.finished
    link.write(b"d\r", deadline=soon)
    assert link.drain() == b"!"
    assert link.finished


def test_a_replay_holds_the_caller_to_the_record() -> None:
    link = ReplayLink(RECORD)
    with pytest.raises(ProtocolError) as caught:
        link.write(b"abX", deadline=in_seconds(20))
    assert caught.value.code == "replay-departed"
    assert caught.value.theirs is False
    with pytest.raises(ProtocolError, match="'more'"):
        ReplayLink([]).write(b"more", deadline=in_seconds(20))


def test_a_replay_has_no_more_answers_than_the_record() -> None:
    link = ReplayLink(RECORD)
    with pytest.raises(DeviceTimeout):
        link.read_exactly(1, deadline=in_seconds(20))
    link.write(b"abc\r", deadline=in_seconds(20))
    with pytest.raises(DeviceTimeout):
        link.read_exactly(9, deadline=in_seconds(20))
    assert link.read_exactly(8, deadline=in_seconds(20)) == b"one\rtwo\r"
