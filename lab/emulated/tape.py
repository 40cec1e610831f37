"""Devices that are replayed from a tape: lines on a pseudo terminal or a TCP port, and cameras on PTP/IP.

A recorded conversation is a row of questions and answers, for programs that ask in their own order. The next recorded
answer to a question is given unless a command that changes the device comes before it in the record; until that command
is given, the previous answer is repeated. So a program that polls more often, or leaves questions out, still sees the
same device. Start at ``serve_tape``.
"""

from __future__ import annotations

import base64
import binascii
import contextlib
import os
import re
import select
import socket
import struct
import threading
import time
import tty
import zlib
from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, Generic, TypeVar

from hal.errors import ProtocolError
from hal.runtime.files import require_regular
from hal.serial_link import PtyLink
from hal.tape import HEADER, MOST_BYTES, PACKED, Direction
from lab.emulated.servers import BackgroundDevice, TcpServer
from plugins.emulated.cameras.body import CameraNames, EmulatedBody
from plugins.emulated.cameras.camera import PtpIpCamera
from plugins.emulated.cameras.wire import NOT_SUPPORTED, Gone, PtpOutcome
from plugins.emulated.core.shot import ShotFiles, ShotSettings

LARGEST_PIECE: Final = 256 << 20
MOST_UNPACKED: Final = 2 << 30
"""Bytes of a whole tape, which may be packed into a thousand times fewer."""
MOST_TRACKS: Final = 10_000
_LINE: Final = re.compile(r"(?P<at>\d{1,12}\.\d{1,9}) (?P<mark>[+<>|{}]) (?P<track>\d{1,6}) (?P<text>[ -~]*)", re.ASCII)
_WAYS: Final = {**{way.value: way for way in Direction}, **{mark: way for way, mark in PACKED.items()}}


@dataclass(frozen=True, slots=True)
class Entry:
    """A piece of a track; ``at_s`` in seconds since the tape began. How bytes are grouped has no meaning."""

    at_s: float
    way: Direction
    data: bytes


@dataclass(frozen=True, slots=True)
class Track:
    """The bytes of one connection, or of one device; ``entries`` in order, their times since the tape began."""

    kind: str
    address: str
    entries: list[Entry] = field(default_factory=list)


_ESCAPE: Final = re.compile(rb"\\(?:x([0-9a-f]{2})|([rnt\\]))")
_LONG: Final = {b"r": b"\r", b"n": b"\n", b"t": b"\t", b"\\": b"\\"}


def unescaped(text: str) -> bytes:
    """The bytes that ``escaped`` wrote; ProtocolError for any other text."""
    data = text.encode("ascii", "backslashreplace")
    if not text.isascii() or b"\\" in _ESCAPE.sub(b"", data):
        raise ProtocolError(
            "tape-wrong",
            what=f"The bytes {text[:80]!r} of the tape are not escaped correctly.",
            remedy="Record it again. Its format is described in docs/reference/tape-format.md.",
        )
    return _ESCAPE.sub(lambda m: bytes.fromhex(m[1].decode()) if m[1] else _LONG[m[2]], data)


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
    tracks, left = list[Track](), MOST_UNPACKED
    for number, line in enumerate(lines[1:], start=2):
        # A program that was killed may leave half a line at the end.
        if not line or (number == len(lines) and not text.endswith("\n")):
            continue
        match = _LINE.fullmatch(line)
        if match is None:
            raise _wrong(f"line {number} is not one of a tape")
        try:
            left -= _take(tracks, match["mark"], int(match["track"]), float(match["at"]), match["text"])
        except (ProtocolError, ValueError, binascii.Error, zlib.error) as error:
            raise _wrong(f"line {number} can't be read") from error
        if left < 0:
            raise _wrong("it unpacks to more than a tape holds")
    return tuple(tracks)


def _take(tracks: list[Track], mark: str, number: int, at_s: float, text: str) -> int:
    """Add a line to its track; returns its bytes."""
    if mark == "+":
        kind, _, address = text.partition(" ")
        if number != len(tracks) + 1 or len(tracks) >= MOST_TRACKS:
            raise ValueError(number)
        tracks.append(Track(kind, unescaped(address).decode(errors="replace")))
        return 0
    if not 1 <= number <= len(tracks):
        raise ValueError(number)
    data = _unpacked(text) if mark in PACKED.values() else unescaped(text)
    tracks[number - 1].entries.append(Entry(at_s, _WAYS[mark], data))
    return len(data)


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


