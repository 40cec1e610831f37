"""PTP/IP: a camera behind two TCP connections, one for commands and one for events (CIPA DC-005).

One thread at a time may use a link. Everything waits with the caller's deadline and stops when it is cancelled. An
unfinished transaction breaks the link, because its late answer could be taken for the next one.
"""

from __future__ import annotations

import contextlib
import select
import socket
import time
import uuid
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Final, Self

from hal.codecs.ptp import ip as ptp_ip
from hal.codecs.ptp.values import broken
from hal.deadline import SLICE_S, Deadline
from hal.errors import DeviceBusy, DeviceError, DeviceGone, DeviceRefused, PluginError
from hal.links import connected
from plugins.ptp.link import MOST_IN_MEMORY, LinkEvent, Reply, Sink, camera_lost, camera_off

DEFAULT_PORT: Final = 15740
_CONNECT_S: Final = 5.0


@dataclass(frozen=True, slots=True)
class PtpIpAddress:
    """A camera's address: host, command port, event port (the same on most cameras)."""

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


def still_time(deadline: Deadline) -> None:
    """Raise Cancelled, or DeviceTimeout after the caller's deadline."""
    deadline.check(
        "camera-no-answer",
        what="The camera did not answer in time.",
        remedy="Check that it is awake, and check its network. If it does not answer, switch it off and on.",
    )


class Wire:
    """One TCP connection. Raises DeviceGone where it ends, DeviceTimeout and Cancelled by the caller's deadline."""

    def __init__(self, connection: socket.socket) -> None:
        self._socket = connection

    @classmethod
    def connect(cls, host: str, port: int, *, deadline: Deadline) -> Self:
        """Open a connection. Raises DeviceGone("camera-off") without an answer, after at most 5 s."""
        still_time(deadline)
        try:
            connection = connected(host, port, deadline.within(_CONNECT_S))
        except OSError as error:
            if isinstance(error, TimeoutError):
                still_time(deadline)  # the caller's time may be over, and not ours
            raise camera_off(f"{host}:{port}", error.strerror or str(error)) from error
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        return cls(connection)

    def send(self, data: bytes, deadline: Deadline) -> None:
        view = memoryview(data)
        while view:
            try:
                view = view[self._socket.send(view) :]
            except BlockingIOError:
                still_time(deadline)
                with contextlib.suppress(ValueError):  # closed meanwhile by another thread: sending raises
                    select.select([], [self._socket], [], min(SLICE_S, deadline.left_s()))
            except OSError as error:
                raise camera_lost(error.strerror or str(error)) from error

    def fill(self, view: memoryview, deadline: Deadline, wait: Callable[[Deadline], object]) -> None:
        """Receive until ``view`` is full; ``wait`` is called whenever nothing is there yet."""
        while view:
            try:
                count = self._socket.recv_into(view)
            except BlockingIOError:
                wait(deadline)
                continue
            except OSError as error:
                raise camera_lost(error.strerror or str(error)) from error
            if count == 0:
                raise camera_lost("the camera closed it")
            view = view[count:]

    def available(self) -> bytes:
        """What has come and was not read; b"" for nothing. Raises DeviceGone at the end of the connection."""
        try:
            piece = self._socket.recv(65536)
        except BlockingIOError:
            return b""
        except OSError as error:
            raise camera_lost(error.strerror or str(error)) from error
        if not piece:
            raise camera_lost("the camera closed its event connection")
        return piece

    def close(self) -> None:
        with contextlib.suppress(OSError):
            self._socket.close()

    def fileno(self) -> int:
        return self._socket.fileno()


def readable(wires: Iterable[Wire | None], seconds: float) -> bool:
    """Whether one of the wires has something to read, or ends, within ``seconds``."""
    open_ones = [number for wire in wires if wire is not None and (number := wire.fileno()) >= 0]
    try:
        return bool(open_ones) and bool(select.select(open_ones, [], [], seconds)[0])
    except OSError:
        return True  # closed meanwhile by another thread: reading raises


_BLOCK: Final = 1 << 20
_MOST_EVENTS: Final = 10_000
_MOST_READS: Final = 16
_EVENTS_S: Final = 5.0


