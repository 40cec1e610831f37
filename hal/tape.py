"""Tapes: all traffic between this computer and its devices in one file (docs/reference/tape-format.md), written and
read; and relays, which record what another program says to a device.

A program connects to a port here, and all bytes pass to the device. ``kind`` "pjlink" and "tcp" are byte streams.
"ptpip" is a camera with two connections, whose operations are recorded as containers of PTP over USB, as the driver
``ptp`` records them.
"""

from __future__ import annotations

import base64
import binascii
import contextlib
import re
import socket
import struct
import threading
import time
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, TextIO

from hal.codecs.ptp import ip as ptp_ip
from hal.codecs.ptp import usb as ptp_usb
from hal.deadline import in_seconds
from hal.errors import DeviceError, ProtocolError
from hal.escapes import escaped, unescaped
from hal.links import connected
from hal.runtime.files import require_regular
from hal.transcript import Direction, Entry, Transcript

HEADER: Final = "velatura tape 1"
MOST_BYTES: Final = 1 << 30
"""A tape ends at this size, so that it fills no disk."""
PACK_FROM: Final = 200
"""Longer pieces are packed."""
PACKED: Final = {Direction.SENT: "}", Direction.RECEIVED: "{"}
_PJLINK_GREETING: Final = re.compile(rb"PJLINK 1 [0-9A-Fa-f]{1,64}")
_PJLINK_DIGEST: Final = re.compile(rb"\A(?:[0-9A-Fa-f]{64}|[0-9A-Fa-f]{32})(?=%)")