Answer = TypeVar("Answer")


@dataclass(frozen=True, slots=True)
class Exchange(Generic[Answer]):
    """A question with its recorded answer."""

    question: Hashable
    answer: Answer


@dataclass(slots=True)
class Replay(Generic[Answer]):
    """The answers of one device. ``acts``: whether a question is a command that changes the device."""

    exchanges: Sequence[Exchange[Answer]]
    acts: Callable[[Hashable], bool]
    _at: int = 0

    def answer(self, question: Hashable) -> Answer | None:
        """The recorded answer that is due now; None for a question that was never recorded."""
        following = self._next(question)
        earlier = self._previous(question)
        if following is not None and (earlier is None or not self._left_out(following)):
            self._at = following + 1
            return self.exchanges[following].answer
        return None if earlier is None else self.exchanges[earlier].answer

    def _next(self, question: Hashable) -> int | None:
        numbers = range(self._at, len(self.exchanges))
        return next((number for number in numbers if self.exchanges[number].question == question), None)

    def _previous(self, question: Hashable) -> int | None:
        numbers = range(min(self._at, len(self.exchanges)) - 1, -1, -1)
        return next((number for number in numbers if self.exchanges[number].question == question), None)

    def _left_out(self, following: int) -> bool:
        """Whether a command before ``following`` must be given first."""
        return any(self.acts(exchange.question) for exchange in self.exchanges[self._at : following])


_TICK_S: Final = 0.02
_LONGEST_DELAY_S: Final = 10.0
_FORGET_S: Final = 0.5
"""Bytes that are no recorded command are forgotten after this time."""
_LARGEST: Final = 1 << 16
Pieces = tuple[tuple[float, bytes], ...]
"""(seconds after the command, bytes) of an answer."""


class LineReplay:
    """What the device of a track says: bytes in, (delay, bytes) out. ``unknown`` counts unrecorded commands."""

    def __init__(self, track: Track) -> None:
        self.unknown = 0
        self.greeting, exchanges = _exchanges(track.entries)
        counts = Counter(exchange.question for exchange in exchanges)
        # Text protocols mark queries; of others it is only known that what is sent again and again changes nothing.
        self._replay = Replay(exchanges, acts=lambda command: b"?" not in bytes(command) and counts[command] == 1)  # type: ignore[call-overload]
        self._commands = sorted({bytes(e.question) for e in exchanges}, key=len, reverse=True)  # type: ignore[call-overload]
        self._heard = b""
        self._heard_at_s = 0.0

    def connected(self) -> Pieces:
        """A new connection: what the device says unasked."""
        self._heard = b""
        return self.greeting

    def feed(self, data: bytes) -> list[Pieces]:
        """The answers to the commands that ``data`` completes."""
        now_s = time.monotonic()
        if self._heard and now_s - self._heard_at_s > _FORGET_S:
            self._heard, self.unknown = b"", self.unknown + 1
        self._heard, self._heard_at_s = (self._heard + data)[-_LARGEST:], now_s
        answers = []
        while (command := next((one for one in self._commands if self._heard.startswith(one)), None)) is not None:
            self._heard = self._heard[len(command) :]
            answers.append(self._replay.answer(command) or ())
        return answers


def _exchanges(entries: Iterable[Entry]) -> tuple[Pieces, list[Exchange[Pieces]]]:
    """The greeting of the first connection, and every command with what came before the next one."""
    greeting: list[tuple[float, bytes]] = []
    commands: list[tuple[bytes, list[tuple[float, bytes]]]] = []
    answers, began_s, greeted = greeting, 0.0, False
    for entry in entries:
        if entry.way is Direction.REMARK:
            if entry.data == b"connected" or entry.data.startswith(b"opened "):
                answers, began_s = ([] if greeted else greeting), entry.at_s
                greeted = True
        elif entry.way is Direction.SENT and entry.data:
            commands.append((entry.data, []))
            answers, began_s = commands[-1][1], entry.at_s
        elif entry.data:
            answers.append((min(_LONGEST_DELAY_S, max(0.0, entry.at_s - began_s)), entry.data))
    return tuple(greeting), [Exchange(command, tuple(pieces)) for command, pieces in commands]


