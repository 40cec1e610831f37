"""TCP to a PTP/IP camera: addresses, and sockets with deadlines and cancellation."""

from __future__ import annotations

import contextlib
import select
import socket
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Final, Self

from hal.deadline import SLICE_S, Deadline
from hal.errors import PluginError
from hal.tcp import connected
from plugins.ptp.link import camera_lost, camera_off

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
