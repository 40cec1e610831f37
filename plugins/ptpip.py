"""PTP/IP: a camera behind two TCP connections, one for commands and one for events (CIPA DC-005).

One thread at a time may use a link. Everything waits with the caller's deadline and stops when it is cancelled; a
transaction that was left in the middle breaks the link, because its late answer could be taken for the next one.
"""

from __future__ import annotations

import contextlib
import select
import socket
import time
import uuid
from collections import deque
from dataclasses import dataclass
from typing import Final, Self

from hal import ptp_ip
from hal.deadline import Deadline
from hal.errors import DeviceBusy, DeviceError, DeviceRefused, PluginError
from hal.ptp import broken
from plugins.ptp_link import MOST_IN_MEMORY, LinkEvent, Reply, Sink, camera_lost, camera_off

DEFAULT_PORT: Final = 15740
_BLOCK: Final = 1 << 20
_SLICE_S: Final = 0.05
_MOST_EVENTS: Final = 10_000


@dataclass(frozen=True, slots=True)
class PtpIpAddress:
    """Where a camera listens: host, command port, event port (the same one on most cameras)."""

    host: str
    command_port: int
    event_port: int

    @classmethod
    def parse(cls, text: str) -> Self:
        """Read ``ptpip:HOST[:CMDPORT[:EVTPORT]]``; an IPv6 host stands in brackets. Raises PluginError."""
        scheme, _, rest = text.partition(":")
        host, _, ports = rest[1:].partition("]") if rest.startswith("[") else rest.partition(":")
        numbers = [part for part in ports.removeprefix(":").split(":") if ports]
        valid = all(part.isascii() and part.isdigit() and 0 < int(part) < 65536 for part in numbers)
        if scheme != "ptpip" or not host or not valid or len(numbers) > 2:
            raise PluginError(
                "camera-address",
                what=f"{text!r} is not the address of a camera.",
                remedy="Write it as ptpip:HOST:COMMANDPORT:EVENTPORT, for example ptpip:192.168.1.20:15740.",
            )
        command = int(numbers[0]) if numbers else DEFAULT_PORT
        return cls(host, command, int(numbers[1]) if len(numbers) == 2 else command)

    def __str__(self) -> str:
        return f"{self.host}:{self.command_port}"