def _say(pieces: Pieces, write: Callable[[bytes], object], time_scale: float, stopped: threading.Event) -> None:
    """Write an answer with its recorded delays."""
    began_s = time.monotonic()
    for after_s, data in pieces:
        stopped.wait(max(0.0, began_s + after_s * time_scale - time.monotonic()))
        write(data)


class ReplayedPort(TcpServer):
    """A device on a TCP port of this computer; one connection after the other. ``time_scale`` of recorded delays."""

    def __init__(self, replay: LineReplay, *, time_scale: float = 1.0) -> None:
        super().__init__()
        self._replay = replay
        self._time_scale = time_scale

    def _accepted(self, client: socket.socket) -> None:
        self._serve(client)

    def _serve(self, client: socket.socket) -> None:
        with client, contextlib.suppress(OSError):
            _say(self._replay.connected(), client.sendall, self._time_scale, self._stopped)
            while not self._stopped.is_set():
                if not select.select([client], [], [], _TICK_S)[0]:
                    continue
                data = client.recv(4096)
                if not data:
                    return
                for pieces in self._replay.feed(data):
                    _say(pieces, client.sendall, self._time_scale, self._stopped)


class ReplayedTerminal(BackgroundDevice):
    """A device on a pseudo terminal, reached by the link ``port``; it has any baud rate."""

    def __init__(self, replay: LineReplay, port: Path, *, time_scale: float = 1.0) -> None:
        super().__init__()
        self.address = str(port)
        self._replay = replay
        self._port = port
        self._time_scale = time_scale

    def start(self) -> None:
        """Make the terminal and its link."""
        self._master, self._slave = os.openpty()  # the slave stays open, so that the master hears no hang-up
        tty.setraw(self._slave)
        self._link = PtyLink(self._port, os.ttyname(self._slave))
        super().start()

    def stop(self) -> None:
        """End, and remove both."""
        super().stop()
        self._link.remove()
        os.close(self._slave)
        os.close(self._master)

    def _run(self) -> None:
        while not self._stopped.is_set():
            if select.select([self._master], [], [], _TICK_S)[0]:
                for pieces in self._replay.feed(os.read(self._master, 4096)):
                    _say(pieces, lambda data: os.write(self._master, data), self._time_scale, self._stopped)


_HEADER: Final = struct.Struct("<IHHI")
_COMMAND, _DATA, _RESPONSE, _EVENT = 1, 2, 3, 4
_ACTS: Final = frozenset({0x100E, 0x910F, 0x9128, 0x9125, 0x90C0, 0x90CB, 0x9207, 0x9205, 0x100B, 0x9117})
"""Operations that release the shutter or delete a picture."""
_GET_OBJECT: Final = 0x1009
_PARTS: Final = frozenset({0x101B, 0x9107})
_ALWAYS: Final = {0x1002: PtpOutcome(), 0x1003: PtpOutcome()}


@dataclass(slots=True)
class _Done:
    """An operation of the tape: what was asked, what came, and the events after it."""

    code: int
    parameters: tuple[int, ...]
    sent: bytes = b""
    data: bytes | None = None
    answer: tuple[int, tuple[int, ...]] | None = None
    events: list[tuple[int, tuple[int, ...]]] = field(default_factory=list)


