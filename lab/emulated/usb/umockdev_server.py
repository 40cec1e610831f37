"""Device nodes for programs under Debian's umockdev preload library: a server of its socket protocol.

Such a program finds ``/dev`` and ``/sys`` under the folder in ``$UMOCKDEV_DIR``. A device node there is a symlink to a
pty, so that the program's ``poll`` works; every ``ioctl``, ``read`` and ``write`` on it is sent as a message of three
64-bit numbers to the unix socket ``ioctl/<node>`` beside it, which may look into the program's memory before it says
what the call returns (libumockdev-preload.c of umockdev 0.17.16). The other end must be another process.
"""

from __future__ import annotations

import contextlib
import errno
import os
import socket
import struct
import termios
import threading
import tty
from collections.abc import Callable
from pathlib import Path
from typing import Final, Protocol, Self

_IOCTL, _READ, _WRITE = 1, 7, 8
_DONE, _PEEK, _POKE = 3, 5, 6
_MESSAGE: Final = struct.Struct("<QQQ")
_FAILED: Final = (1 << 64) - 1
_LONGEST_SOCKET_PATH: Final = 107
_LINGER_S: Final = 1.0
_LARGEST: Final = 16 << 20
"""Bytes of a program's memory that one call may touch."""


class CallFailed(Exception):
    """The call returns -1 with this ``errno``."""

    def __init__(self, number: int) -> None:
        super().__init__(os.strerror(number))
        self.number = number


class Memory:
    """The calling program's memory, while its call waits for the answer."""

    def __init__(self, connection: socket.socket) -> None:
        self._connection = connection

    def peek(self, address: int, count: int) -> bytes:
        """Read ``count`` bytes. Raises CallFailed(EFAULT) for null, CallFailed(EINVAL) above 16 MiB."""
        self._check(address, count)
        if count == 0:
            return b""
        self._connection.sendall(_MESSAGE.pack(_PEEK, address, count))
        return _exactly(self._connection, count)

    def poke(self, address: int, data: bytes | memoryview) -> None:
        """Write ``data``. Raises as ``peek`` does."""
        self._check(address, len(data))
        if len(data):
            self._connection.sendall(_MESSAGE.pack(_POKE, address, len(data)))
            self._connection.sendall(data)

    def _check(self, address: int, count: int) -> None:
        if address == 0:
            raise CallFailed(errno.EFAULT)
        if not 0 <= count <= _LARGEST:
            raise CallFailed(errno.EINVAL)


class OpenFile(Protocol):
    """What one ``open`` of a node leads to; called by one thread at a time, except ``closed`` which comes last.

    Each call returns what the program's call returns, or raises CallFailed.
    """

    def ioctl(self, request: int, argument: int, memory: Memory) -> int: ...

    def read(self, address: int, count: int, memory: Memory) -> int: ...

    def write(self, address: int, count: int, memory: Memory) -> int: ...

    def closed(self) -> None: ...


