"""Byte links: how bytes reach a device and come back, always with a deadline; over TCP the lookup of the host's name
is part of it.

Links and protocol codecs are independent. ``hal.serial_link`` has the link over a serial port.
"""

from __future__ import annotations

import contextlib
import errno
import ipaddress
import os
import select
import socket
import threading
from abc import ABC, abstractmethod
from concurrent.futures import Future, wait
from typing import Any, Final, Protocol

from hal.deadline import SLICE_S, Deadline
from hal.errors import DeviceBusy, DeviceError, DeviceGone, DeviceTimeout, ProtocolError
from hal.tape import Transcript

_Places = list[tuple[Any, ...]]
_turn = threading.Lock()
_looked_up: dict[tuple[str, int], Future[_Places]] = {}
"""Lookups that are running."""


def connected(host: str, port: int, deadline: Deadline) -> socket.socket:
    """A socket, not blocking, connected to the first of the host's addresses that answers.

    Raises
    ------
    OSError    the host has no address, or no program listens there; TimeoutError: no connection before the deadline
    Cancelled  asked to stop
    """
    places = _places(host, port, deadline)
    failure = OSError(errno.EHOSTUNREACH, os.strerror(errno.EHOSTUNREACH))
    for number, place in enumerate(places):
        try:
            # With several addresses, each gets its share of the time.
            return _connected(place, deadline.within(deadline.left_s() / (len(places) - number)))
        except OSError as error:
            failure = error
    raise failure


def _places(host: str, port: int, deadline: Deadline) -> _Places:
    """The result of ``getaddrinfo``, on another thread, because without a name server it may wait for half a minute."""
    try:
        return list(socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_NUMERICHOST))
    except socket.gaierror:  # a name
        found = _begun(host, port)
    except ValueError as error:
        raise OSError(errno.EINVAL, f"{host!r} is not a valid host name") from error
    while not wait((found,), min(SLICE_S, deadline.left_s())).done:
        _still_time(deadline)
    return found.result()


def _begun(host: str, port: int) -> Future[_Places]:
    """The lookup of a name; only one at a time for each name, even if callers give up."""

    def resolve() -> None:
        try:
            found.set_result(list(socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)))
        except OSError as error:
            found.set_exception(error)
        finally:
            with _turn:
                del _looked_up[host, port]

    with _turn:
        if (host, port) in _looked_up:
            return _looked_up[host, port]
        found = _looked_up[host, port] = Future()
    threading.Thread(target=resolve, name="names", daemon=True).start()
    return found


def _connected(place: tuple[Any, ...], deadline: Deadline) -> socket.socket:
    family, kind, protocol, _, address = place
    connection = socket.socket(family, kind, protocol)
    try:
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        failure = connection.connect_ex(address)
        if failure == errno.EINPROGRESS:
            while not select.select([], [connection], [], min(SLICE_S, deadline.left_s()))[1]:
                _still_time(deadline)
            failure = connection.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
        if failure:
            raise OSError(failure, os.strerror(failure))
    except BaseException:
        connection.close()
        raise
    return connection


def _still_time(deadline: Deadline) -> None:
    deadline.sleep(0.0)  # a cancelled call ends soon
    if deadline.passed:
        raise TimeoutError(errno.ETIMEDOUT, os.strerror(errno.ETIMEDOUT))


_BLOCK: Final = 4096
_LARGEST_DRAIN: Final = 1 << 20


class ByteLink(Protocol):
    """A two-way stream of bytes to one device.

    Every call raises DeviceGone when the link is lost, DeviceTimeout when the deadline passes, Cancelled on a stop
    request. Bytes of an incomplete read stay readable.
    """

    def read_until(self, terminator: bytes, *, limit: int, deadline: Deadline) -> bytes:
        """Read up to and including ``terminator``; ProtocolError if it is not among the first ``limit`` bytes."""

    def read_exactly(self, count: int, *, deadline: Deadline) -> bytes:
        """Read ``count`` bytes."""

    def write(self, data: bytes, *, deadline: Deadline) -> None:
        """Write all of ``data``."""

    def drain(self) -> bytes:
        """Take everything that has arrived, without waiting."""

    def close(self) -> None:
        """Close the port or connection; may be called twice."""