class PtpIpLink:
    """An open PTP/IP connection; see ``PtpLink``. Made by ``connect``."""

    def __init__(self, command: Wire) -> None:
        self._command = command
        self._events: Wire | None = None
        self._event_bytes = bytearray()
        self._queue: deque[LinkEvent] = deque(maxlen=_MOST_EVENTS)
        self._transaction = -1
        self._block = bytearray(_BLOCK)
        self._broken = False
        self._ready_for_events = False

    @classmethod
    def connect(cls, address: PtpIpAddress, *, deadline: Deadline) -> Self:
        """Open both connections and introduce this computer.

        Raises DeviceGone("camera-off") without an answer, DeviceBusy if another computer uses the camera,
        DeviceRefused where the camera does not know this one, DeviceTimeout.
        """
        link = cls(Wire.connect(address.host, address.command_port, deadline=deadline))
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
        still_time(deadline)
        if self._broken:
            raise camera_lost("it was closed")
        self._pump()
        self._transaction = (self._transaction + 1) % 0xFFFF_FFFF
        number = self._transaction
        try:
            packets = ptp_ip.pack(ptp_ip.Request(1 if data is None else 2, operation, number, parameters))
            if data is not None:
                packets += ptp_ip.pack(ptp_ip.StartData(number, len(data)))
                packets += ptp_ip.pack(ptp_ip.EndData(number, data))
            self._command.send(packets, deadline)
            return self._answer(number, sink, most, deadline)
        except BaseException:
            # The rest of the answer may still come; it must not be taken for the next one.
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
            if readable([self._events], min(SLICE_S, until.left_s())):
                self._pump()

    def close(self) -> None:
        self._broken = True
        for wire in (self._command, self._events):
            if wire is not None:
                wire.close()

    def _introduce(self, address: PtpIpAddress, deadline: Deadline) -> None:
        name = socket.gethostname()
        # A computer always sends the same name, so that a camera asks for pairing only once.
        guid = uuid.uuid5(uuid.NAMESPACE_DNS, f"velatura.{name}").bytes
        self._command.send(ptp_ip.pack(ptp_ip.InitCommandRequest(guid, f"Velatura {name}"[:39])), deadline)
        accepted = self._packet(self._command, deadline)
        if not isinstance(accepted, ptp_ip.InitCommandAck):
            raise _unwelcome(accepted)
        self._events = _event_wire(address, accepted.name, deadline)
        self._events.send(ptp_ip.pack(ptp_ip.InitEventRequest(accepted.connection)), deadline)
        ready = self._packet(self._events, deadline)
        if not isinstance(ready, ptp_ip.InitEventAck):
            raise _unwelcome(ready)
        self._ready_for_events = True

    def _answer(self, number: int, sink: Sink | None, most: int, deadline: Deadline) -> Reply:
        """Read packets until the response; the data phase, if any, goes to ``sink`` or is kept."""
        kept = bytearray()
        take: Sink = kept.extend if sink is None else sink
        total: int | None = None
        received = 0
        while True:
            still_time(deadline)  # also against a camera that never stops sending
            length, kind = ptp_ip.parse_header(self._exactly(self._command, ptp_ip.HEADER.size, deadline))
            if kind in ptp_ip.DATA_TYPES:
                if length < 4:
                    raise broken("a piece of data without its request")
                self._belongs(int.from_bytes(self._exactly(self._command, 4, deadline), "little"), number)
                received += length - 4
                if total is None or received > total or received > most:
                    raise broken(f"{received} bytes of data; {total} were announced and {most} are allowed")
                self._stream(length - 4, take, deadline)
                continue
            packet = ptp_ip.parse(kind, self._exactly(self._command, length, deadline))
            match packet:
                case ptp_ip.StartData(transaction, announced):
                    self._belongs(transaction, number)
                    total = most if announced in ptp_ip.UNKNOWN_TOTAL else announced
                    if total > most:
                        raise broken(f"{total} bytes of data instead of at most {most}")
                    declared = announced
                case ptp_ip.Response(code, transaction, parameters):
                    self._belongs(transaction, number)
                    if total is not None and declared not in ptp_ip.UNKNOWN_TOTAL and received != total:
                        raise broken(f"{received} bytes of data instead of {total}")
                    return Reply(code, parameters, bytes(kept))
                case _:
                    self._aside(packet, self._command, deadline)

    def _belongs(self, transaction: int, number: int) -> None:
        if transaction != number:
            raise broken(f"the answer to request {transaction} while request {number} was asked")

    def _stream(self, count: int, take: Sink, deadline: Deadline) -> None:
        view = memoryview(self._block)
        while count:
            piece = view[: min(count, _BLOCK)]
            still_time(deadline)
            self._command.fill(piece, deadline, self._wait)
            take(piece)
            count -= len(piece)

    def _aside(self, packet: ptp_ip.Packet, wire: Wire, deadline: Deadline) -> None:
        """Packets that may come at any time, on either connection."""
        match packet:
            case ptp_ip.Event(code, _, parameters):
                self._queue.append(LinkEvent(code, parameters))
            case ptp_ip.Ping():
                wire.send(ptp_ip.pack(ptp_ip.Pong()), deadline)
            case ptp_ip.Pong():
                pass
            case ptp_ip.Cancel():
                raise camera_lost("the camera cancelled the transfer")
            case _:
                raise broken(f"a packet of type {packet.TYPE} at the wrong moment")

    def _pump(self) -> None:
        """Read the event connection, without waiting."""
        if self._events is None:
            return
        try:
            for _ in range(_MOST_READS):
                self._event_bytes += self._events.available()
                if len(self._event_bytes) < ptp_ip.HEADER.size:
                    break
                self._parse_events(self._events, Deadline(time.monotonic() + 1.0))
        except DeviceError:
            self.close()
            raise

    def _parse_events(self, events: Wire, deadline: Deadline) -> None:
        pending = self._event_bytes
        while len(pending) >= ptp_ip.HEADER.size:
            length, kind = ptp_ip.parse_header(pending[: ptp_ip.HEADER.size])
            end = ptp_ip.HEADER.size + length
            if kind in ptp_ip.DATA_TYPES:
                raise broken("picture data on the event connection")
            if len(pending) < end:
                return
            packet = ptp_ip.parse(kind, bytes(pending[ptp_ip.HEADER.size : end]))
            del pending[:end]
            self._aside(packet, events, deadline)

    def _packet(self, wire: Wire, deadline: Deadline) -> ptp_ip.Packet:
        length, kind = ptp_ip.parse_header(self._exactly(wire, ptp_ip.HEADER.size, deadline))
        if kind in ptp_ip.DATA_TYPES:
            raise broken("picture data before the session was open")
        return ptp_ip.parse(kind, self._exactly(wire, length, deadline))

    def _exactly(self, wire: Wire, count: int, deadline: Deadline) -> bytearray:
        data = bytearray(count)
        wire.fill(memoryview(data), deadline, self._wait)
        return data

    def _wait(self, deadline: Deadline) -> None:
        """Wait for bytes; meanwhile answer pings, because a camera that exposes for a minute may ask."""
        still_time(deadline)
        if readable([self._command, self._events], min(SLICE_S, deadline.left_s())) and self._ready_for_events:
            self._pump()