class Node:
    """One device node: its pty decides what ``poll`` says, its socket takes the calls. Made by ``UmockdevServer``."""

    def __init__(self, device: Path, listener: socket.socket, opened: Callable[[], OpenFile]) -> None:
        self._device = device
        self._listener = listener
        self._opened = opened
        self._lock = threading.Lock()
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        self._rung = False
        self._stopped = False
        self._alive = True
        device.parent.mkdir(parents=True, exist_ok=True)
        device.symlink_to(os.ttyname(self._slave))
        self.number = os.fstat(self._slave).st_rdev
        """The pty's device number as ``fstat`` returns it to the program."""
        threading.Thread(target=self._accept, daemon=True).start()

    def set_writable(self, writable: bool) -> None:
        """Whether ``poll`` says POLLOUT, which usbfs uses for "something has completed"."""
        with self._lock:
            if self._alive and self._stopped is writable:
                termios.tcflow(self._slave, termios.TCOON if writable else termios.TCOOFF)
                self._stopped = not writable

    def set_readable(self, readable: bool) -> None:
        """Whether ``poll`` says POLLIN."""
        with self._lock:
            if not self._alive or self._rung is readable:
                return
            if readable:
                os.write(self._master, b"!")
            else:
                termios.tcflush(self._slave, termios.TCIFLUSH)
            self._rung = readable

    def remove(self) -> None:
        """Take the node away; who has it open sees POLLERR and POLLHUP, and may still make calls."""
        with self._lock:
            if not self._alive:
                return
            self._alive = False
            self._device.unlink(missing_ok=True)
            os.close(self._master)
            os.close(self._slave)
        # Not yet: the preload library ends a program that is just opening the node and finds no socket.
        hang_up = threading.Timer(_LINGER_S, self.hang_up)
        hang_up.daemon = True
        hang_up.start()

    def hang_up(self) -> None:
        """Accept no further program; after ``remove``."""
        with self._lock:
            if self._listener.fileno() < 0:
                return
            Path(self._listener.getsockname()).unlink(missing_ok=True)
            with contextlib.suppress(OSError):
                self._listener.shutdown(socket.SHUT_RDWR)
            self._listener.close()

    def _accept(self) -> None:
        while True:
            try:
                connection, _ = self._listener.accept()
            except OSError:
                return
            threading.Thread(target=self._serve, args=(connection,), daemon=True).start()

    def _serve(self, connection: socket.socket) -> None:
        file = self._opened()
        memory = Memory(connection)
        try:
            with contextlib.closing(connection):
                while True:
                    self._call(connection, memory, file)
        except OSError:
            pass  # the program closed the file, or ended
        finally:
            file.closed()

    def _call(self, connection: socket.socket, memory: Memory, file: OpenFile) -> None:
        kind, first, second = _MESSAGE.unpack(_exactly(connection, _MESSAGE.size))
        try:
            if kind == _IOCTL:
                result = file.ioctl(first, second, memory)
            elif kind == _READ:
                result = file.read(first, second, memory)
            elif kind == _WRITE:
                result = file.write(first, second, memory)
            else:
                raise ConnectionError
        except CallFailed as failure:
            connection.sendall(_MESSAGE.pack(_DONE, _FAILED, failure.number))
        else:
            connection.sendall(_MESSAGE.pack(_DONE, result, 0))


class UmockdevServer:
    """Serves nodes under ``folder``, the program's ``$UMOCKDEV_DIR``; also a context.

    The folder's path must be short: a unix socket's path has at most 107 bytes. Raises ValueError where it is not.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._nodes: list[Node] = []

    def add(self, node: str, opened: Callable[[], OpenFile], *, number: tuple[int, int] | None = None) -> Node:
        """Serve ``node``, e.g. ``/dev/hidraw0``; ``number``: major and minor that ``stat`` shows, else its pty's."""
        place = self.folder / "ioctl" / node.lstrip("/")
        if len(os.fsencode(place)) + 1 > _LONGEST_SOCKET_PATH:
            raise ValueError(f"the path of the socket {place} is too long")
        place.parent.mkdir(parents=True, exist_ok=True)
        listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        listener.bind(os.fspath(place))
        listener.listen()
        # The socket first: the preload library ends a program that finds a node without one.
        made = Node(self.folder / node.lstrip("/"), listener, opened)
        major, minor = number or (os.major(made.number), os.minor(made.number))
        shown = self.folder / "dev" / ".node" / node.removeprefix("/dev/").replace("/", "_")
        shown.parent.mkdir(parents=True, exist_ok=True)
        shown.unlink(missing_ok=True)
        shown.symlink_to(f"{major}:{minor}")
        self._nodes.append(made)
        return made

    def close(self) -> None:
        for node in self._nodes:
            node.remove()
            node.hang_up()
        self._nodes.clear()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _exactly(connection: socket.socket, count: int) -> bytes:
    """``count`` bytes. Raises ConnectionError at the end of the connection."""
    data = bytearray(count)
    view = memoryview(data)
    while view:
        got = connection.recv_into(view)
        if got == 0:
            raise ConnectionError
        view = view[got:]
    return bytes(data)