class TapeBody(EmulatedBody):
    """See ``EmulatedBody``. ``unknown``: operations that the tape does not have, refused as not supported."""

    def __init__(self, track: Track) -> None:
        super().__init__(_no_files, names=CameraNames("", "Camera of a tape", ""))
        done = _operations(track.entries)
        self.unknown: list[int] = []
        self._replay = Replay([Exchange((one.code, one.parameters, one.sent), one) for one in done], acts=_acts)
        self._objects = _objects(done)

    def answer(self, code: int, parameters: tuple[int, ...], data: bytes) -> PtpOutcome:
        with self.lock:
            self.answered[code] += 1
            operation = self._replay.answer((code, parameters, data)) or self._replay.answer((code, parameters, b""))
            if operation is not None:
                return self._again(operation)
            if code in _PARTS and (whole := self._objects.get(parameters[0] if parameters else -1)) is not None:
                piece = whole[parameters[1] : parameters[1] + parameters[2]]
                return PtpOutcome(parameters=(len(piece),), data=piece)
            if code == _GET_OBJECT and parameters and parameters[0] in self._objects:
                return PtpOutcome(data=self._objects[parameters[0]])
            if code not in _ALWAYS:
                self.unknown.append(code)
            return _ALWAYS.get(code, PtpOutcome(NOT_SUPPORTED))

    def _again(self, done: _Done) -> PtpOutcome:
        if done.answer is None:
            raise Gone  # the connection ended here
        for code, parameters in done.events:
            self.on_event(code, parameters)
        return PtpOutcome(done.answer[0], done.answer[1], done.data)


def _acts(question: Hashable) -> bool:
    return isinstance(question, tuple) and question[0] in _ACTS


def _operations(entries: Iterable[Entry]) -> list[_Done]:
    operations: list[_Done] = []
    for entry in entries:
        if entry.way is Direction.REMARK or len(entry.data) < _HEADER.size:
            continue
        _, kind, code, _ = _HEADER.unpack_from(entry.data)
        body = entry.data[_HEADER.size :]
        numbers = struct.unpack(f"<{len(body) // 4}I", body[: len(body) // 4 * 4]) if kind != _DATA else ()
        if kind == _COMMAND:
            operations.append(_Done(code, numbers))
        elif operations and kind == _DATA and entry.way is Direction.SENT:
            operations[-1].sent = body
        elif operations and kind == _DATA:
            operations[-1].data = body
        elif operations and kind == _RESPONSE:
            operations[-1].answer = (code, numbers)
        elif operations and kind == _EVENT:
            operations[-1].events.append((code, numbers))
    return operations


def _objects(done: Iterable[_Done]) -> dict[int, bytes]:
    """The files that were fetched, whole or in blocks, by their handles."""
    objects: dict[int, bytes] = {}
    for one in done:
        if one.data is None or not one.parameters:
            continue
        if one.code == _GET_OBJECT:
            objects[one.parameters[0]] = one.data
        elif one.code in _PARTS and len(one.parameters) > 1:
            fetched = objects.get(one.parameters[0], b"")
            objects[one.parameters[0]] = fetched[: one.parameters[1]] + one.data
    return objects


def _no_files(settings: ShotSettings) -> ShotFiles:
    raise AssertionError("a tape's camera takes no pictures of its own")


Served = Callable[[str, str, str], object]
"""Called with the device's name on the tape, the kind of its address, and the address."""
LINES: Final = ("serial", "tcp", "pjlink")


def serve_tape(
    tape: Path, folder: Path, stack: contextlib.ExitStack, served: Served, *, time_scale: float = 1.0
) -> int:
    """Start the devices of a tape until ``stack`` is closed; how many. ``folder``: for links to serial ports.

    All tracks of one kind and address are one device: each opening of it began another track. A device of an unknown
    kind is left out. ``time_scale``: of recorded delays. Raises as ``read_tape``.
    """
    count = 0
    for track in merged(read_tape(tape)):
        if track.kind == "ptp":
            camera = stack.enter_context(PtpIpCamera(TapeBody(track)))
            served(track.address, "camera", camera.address)
        elif track.kind == "serial":
            port = folder / (re.sub(r"[^A-Za-z0-9.-]+", "-", track.address) or "port")
            terminal = ReplayedTerminal(LineReplay(track), port, time_scale=time_scale)
            served(track.address, "serial", stack.enter_context(terminal).address)
        elif track.kind in LINES:
            line = stack.enter_context(ReplayedPort(LineReplay(track), time_scale=time_scale))
            served(track.address, track.kind, line.address)
        else:
            continue
        count += 1
    return count


def merged(tracks: Iterable[Track]) -> list[Track]:
    """One track for each device, in the order of their first ones."""
    devices: dict[tuple[str, str], Track] = {}
    for track in tracks:
        one = devices.setdefault((track.kind, track.address), Track(track.kind, track.address))
        one.entries.extend(track.entries)
    return list(devices.values())