def _event_wire(address: PtpIpAddress, name: str, deadline: Deadline) -> Wire:
    """Some cameras open this port a while after the first connection. Raises DeviceRefused("camera-no-events")."""
    give_up = deadline.within(_EVENTS_S)
    while True:
        try:
            return Wire.connect(address.host, address.event_port, deadline=deadline)
        except DeviceGone as error:
            if not give_up.passed:
                give_up.sleep(0.1)
                continue
            raise DeviceRefused(
                "camera-no-events",
                what=f"The camera {name or address.host} accepts this computer, but not on its event port "
                f"{address.event_port}.",
                remedy="Give its event port in stage.toml (ptpip:HOST:COMMANDPORT:EVENTPORT). Fujifilm cameras are "
                "not supported on the network: connect them by USB.",
            ) from error


def _unwelcome(packet: ptp_ip.Packet) -> DeviceError:
    if not isinstance(packet, ptp_ip.InitFail):
        return broken(f"a packet of type {packet.TYPE} instead of a welcome")
    if packet.reason == 2:
        return DeviceBusy(
            "camera-in-use",
            what="The camera is connected to another computer.",
            remedy="Close the other connection, or switch the camera off and on. Then try again.",
        )
    return DeviceRefused(
        "camera-refused-pairing",
        what="The camera does not accept this computer.",
        remedy="Pair it in the camera's network menu (its name starts with Velatura). Then try again.",
    )