class PtpIpLink:
    """An open PTP/IP connection; see ``PtpLink``. Made by ``connect``."""

    def __init__(self, command: socket.socket) -> None:
        self._command = command
        self._events: socket.socket | None = None
        self._event_bytes = bytearray()
        self._queue: deque[LinkEvent] = deque(maxlen=_MOST_EVENTS)
        self._transaction = -1
        self._block = bytearray(_BLOCK)
        self._broken = False

    @classmethod
    def connect(cls, address: PtpIpAddress, *, deadline: Deadline) -> Self:
        """Open both connections and introduce this computer.

        Raises DeviceGone("camera-off") where nobody listens, DeviceBusy where another computer holds the camera,
        DeviceRefused where the camera does not know this one, DeviceTimeout.
        """
        link = cls(_open(address, address.command_port, deadline))
        try:
            link._introduce(address, deadline)
        except BaseException:
            link.close()
            raise
        return link

    @property
    def broken(self) -> bool:
        return self._broken

    def transact(
        self,
        operation: int,
        *parameters: int,
        data: bytes | None = None,
        sink: Sink | None = None,
        most: int = MOST_IN_MEMORY,
        deadline: Deadline,
    ) -> Reply:
        _still_time(deadline)
        if self._broken:
            raise camera_lost("it was closed")
        self._transaction = (self._transaction + 1) % 0xFFFF_FFFF
        number = self._transaction
        try:
            packets = ptp_ip.pack(ptp_ip.Request(1 if data is None else 2, operation, number, parameters))
            if data is not None:
                packets += ptp_ip.pack(ptp_ip.StartData(number, len(data)))
                packets += ptp_ip.pack(ptp_ip.EndData(number, data))
            self._send(self._command, packets, deadline)
            return self._answer(number, sink, most, deadline)
        except BaseException:
            # The rest of the answer may still come; nobody must take it for the next one.
            self.close()
            raise

    def events(self) -> list[LinkEvent]:
        if not self._broken:
            self._pump()
        found = list(self._queue)
        self._queue.clear()
        return found

    def wait_event(self, seconds: float, *, deadline: Deadline) -> None:
        until = deadline.within(seconds)
        while not self._queue and not until.passed and not self._broken:
            until.sleep(0)
            if self._events is not None and _readable([self._events], min(_SLICE_S, until.left_s())):
                self._pump()

    def close(self) -> None:
        self._broken = True
        for connection in (self._command, self._events):
            if connection is not None:
                with contextlib.suppress(OSError):
                    connection.close()

    def _introduce(self, address: PtpIpAddress, deadline: Deadline) -> None:
        name = socket.gethostname()
        # The same computer always says the same, so that a camera that pairs asks its owner only once.
        guid = uuid.uuid5(uuid.NAMESPACE_DNS, f"velatura.{name}").bytes
        self._send(self._command, ptp_ip.pack(ptp_ip.InitCommandRequest(guid, f"Velatura {name}"[:39])), deadline)
        accepted = self._packet(self._command, deadline)
        if not isinstance(accepted, ptp_ip.InitCommandAck):
            raise _unwelcome(accepted)
        self._events = _open(address, address.event_port, deadline)
        self._send(self._events, ptp_ip.pack(ptp_ip.InitEventRequest(accepted.connection)), deadline)
        ready = self._packet(self._events, deadline)
        if not isinstance(ready, ptp_ip.InitEventAck):
            raise _unwelcome(ready)

    def _answer(self, number: int, sink: Sink | None, most: int, deadline: Deadline) -> Reply:
        """Read packets until the response; the data phase, if any, goes to ``sink`` or is kept."""
        kept: list[bytes] = []
        take: Sink = sink if sink is not None else lambda piece: kept.append(bytes(piece))
        total: int | None = None
        received = 0
        while True:
            length, kind = ptp_ip.parse_header(self._exactly(self._command, ptp_ip.HEADER.size, deadline))
            if kind in ptp_ip.DATA_TYPES:
                self._belongs(int.from_bytes(self._exactly(self._command, min(4, length), deadline), "little"), number)
                received += length - 4
                if total is None or received > total or received > most:
                    raise broken(f"{received} bytes of data where {total} were announced and {most} allowed")
                self._stream(length - 4, take, deadline)
                continue
            packet = ptp_ip.parse(kind, self._exactly(self._command, length, deadline))
            match packet:
                case ptp_ip.StartData(transaction, announced):
                    self._belongs(transaction, number)
                    total = most if announced in ptp_ip.UNKNOWN_TOTAL else announced
                    if total > most:
                        raise broken(f"{total} bytes of data where at most {most} were expected")
                    declared = announced
                case ptp_ip.Response(code, transaction, parameters):
                    self._belongs(transaction, number)
                    if total is not None and declared not in ptp_ip.UNKNOWN_TOTAL and received != total:
                        raise broken(f"{received} bytes of data where {total} were announced")
                    return Reply(code, parameters, b"".join(kept))
                case _:
                    self._aside(packet, self._command, deadline)

    def _belongs(self, transaction: int, number: int) -> None:
        if transaction != number:
            raise broken(f"the answer to request {transaction} while request {number} was asked")

    def _stream(self, count: int, take: Sink, deadline: Deadline) -> None:
        view = memoryview(self._block)
        while count:
            piece = view[: min(count, _BLOCK)]
            self._fill(self._command, piece, deadline)
            take(piece)
            count -= len(piece)

    def _aside(self, packet: ptp_ip.Packet, connection: socket.socket, deadline: Deadline) -> None:
        """Packets that may come at any time, on either connection."""
        match packet:
            case ptp_ip.Event(code, _, parameters):
                self._queue.append(LinkEvent(code, parameters))
            case ptp_ip.Ping():
                self._send(connection, ptp_ip.pack(ptp_ip.Pong()), deadline)
            case ptp_ip.Pong():
                pass
            case ptp_ip.Cancel():
                raise camera_lost("the camera cancelled the transfer")
            case _:
                raise broken(f"a packet of type {packet.TYPE} at the wrong moment")

    def _pump(self) -> None:
        """Take in whatever lies on the event connection, without waiting."""
        if self._events is None:
            return
        soon = Deadline(time.monotonic() + 1.0)
        try:
            while _readable([self._events], 0.0):
                piece = self._events.recv(65536)
                if not piece:
                    raise camera_lost("the camera closed its event connection")
                self._event_bytes += piece
                self._parse_events(soon)
        except OSError as error:
            self.close()
            raise camera_lost(error.strerror or str(error)) from error
        except DeviceError:
            self.close()
            raise

    def _parse_events(self, deadline: Deadline) -> None:
        pending = self._event_bytes
        while len(pending) >= ptp_ip.HEADER.size:
            length, kind = ptp_ip.parse_header(pending[: ptp_ip.HEADER.size])
            if kind in ptp_ip.DATA_TYPES:
                raise broken("picture data on the event connection")
            if len(pending) < ptp_ip.HEADER.size + length:
                return
            packet = ptp_ip.parse(kind, bytes(pending[ptp_ip.HEADER.size : ptp_ip.HEADER.size + length]))
            del pending[: ptp_ip.HEADER.size + length]
            if self._events is not None:
                self._aside(packet, self._events, deadline)

    def _packet(self, connection: socket.socket, deadline: Deadline) -> ptp_ip.Packet:
        length, kind = ptp_ip.parse_header(self._exactly(connection, ptp_ip.HEADER.size, deadline))
        if kind in ptp_ip.DATA_TYPES:
            raise broken("picture data before the session was open")
        return ptp_ip.parse(kind, self._exactly(connection, length, deadline))

    def _exactly(self, connection: socket.socket, count: int, deadline: Deadline) -> bytearray:
        data = bytearray(count)
        self._fill(connection, memoryview(data), deadline)
        return data

    def _fill(self, connection: socket.socket, view: memoryview, deadline: Deadline) -> None:
        while view:
            try:
                count = connection.recv_into(view)
            except BlockingIOError:
                self._wait_readable(connection, deadline)
                continue
            except OSError as error:
                raise camera_lost(error.strerror or str(error)) from error
            if count == 0:
                raise camera_lost("the camera closed it")
            view = view[count:]

    def _wait_readable(self, connection: socket.socket, deadline: Deadline) -> None:
        """Wait for bytes; meanwhile answer pings, because a camera that exposes for a minute may ask."""
        _still_time(deadline)
        watched = [connection] if self._events in (None, connection) else [connection, self._events]
        ready = _readable([one for one in watched if one is not None], min(_SLICE_S, deadline.left_s()))
        if self._events in ready and self._events is not connection:
            self._pump()

    def _send(self, connection: socket.socket, data: bytes, deadline: Deadline) -> None:
        view = memoryview(data)
        while view:
            try:
                view = view[connection.send(view) :]
            except BlockingIOError:
                _still_time(deadline)
                select.select([], [connection], [], min(_SLICE_S, deadline.left_s()))
            except OSError as error:
                raise camera_lost(error.strerror or str(error)) from error


