"""Records what another program says to a device: it connects to a port here, and all bytes are passed to the device.

``kind`` "pjlink" and "tcp" are byte streams. "ptpip" is a camera with two connections, whose operations are recorded as
containers of PTP over USB, as the driver ``ptp`` records them.
"""

from __future__ import annotations

import contextlib
import socket
import struct
import threading
from collections.abc import Callable
from typing import Final

from hal.codecs.ptp import ip as ptp_ip
from hal.codecs.ptp import usb as ptp_usb
from hal.deadline import in_seconds
from hal.errors import DeviceError
from hal.links import connected
from hal.tape import Tape, Transcript

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
