"""Reads tapes."""

from __future__ import annotations

import base64
import binascii
import re
import zlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from hal.errors import ProtocolError
from hal.escapes import unescaped
from hal.runtime.files import require_regular
from hal.tape.recorder import HEADER, MOST_BYTES, PACKED
from hal.transcript import Direction, Entry

LARGEST_PIECE: Final = 256 << 20
MOST_TRACKS: Final = 10_000
_LINE: Final = re.compile(r"(?P<at>\d{1,12}\.\d{1,9}) (?P<mark>[+<>|{}]) (?P<track>\d{1,6}) (?P<text>[ -~]*)", re.ASCII)
_WAYS: Final = {**{way.value: way for way in Direction}, **{mark: way for way, mark in PACKED.items()}}


@dataclass(frozen=True, slots=True)
class Track:
    """The bytes of one connection, or of one device; ``entries`` in order, their times since the tape began."""

    kind: str
    address: str
    entries: list[Entry] = field(default_factory=list)


def read_tape(path: Path) -> tuple[Track, ...]:
    """The tracks of a tape. Raises ProtocolError("tape-wrong")."""
    try:
        require_regular(path)
        size = path.stat().st_size
        text = path.read_text("ascii") if size <= 2 * MOST_BYTES else ""
    except (OSError, UnicodeDecodeError) as error:
        raise _wrong(f"it can't be read ({getattr(error, 'strerror', None) or 'not ASCII'})") from error
    return parse_tape(text)


def parse_tape(text: str) -> tuple[Track, ...]:
    """The tracks of a tape's text. Raises ProtocolError("tape-wrong") naming the line."""
    lines = text.split("\n")
    if lines[0] != HEADER:
        raise _wrong(f"its first line is not {HEADER!r}")
    tracks: list[Track] = []
    for number, line in enumerate(lines[1:], start=2):
        # A program that was killed may leave half a line at the end.
        if not line or (number == len(lines) and not text.endswith("\n")):
            continue
        match = _LINE.fullmatch(line)
        if match is None:
            raise _wrong(f"line {number} is not one of a tape")
        try:
            _take(tracks, match["mark"], int(match["track"]), float(match["at"]), match["text"])
        except (ProtocolError, ValueError, binascii.Error, zlib.error) as error:
            raise _wrong(f"line {number} can't be read") from error
    return tuple(tracks)


def _take(tracks: list[Track], mark: str, number: int, at_s: float, text: str) -> None:
    if mark == "+":
        kind, _, address = text.partition(" ")
        if number != len(tracks) + 1 or len(tracks) >= MOST_TRACKS:
            raise ValueError(number)
        tracks.append(Track(kind, unescaped(address).decode(errors="replace")))
        return
    if not 1 <= number <= len(tracks):
        raise ValueError(number)
    data = _unpacked(text) if mark in PACKED.values() else unescaped(text)
    tracks[number - 1].entries.append(Entry(at_s, _WAYS[mark], data))


def _unpacked(text: str) -> bytes:
    unpacking = zlib.decompressobj()
    data = unpacking.decompress(base64.b64decode(text, validate=True), LARGEST_PIECE)
    if not unpacking.eof:
        raise ValueError("a piece that is too long, or cut")
    return data


def _wrong(why: str) -> ProtocolError:
    return ProtocolError(
        "tape-wrong",
        what=f"This is not a tape: {why}.",
        remedy="Record it again with `velatura record`. Its format is described in docs/reference/tape-format.md.",
    )