def _still_time(deadline: Deadline) -> None:
    deadline.check(
        "camera-no-answer",
        what="The camera did not answer in time.",
        remedy="Check that it is awake and that its network is good; switch it off and on if it stays silent.",
    )


def _open(address: PtpIpAddress, port: int, deadline: Deadline) -> socket.socket:
    """A connected, non-blocking socket; a host that drops packets ends with the deadline."""
    _still_time(deadline)
    try:
        connection = socket.create_connection((address.host, port), timeout=max(0.05, min(5.0, deadline.left_s())))
    except OSError as error:
        raise camera_off(f"{address.host}:{port}", error.strerror or str(error)) from error
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    connection.setblocking(False)
    return connection


def _readable(connections: list[socket.socket], seconds: float) -> list[socket.socket]:
    try:
        return select.select(connections, [], [], seconds)[0]
    except ValueError:  # closed by another thread
        return []


def _unwelcome(packet: ptp_ip.Packet) -> DeviceError:
    if not isinstance(packet, ptp_ip.InitFail):
        return broken(f"a packet of type {packet.TYPE} instead of a welcome")
    if packet.reason == 2:
        return DeviceBusy(
            "camera-in-use",
            what="The camera is connected to another computer.",
            remedy="End the other connection, or switch the camera off and on, then try again.",
        )
    return DeviceRefused(
        "camera-refused-pairing",
        what="The camera does not accept this computer.",
        remedy="Pair it in the camera's network menu (the name begins with Velatura), then try again.",
    )
