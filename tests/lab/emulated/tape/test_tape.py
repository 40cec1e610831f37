"""The file of a tape: written and read back, without secrets, and whatever bytes it holds."""

from __future__ import annotations

import base64
import contextlib
import zlib
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

import lab.emulated.tape as tape_module
from hal.errors import ProtocolError
from hal.registry import OpenContext
from hal.tape import HEADER, Direction, Tape
from lab.emulated.tape import parse_tape, read_tape

PIECES = st.lists(st.tuples(st.integers(0, 2), st.booleans(), st.binary(min_size=1, max_size=600)), max_size=20)


@given(pieces=PIECES)
def test_every_piece_comes_back_in_order_on_its_track(
    pieces: list[tuple[int, bool, bytes]], tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.mktemp("tape") / "a.tape"
    tape = Tape(path)
    tracks = [tape.track("serial", f"port \\ {number}") for number in range(3)]
    for number, sent, data in pieces:
        (tracks[number].sent if sent else tracks[number].received)(data)
    tape.close()
    found = read_tape(path)
    assert [(track.kind, track.address) for track in found] == [("serial", f"port \\ {number}") for number in range(3)]
    for number, track in enumerate(found):
        wanted = [(Direction.SENT if sent else Direction.RECEIVED, data) for at, sent, data in pieces if at == number]
        assert [(entry.way, entry.data) for entry in track.entries] == wanted
        assert all(early.at_s <= late.at_s for early, late in zip(track.entries, track.entries[1:], strict=False))


@given(text=st.text(max_size=300))
def test_no_text_ends_in_an_untyped_error(text: str) -> None:
    for tape in (text, f"{HEADER}\n{text}\n", f"{HEADER}\n0.1 + 1 serial x\n0.2 {{ 1 {text}\n"):
        with contextlib.suppress(ProtocolError):
            parse_tape(tape)


@pytest.mark.parametrize(
    "line",
    [
        "0.1 > 1 no track yet",
        "0.1 + 2 serial second-first",
        "0.1 + 1 serial a\n0.2 > 1 \\q",
        "0.1 + 1 serial a\n0.2 - 1 ended",
        "x",
        "0.1 + 1 s a\n0.2 { 1 !!",
    ],
)
def test_a_wrong_line_is_named(line: str) -> None:
    with pytest.raises(ProtocolError, match=f"line {1 + len(line.splitlines())}"):
        parse_tape(f"{HEADER}\n{line}\n")


def test_a_piece_that_unpacks_to_too_much_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tape_module, "LARGEST_PIECE", 1 << 20)
    bomb = zlib.compress(bytes(2 << 20))
    with pytest.raises(ProtocolError, match="line 3"):
        parse_tape(f"{HEADER}\n0.1 + 1 ptp a\n0.2 {{ 1 {base64.b64encode(bomb).decode()}\n")


def test_pieces_that_unpack_to_too_much_together_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tape_module, "MOST_UNPACKED", 5000)
    packed = base64.b64encode(zlib.compress(bytes(2000))).decode()
    text = f"{HEADER}\n0.000000 + 1 tcp a\n" + f"0.000000 {{ 1 {packed}\n" * 2
    assert len(parse_tape(text)[0].entries) == 2
    with pytest.raises(ProtocolError, match="more than a tape holds"):
        parse_tape(text + f"0.000000 {{ 1 {packed}\n")


def test_half_a_line_at_the_end_is_left_out() -> None:
    tracks = parse_tape(f"{HEADER}\n0.100000 + 1 serial a\n0.200000 > 1 on\\r\n0.300000 < 1 O")
    assert [entry.data for entry in tracks[0].entries] == [b"on\r"]


def test_passwords_and_digests_are_not_on_the_tape(tmp_path: Path) -> None:
    tape = Tape(tmp_path / "a.tape")
    context = OpenContext(tmp_path, tape=tape)
    lines = context.transcript("tcp", "a", secret="hunter2")
    pjlink = context.transcript("pjlink", "b", secret="hunter2")
    assert lines is not None
    assert pjlink is not None
    lines.sent(b"login admin hunter2\r")
    pjlink.received(b"PJLINK 1 498e4a67\r")
    pjlink.sent(b"5d8409bc1c3fa39749434aa3a5c38682%1POWR ?\r")
    tape.close()
    text = (tmp_path / "a.tape").read_text()
    for secret in ("hunter2", "498e4a67", "5d8409bc"):
        assert secret not in text
    first, second = read_tape(tmp_path / "a.tape")
    assert [entry.data for entry in first.entries] == [b"login admin *******\r"]
    assert [entry.data for entry in second.entries] == [b"PJLINK 0\r", b"%1POWR ?\r"]