class Tape:
    """One file for all devices of a session; every line is written at once and survives a crash.

    Raises ``OSError`` where the file can't be made. A full disk later ends the tape and not the session.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._began_s = time.monotonic()
        self._lock = threading.Lock()
        self._tracks = 0
        self._written = 0
        self._file: TextIO | None = path.open("w", encoding="ascii", buffering=1)
        self._write(HEADER)

    def track(self, kind: str, address: str, *, secrets: tuple[bytes, ...] = ()) -> TapeTrack:
        """A new track: ``kind`` is a word for how its bytes are to be understood, ``address`` the device's.

        Each of ``secrets`` is written as asterisks.
        """
        with self._lock:
            self._tracks += 1
            number = self._tracks
        self._line("+", number, f"{kind} {escaped(address.encode())}")
        return TapeTrack(self, number, kind, secrets)

    def close(self) -> None:
        with self._lock:
            if self._file is not None:
                with contextlib.suppress(OSError):
                    self._file.close()
                self._file = None

    def add(self, number: int, way: Direction, data: bytes) -> None:
        """Write one piece of a track."""
        if way in PACKED and len(data) >= PACK_FROM:
            self._line(PACKED[way], number, base64.b64encode(zlib.compress(data, 1)).decode())
        else:
            self._line(way.value, number, escaped(data))

    def _line(self, mark: str, number: int, text: str) -> None:
        self._write(f"{time.monotonic() - self._began_s:.6f} {mark} {number} {text}")

    def _write(self, line: str) -> None:
        with self._lock:
            if self._file is None:
                return
            self._written += len(line) + 1
            try:
                self._file.write(line + "\n" if self._written <= MOST_BYTES else "")
            except OSError:
                self._file = None


class TapeTrack(Transcript):
    """A transcript that is a track of a tape; it keeps nothing in memory. ``close`` leaves the tape open."""

    whole = True

    def __init__(self, tape: Tape, number: int, kind: str, secrets: tuple[bytes, ...]) -> None:
        super().__init__(keep=1)
        self._tape = tape
        self._number = number
        self._kind = kind
        self._secrets = tuple(secret for secret in secrets if secret)

    def _add(self, way: Direction, data: bytes) -> None:
        self._tape.add(self._number, way, self._without_secrets(data))

    def _without_secrets(self, data: bytes) -> bytes:
        for secret in self._secrets:
            data = data.replace(secret, b"*" * len(secret))
        if self._kind == "pjlink":
            # A tape has no authentication: a digest could be used to guess the password.
            data = _PJLINK_DIGEST.sub(b"", _PJLINK_GREETING.sub(b"PJLINK 0", data))
        return data


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


_BLOCK: Final = 1 << 16
_CONNECT_S: Final = 5.0
Heard = Callable[[bytes], object]


class Relay:
    """One relayed port from ``start`` to ``stop``; also a context. ``port``: the one here to connect to."""

    def __init__(self, host: str, port: int, made: Callable[[], tuple[Heard, Heard]]) -> None:
        self._device = host, port
        self._made = made
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._open: set[socket.socket] = set()
        self.port: int = self._listener.getsockname()[1]
        self._thread = threading.Thread(target=self._accept, name="relay", daemon=True)

    def __enter__(self) -> Relay:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        for one in (self._listener, *self._open):
            _end(one)
        self._thread.join()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                self._relayed(self._listener.accept()[0])

    def _relayed(self, program: socket.socket) -> None:
        try:
            device = connected(*self._device, in_seconds(_CONNECT_S))
        except (OSError, DeviceError):
            _end(program)
            return
        device.setblocking(True)
        self._open |= {program, device}
        sent, received = self._made()
        for source, sink, heard in ((program, device, sent), (device, program, received)):
            threading.Thread(target=self._copy, args=(source, sink, heard), name="relay", daemon=True).start()

    def _copy(self, source: socket.socket, sink: socket.socket, heard: Heard) -> None:
        with contextlib.suppress(OSError):
            while data := source.recv(_BLOCK):
                heard(data)  # before the other side can answer
                sink.sendall(data)
        for one in (source, sink):
            _end(one)
            self._open.discard(one)


def stream_relay(host: str, port: int, tape: Tape, *, kind: str = "tcp") -> Relay:
    """A relay to a device whose bytes are recorded as they are."""
    track = tape.track(kind, f"{host}-{port}")

    def made() -> tuple[Heard, Heard]:
        track.remark("connected")
        return track.sent, track.received

    return Relay(host, port, made)


def ptpip_relays(host: str, command_port: int, event_port: int, tape: Tape) -> tuple[Relay, Relay]:
    """Relays to a camera on PTP/IP: for its commands, and for its events."""
    track = tape.track("ptp", f"{host}-{command_port}")

    def commands() -> tuple[Heard, Heard]:
        track.remark("connected")
        talk = _Operations(track)
        return _Packets(talk.sent).feed, _Packets(talk.received).feed

    def events() -> tuple[Heard, Heard]:
        return lambda data: None, _Packets(_Operations(track).received).feed

    return Relay(host, command_port, commands), Relay(host, event_port, events)


class _Packets:
    """Cuts a stream of PTP/IP into packets (type, body); gives up where it is none."""

    def __init__(self, packet: Callable[[int, bytes], object]) -> None:
        self._packet = packet
        self._buffer = bytearray()

    def feed(self, data: bytes) -> None:
        self._buffer += data
        with contextlib.suppress(DeviceError, struct.error):
            while len(self._buffer) >= ptp_ip.HEADER.size:
                length, kind = ptp_ip.HEADER.unpack_from(self._buffer)
                if not ptp_ip.HEADER.size <= length <= ptp_usb.UNKNOWN_LENGTH or len(self._buffer) < length:
                    return
                body = bytes(self._buffer[ptp_ip.HEADER.size : length])
                del self._buffer[:length]
                self._packet(kind, body)


class _Operations:
    """Packets of PTP/IP as containers of PTP over USB on a track."""

    def __init__(self, track: Transcript) -> None:
        self._track = track
        self._data: dict[bool, bytearray] = {True: bytearray(), False: bytearray()}
        self._operation = 0

    def sent(self, kind: int, body: bytes) -> None:
        if kind == ptp_ip.Request.TYPE:
            _, self._operation, number = struct.unpack_from("<IHI", body)
            self._track.sent(_container(ptp_usb.COMMAND, self._operation, number, body[10:]))
        self._collect(True, kind, body)

    def received(self, kind: int, body: bytes) -> None:
        self._collect(False, kind, body)
        if kind in (ptp_ip.Response.TYPE, ptp_ip.Event.TYPE):
            code, number = struct.unpack_from("<HI", body)
            what = ptp_usb.RESPONSE if kind == ptp_ip.Response.TYPE else ptp_usb.EVENT
            self._track.received(_container(what, code, number, body[6:]))

    def _collect(self, sent: bool, kind: int, body: bytes) -> None:
        if kind == ptp_ip.StartData.TYPE:
            self._data[sent].clear()
        elif kind in ptp_ip.DATA_TYPES:
            self._data[sent] += body[4:]
        if kind == ptp_ip.EndData.TYPE:
            number = struct.unpack_from("<I", body)[0]
            write = self._track.sent if sent else self._track.received
            write(ptp_usb.pack_data(self._operation, number, bytes(self._data[sent])))


def _container(kind: int, code: int, number: int, body: bytes) -> bytes:
    return ptp_usb.HEADER.pack(ptp_usb.HEADER.size + len(body), kind, code, number) + body


def _end(connection: socket.socket) -> None:
    with contextlib.suppress(OSError):
        connection.shutdown(socket.SHUT_RDWR)
    connection.close()
