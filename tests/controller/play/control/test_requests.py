"""Requests that are wrong, refused, endless or too many."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from controller.play.control.launch import PlayerProcess
from tests.controller.play.wire import Frames, Wire, dark, noise, same

Outputs = list[tuple[str, int, int]]
Start = Callable[..., PlayerProcess]


MALFORMED = [
    b"\xff\xfe",
    b"{",
    b"[]",
    b"null",
    b"5",
    b"{}",
    b'{"op": 7}',
    b'{"op": ["play"]}',
    b'{"op": "dance"}',
    b'{"op": "show"}',
    b'{"op": "show", "sequence": -2}',
    b'{"op": "show", "sequence": 1e999}',
    b'{"op": "show", "sequence": true}',
    b'{"op": "show", "sequence": 2, "more": 1}',
    b'{"op": "play", "appearance": 5}',
    b'{"op": "play", "appearance": "\\u0000"}',
    b'{"op": "sequence", "items": []}',
    b'{"op": "sequence", "items": [["1"]]}',
    b'{"op": "sequence", "items": [["1", 0]]}',
    b'{"op": "sequence", "items": [["1", NaN]]}',
    b'{"op": "sequence", "items": [["1", 1]], "rate_hz": 0}',
    b'{"op": "sequence", "items": [["1", 1]], "repeat": -1}',
    b'{"op": "load-bundle"}',
    b'{"op": "hello", "self": 1}',
    b'{"id": {}, "op": "hello"}',
    b"[" * 100_000,
    b'{"op": "show", "sequence": ' + b"9" * 9000 + b"}",
]


def test_malformed_requests_are_answered_and_hurt_nobody(wire: Wire) -> None:
    for line in MALFORMED:
        wire.send(line + b"\n")
        answer = wire.receive()
        assert answer["ok"] is False
        assert answer["error"]["code"] == "request-wrong"
        assert answer["error"]["what"].endswith(".")
        assert answer["error"]["remedy"].endswith(".")
    assert wire.ask("hello")["ok"]


@pytest.mark.parametrize(
    ("operation", "values", "code"),
    [
        ("show", {"sequence": 2**40}, "inbox-sequence"),
        ("play", {"appearance": "none of them"}, "bundle-no-appearance"),
        ("sequence", {"items": [["1", 1], ["9", 1]]}, "bundle-no-appearance"),
        ("load-bundle", {"path": "/nowhere/b.vel"}, "bundle-unreadable"),
        ("load-bundle", {"path": "/dev/null"}, "bundle-unreadable"),
        ("load-bundle", {"path": "/proc/self/environ"}, "bundle-damaged"),
    ],
)
def test_what_can_not_be_done_is_refused_and_the_picture_stays(
    wire: Wire, outputs: Outputs, folder: Path, operation: str, values: dict[str, object], code: str
) -> None:
    wire.ask("play", appearance="1")
    assert wire.ask(operation, **values)["error"]["code"] == code
    assert same(Frames(folder / "out.frame").read(), noise(outputs, 1))


def test_frames_that_are_still_being_written_are_not_shown(wire: Wire, outputs: Outputs, folder: Path) -> None:
    inbox = Frames(Path(wire.ask("hello")["inbox"]))
    sequence = inbox.write(noise(outputs, 50))
    inbox._words[2] += 1
    assert wire.ask("show", sequence=sequence)["error"]["code"] == "frames-changing"
    inbox.write(noise(outputs, 50))
    assert dark(Frames(folder / "out.frame").read())


def test_an_endless_line_ends_its_connection_and_no_other(wire: Wire, folder: Path) -> None:
    with Wire(folder / "player.sock") as talker:
        talker.send(b"x" * 300_000)
        assert talker.receive()["error"]["code"] == "request-wrong"
        assert talker.ended()
        talker.send(b"x" * 300_000)
    assert wire.ask("hello")["ok"]