class BufferedLink(ABC):
    """Base of all real links: a buffer, deadlines with short waits, and the transcript.

    A subclass waits and moves bytes in ``_receive`` and ``_send``, and turns its errors into ``hal.errors``.
    """

    def __init__(self, name: str, transcript: Transcript | None = None) -> None:
        self.name = name
        self._buffer = bytearray()
        self._transcript = transcript

    def record(self, transcript: Transcript | None) -> None:
        """Record all bytes from now on; None: none any more."""
        self._transcript = transcript

    @abstractmethod
    def _receive(self, wait_s: float) -> bytes:
        """Bytes that arrive within ``wait_s``; b"" if none did."""

    @abstractmethod
    def _send(self, data: bytes, wait_s: float) -> int:
        """Send some of ``data`` within ``wait_s``; return how many bytes went."""

    @abstractmethod
    def close(self) -> None: ...

    def read_until(self, terminator: bytes, *, limit: int, deadline: Deadline) -> bytes:
        while True:
            end = self._buffer.find(terminator, 0, limit)
            if end >= 0:
                return self._take(end + len(terminator))
            if len(self._buffer) >= limit:
                raise ProtocolError(
                    "answer-too-long",
                    what=f"{self.name} sent {limit} bytes without ending its answer.",
                    remedy="Check the baud rate and that the right device is on this cable.",
                )
            self._fill(deadline)

    def read_exactly(self, count: int, *, deadline: Deadline) -> bytes:
        while len(self._buffer) < count:
            self._fill(deadline)
        return self._take(count)

    def write(self, data: bytes, *, deadline: Deadline) -> None:
        left = memoryview(data)
        while left:
            self._check(deadline, "did not take the command")
            sent = self._send(bytes(left), min(SLICE_S, deadline.left_s()))
            if sent and self._transcript is not None:
                self._transcript.sent(bytes(left[:sent]))
            left = left[sent:]

    def drain(self) -> bytes:
        while len(self._buffer) < _LARGEST_DRAIN and self._pump(0.0):
            pass
        return self._take(len(self._buffer))

    def _fill(self, deadline: Deadline) -> None:
        self._check(deadline, "did not answer")
        self._pump(min(SLICE_S, deadline.left_s()))

    def _pump(self, wait_s: float) -> bool:
        data = self._receive(wait_s)
        if data and self._transcript is not None:
            self._transcript.received(data)
        self._buffer += data
        return bool(data)

    def _take(self, count: int) -> bytes:
        taken = bytes(self._buffer[:count])
        del self._buffer[:count]
        return taken

    def _check(self, deadline: Deadline, failing: str) -> None:
        deadline.check(
            "link-no-answer",
            what=f"{self.name} {failing} in time.",
            remedy="Check that the device has power and its cable is connected at both ends.",
        )


class TcpLink(BufferedLink):
    """A TCP connection to ``host``:``port``.

    Raises
    ------
    DeviceGone     no program listens there, or the host is not reachable
    DeviceTimeout  no connection before the deadline
    """

    def __init__(self, host: str, port: int, *, deadline: Deadline, transcript: Transcript | None = None) -> None:
        super().__init__(f"{host}:{port}", transcript)
        self._socket = self._connect(host, port, deadline)
        if transcript is not None:
            transcript.remark("connected")

    def _connect(self, host: str, port: int, deadline: Deadline) -> socket.socket:
        self._check(deadline, "was not reached")
        try:
            return connected(host, port, deadline)
        except TimeoutError as error:
            raise DeviceTimeout(
                "link-no-connection",
                what=f"{self.name} did not accept a connection in time.",
                remedy="Check the network cable and that the device's network is on in standby.",
            ) from error
        except OSError as error:
            raise self._lost(error) from error

    def _receive(self, wait_s: float) -> bytes:
        try:
            readable, _, _ = select.select([self._socket], [], [], wait_s)
            if not readable:
                return b""
            data = self._socket.recv(_BLOCK)
        except BlockingIOError:
            return b""
        except (OSError, ValueError) as error:
            raise self._lost(error) from error
        if not data:
            raise self._lost(None)
        return data

    def _send(self, data: bytes, wait_s: float) -> int:
        try:
            _, writable, _ = select.select([], [self._socket], [], wait_s)
            return self._socket.send(data) if writable else 0
        except BlockingIOError:
            return 0
        except (OSError, ValueError) as error:
            raise self._lost(error) from error

    def _lost(self, error: Exception | None) -> DeviceGone:
        reason = getattr(error, "strerror", None) or "the connection was closed"
        return DeviceGone(
            "link-lost",
            what=f"{self.name} can't be reached: {reason}.",
            remedy="Check the address, the network cable and that the device has power. Another program may be "
            "connected to it: many take one at a time.",
        )

    def close(self) -> None:
        with contextlib.suppress(OSError):
            self._socket.close()


def host_and_port(address: str, default_port: int) -> tuple[str, int]:
    """Split ``"host:port"`` or ``"host"``; DeviceError("address-wrong") otherwise.

    An IPv6 host stands in brackets, which may be left out where no port follows.
    """
    host, colon, port = address.rpartition(":")
    if not colon or address.endswith("]") or _is_ipv6(address):
        host, port = address, str(default_port)
    if host.startswith("[") and host.endswith("]") and _is_ipv6(host[1:-1]):
        host = host[1:-1]
    elif set("[]/ ") & set(host) or (":" in host and not _is_ipv6(address)):
        host = ""
    if not host or not (port.isascii() and port.isdigit() and 0 < int(port) < 65536):
        raise DeviceError(
            "address-wrong",
            what=f"The address {address!r} does not have the form host:port.",
            remedy=f'Write it in stage.toml like this: "192.168.0.20:{default_port}".',
        )
    return host, int(port)


def _is_ipv6(text: str) -> bool:
    with contextlib.suppress(ValueError):
        return ipaddress.ip_address(text).version == 6
    return False


def port_taken(name: str) -> DeviceBusy:
    """The error of a link that another program holds."""
    return DeviceBusy(
        "port-taken",
        what=f"{name} is in use by another program.",
        remedy="Stop that program (another velatura, a terminal, a modem manager) and start again.",
    )
