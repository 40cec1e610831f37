"""The player's unix socket: lines in, lines out, never blocking the loop that owns it."""

from __future__ import annotations

import contextlib
import os
import select
import signal
import socket
import stat
from pathlib import Path
from typing import Final, Self

from controller.core.errors import UsageError, WorkError
from controller.core.storage import LONGEST_PATH_BYTES, exclusive, listening
from controller.play.control.protocol import MAX_LINE_BYTES, InvalidRequest
from hal.codecs.player import error_line

MAX_CLIENTS: Final = 16
_BACKLOG: Final = 64
_MAX_UNSENT_BYTES: Final = 1024 * 1024
_RECEIVE_BYTES: Final = 64 * 1024


class Client:
    """One connection: what came in and is not yet a line, and what could not yet be sent."""

    def __init__(self, connection: socket.socket) -> None:
        self.connection = connection
        self.received = bytearray()
        self.unsent = bytearray()
        self.closing = False
        self.drained_bytes = 0

    def fileno(self) -> int:
        return self.connection.fileno()


class Server:
    """Listens on a unix stream socket of mode 0600; a stale one of a dead player is replaced.

    Use as a context manager. ``wake`` may be called from any thread, and signals wake ``poll`` too.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._clients: list[Client] = []
        self._stack = contextlib.ExitStack()

    def __enter__(self) -> Self:
        if len(os.fsencode(self.path)) > LONGEST_PATH_BYTES:
            raise UsageError(
                "socket-path-long",
                what=f"The socket's path {self.path} is longer than {LONGEST_PATH_BYTES} bytes.",
                remedy="Use a shorter path, for instance below /run.",
            )
        with self._stack as stack:
            lock = self.path.with_name(self.path.name + ".lock")
            stack.enter_context(exclusive(lock, what_is_running="A player"))
            self._listener = stack.enter_context(self._bound())
            stack.callback(self.path.unlink, missing_ok=True)
            self._woken, self._waker = (stack.enter_context(end) for end in socket.socketpair())
            for end in (self._listener, self._woken, self._waker):
                end.setblocking(False)
            before = signal.set_wakeup_fd(self._waker.fileno(), warn_on_full_buffer=False)
            stack.callback(signal.set_wakeup_fd, before)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        for client in self._clients:
            client.connection.close()
        self._stack.close()

    def _bound(self) -> socket.socket:
        # The lock is ours, so whatever socket lies here belongs to a player that is dead.
        with contextlib.suppress(FileNotFoundError):
            if not stat.S_ISSOCK(self.path.lstat().st_mode):
                raise UsageError(
                    "socket-path-taken",
                    what=f"{self.path} already exists and is not a socket.",
                    remedy="Remove it, or give the player another path.",
                )
        try:
            return listening(self.path, _BACKLOG)
        except OSError as error:
            raise WorkError(
                "socket-not-made",
                what=f"The socket {self.path} could not be created: {error.strerror}.",
                remedy="Check that its folder exists and that you may write to it.",
            ) from error

    def wake(self) -> None:
        """End a ``poll`` that is waiting, now. A full pipe means that it is ending already."""
        with contextlib.suppress(OSError):
            self._waker.send(b"\0")

    def poll(self, timeout_s: float) -> list[tuple[Client, bytes]]:
        """Move bytes for at most ``timeout_s`` seconds; return at the first event, with the whole lines that came."""
        sources: list[socket.socket | Client] = [self._listener, self._woken, *self._clients]
        unsent = [client for client in self._clients if client.unsent]
        readable, writable, _ = select.select(sources, unsent, [], max(0.0, timeout_s))
        lines = []
        for source in readable:
            if isinstance(source, Client):
                lines += [(source, line) for line in self._receive(source)]
            elif source is self._listener:
                self._accept()
            else:
                with contextlib.suppress(BlockingIOError):
                    self._woken.recv(_RECEIVE_BYTES)
        for client in writable:
            self._flush(client)
        return lines

    def send(self, client: Client, line: bytes) -> None:
        """Send an answer, now or when the client takes it; one that has gone is forgotten."""
        if client in self._clients:
            client.unsent += line
            self._flush(client)

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            connection, _ = self._listener.accept()
            connection.setblocking(False)
            if len(self._clients) < MAX_CLIENTS:
                self._clients.append(Client(connection))
                return
            full = UsageError(
                "player-busy",
                what=f"The player already serves {MAX_CLIENTS} connections.",
                remedy="Close one of them first.",
            )
            with connection:
                connection.send(error_line(None, full))

    def _receive(self, client: Client) -> list[bytes]:
        try:
            data = client.connection.recv(_RECEIVE_BYTES)
        except BlockingIOError:
            return []
        except OSError:
            data = b""
        if not data:
            self._drop(client)
            return []
        if client.closing:
            # Closing with bytes unread would reset the connection before our last line is read.
            client.drained_bytes += len(data)
            if client.drained_bytes > _MAX_UNSENT_BYTES:
                self._drop(client)
            return []
        client.received += data
        *lines, rest = client.received.split(b"\n")
        client.received = rest
        if len(rest) > MAX_LINE_BYTES or any(len(line) > MAX_LINE_BYTES for line in lines):
            self._end(client, error_line(None, InvalidRequest(None, f"the line is longer than {MAX_LINE_BYTES} bytes")))
            return []
        return [bytes(line) for line in lines if line.strip()]

    def _end(self, client: Client, last_line: bytes) -> None:
        client.closing = True
        client.received.clear()
        self.send(client, last_line)

    def _flush(self, client: Client) -> None:
        try:
            sent = client.connection.send(client.unsent)
            del client.unsent[:sent]
        except BlockingIOError:
            pass
        except OSError:
            self._drop(client)
            return
        if len(client.unsent) > _MAX_UNSENT_BYTES:
            self._drop(client)
        elif client.closing and not client.unsent:
            with contextlib.suppress(OSError):
                client.connection.shutdown(socket.SHUT_WR)

    def _drop(self, client: Client) -> None:
        if client in self._clients:
            self._clients.remove(client)
        client.connection.close()
