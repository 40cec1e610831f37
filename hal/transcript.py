r"""Transcripts: all bytes sent and received, with times, as a text file to read, compare and replay.

The file is ASCII. Its first line is ``velatura transcript 1``; then one line an event:

    0.012345 > ~00124 1\r
    0.051200 < OK1\r
    7.250000 | reconnected

that is: seconds since the transcript began, a space, the direction (``>`` sent to the device, ``<`` received from it,
``|`` a remark), a space, the bytes in the notation of ``hal.escapes``. How bytes are grouped into lines has no meaning.
"""

from __future__ import annotations

import contextlib
import re
import threading
import time
from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Final

from hal.deadline import Deadline
from hal.errors import DeviceTimeout, ProtocolError
from hal.escapes import escaped, unescaped

HEADER: Final = "velatura transcript 1"
_LINE: Final = re.compile(r"(?P<at>\d{1,12}\.\d{1,9}) (?P<way>[<>|]) (?P<data>[ -~]*)", re.ASCII)


class Direction(Enum):
    """The direction of an entry."""

    SENT = ">"
    RECEIVED = "<"
    REMARK = "|"


@dataclass(frozen=True, slots=True)
class Entry:
    """One line of a transcript; ``at_s`` in seconds since it began."""

    at_s: float
    way: Direction
    data: bytes


class Transcript:
    """Records the bytes of a link; with ``path`` each line is written at once and survives a crash.

    The entries kept in memory are bounded by ``keep``; the file is not.
    """

    def __init__(self, path: Path | None = None, *, keep: int = 10_000) -> None:
        self._began = time.monotonic()
        self._entries: list[Entry] = []
        self._keep = keep
        self._lock = threading.Lock()
        self._file = None if path is None else path.open("w", encoding="ascii", buffering=1)
        if self._file is not None:
            self._file.write(HEADER + "\n")

    @property
    def entries(self) -> tuple[Entry, ...]:
        with self._lock:
            return tuple(self._entries)

    def sent(self, data: bytes) -> None:
        self._add(Direction.SENT, data)

    def received(self, data: bytes) -> None:
        self._add(Direction.RECEIVED, data)

    def remark(self, text: str) -> None:
        self._add(Direction.REMARK, text.encode("ascii", "backslashreplace"))

    def close(self) -> None:
        with self._lock:
            if self._file is not None:
                with contextlib.suppress(OSError):
                    self._file.close()
                self._file = None

    def _add(self, way: Direction, data: bytes) -> None:
        entry = Entry(time.monotonic() - self._began, way, data)
        with self._lock:
            self._entries.append(entry)
            del self._entries[: -self._keep]
            if self._file is not None:
                # A full disk must not stop a show: the transcript ends, the device continues.
                try:
                    self._file.write(line_of(entry) + "\n")
                except OSError:
                    self._file = None


def line_of(entry: Entry) -> str:
    """One entry as a line of the file, without the newline."""
    return f"{entry.at_s:.6f} {entry.way.value} {escaped(entry.data)}"


def parse_transcript(text: str) -> tuple[Entry, ...]:
    """Read a transcript back. Raises ProtocolError naming the line that is not one of a transcript."""
    lines = text.split("\n")
    if lines[0] != HEADER:
        raise _not_a_transcript(f"its first line is not {HEADER!r}")
    entries = []
    for number, line in enumerate(lines[1:], start=2):
        if not line:
            continue
        match = _LINE.fullmatch(line)
        if match is None:
            raise _not_a_transcript(f"line {number} is not one")
        entries.append(Entry(float(match["at"]), Direction(match["way"]), unescaped(match["data"])))
    return tuple(entries)


def _not_a_transcript(why: str) -> ProtocolError:
    return ProtocolError(
        "transcript-wrong",
        what=f"This is not a transcript: {why}.",
        remedy="Record it again. Its format is described in hal/transcript.py.",
    )


class ReplayLink:
    """A link that plays the device's part of a transcript, and checks the caller's part.

    The bytes received before the next sent bytes can be read; sent bytes must equal the record, or
    ProtocolError("replay-departed") is raised with ``theirs=False``. Reading more than the record has raises
    DeviceTimeout at once.
    """

    def __init__(self, entries: Iterable[Entry]) -> None:
        self._script = [
            (entry.way, entry.data) for entry in entries if entry.way is not Direction.REMARK and entry.data
        ]
        self._buffer = bytearray()
        self._advance()

    @property
    def finished(self) -> bool:
        """Whether everything recorded was sent and read."""
        return not self._script and not self._buffer

    def read_until(self, terminator: bytes, *, limit: int, deadline: Deadline) -> bytes:
        end = self._buffer.find(terminator, 0, limit)
        if end < 0:
            raise self._nothing_more()
        return self._take(end + len(terminator))

    def read_exactly(self, count: int, *, deadline: Deadline) -> bytes:
        if len(self._buffer) < count:
            raise self._nothing_more()
        return self._take(count)

    def write(self, data: bytes, *, deadline: Deadline) -> None:
        while data:
            expected = self._script[0][1] if self._script else b""
            common = min(len(expected), len(data))
            if not common or expected[:common] != data[:common]:
                raise ProtocolError(
                    "replay-departed",
                    what=f"The driver sent {escaped(data)!r} instead of the recorded {escaped(expected)!r}.",
                    remedy="Compare the driver with the transcript, or record a new one.",
                    theirs=False,
                )
            self._script[0] = (Direction.SENT, expected[common:])
            data = data[common:]
            self._advance()

    def drain(self) -> bytes:
        return self._take(len(self._buffer))

    def close(self) -> None:
        """Nothing to close."""

    def _advance(self) -> None:
        while self._script and (self._script[0][0] is Direction.RECEIVED or not self._script[0][1]):
            way, data = self._script.pop(0)
            if way is Direction.RECEIVED:
                self._buffer += data

    def _take(self, count: int) -> bytes:
        taken = bytes(self._buffer[:count])
        del self._buffer[:count]
        return taken

    def _nothing_more(self) -> DeviceTimeout:
        return DeviceTimeout(
            "link-no-answer",
            what="The record has no further answer here.",
            remedy="Compare the driver with the transcript, or record a new one.",
        )
