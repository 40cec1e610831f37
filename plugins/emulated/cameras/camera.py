"""An emulated camera on PTP/IP: two ports on loopback, one computer at a time, faults on request."""

from __future__ import annotations

import contextlib
import os
import socket
import struct
import threading
import time
import uuid
from typing import Final, Self

from hal.errors import DeviceError
from plugins.emulated.cameras.body import EmulatedBody
from plugins.emulated.cameras.wire import (
    CANCEL,
    EVENT,
    INIT_COMMAND,
    INIT_COMMAND_ACK,
    INIT_EVENT,
    INIT_EVENT_ACK,
    INIT_FAIL,
    PING,
    PONG,
    REQUEST,
    RESPONSE,
    Gone,
    PtpOutcome,
    receive,
    receive_data,
    send,
    send_data,
)
from plugins.emulated.core.servers import HOST, Switchable

_TAKEOVER_S: Final = 0.5


class PtpIpCamera(Switchable):
    """Serves ``body`` from ``start`` to ``stop``; also a context.

    ``ports``: for commands and events; 0 takes a free one; both the same non-zero number: one port for both, as real
    cameras do
    """

    def __init__(self, body: EmulatedBody, ports: tuple[int, int] = (0, 0)) -> None:
        self.body = body
        self.faults = body.faults
        body.on_event = self._send_event
        body.on_drop = self.drop_connection
        self._ports = ports
        self._listeners: list[socket.socket] = []
        self._lock = threading.Lock()
        self._command: socket.socket | None = None
        self._events: socket.socket | None = None
        self._connection = 0

    @property
    def address(self) -> str:
        """``ptpip:HOST:COMMANDPORT:EVENTPORT``, once started."""
        return f"ptpip:{HOST}:{self._ports[0]}:{self._ports[1]}"

    def start(self) -> Self:
        """Listen. Raises DeviceError("port-in-use")."""
        command = self._listen(self._ports[0])
        port = command.getsockname()[1]
        if self._ports[1] and self._ports[1] == self._ports[0]:
            self._ports = (port, port)
        else:
            late = self.faults.late_events_s > 0
            self._ports = (port, self._listen(self._ports[1], late=late).getsockname()[1])
        self.body.stopped.clear()
        for listener in self._listeners:
            threading.Thread(target=self._accept, args=(listener,), daemon=True).start()
        return self

    def stop(self) -> None:
        """Switch off: refuse connections and end the open one. ``start`` switches on again, with the same card."""
        self.body.stopped.set()
        for listener in self._listeners:
            _end(listener)
        self._listeners.clear()
        self.drop_connection()

    def drop_connection(self) -> None:
        """End the connection as a pulled cable does: without goodbye."""
        with self._lock:
            ending = (self._command, self._events)
        for connection in ending:
            if connection is not None:
                _end(connection)

    def _listen(self, port: int, *, late: bool = False) -> socket.socket:
        """``late``: the port is taken, but refuses connections until ``_open_late``."""
        listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listener.bind((HOST, port))
            if not late:
                listener.listen()
        except OSError as error:
            listener.close()
            self.stop()
            raise DeviceError(
                "port-in-use",
                what=f"The emulated camera can't use port {port} on {HOST}: {error.strerror}.",
                remedy="End the program that uses it, or give the camera another port (0 chooses a free one).",
            ) from error
        self._listeners.append(listener)
        return listener

    def _open_late(self) -> None:
        if not self.body.stopped.wait(self.faults.late_events_s):
            with contextlib.suppress(OSError, IndexError):
                self._listeners[1].listen()

    def _accept(self, listener: socket.socket) -> None:
        while not listener.getsockopt(socket.SOL_SOCKET, socket.SO_ACCEPTCONN):
            if self.body.stopped.wait(0.01):
                return
        while True:
            try:
                connection, _ = listener.accept()
            except OSError:
                return
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            threading.Thread(target=self._welcome, args=(connection,), daemon=True).start()

    def _welcome(self, connection: socket.socket) -> None:
        """The first packet says which of the two connections this is."""
        with contextlib.suppress(Gone, struct.error), contextlib.closing(connection):
            kind, body = receive(connection)
            if kind == INIT_COMMAND:
                self._serve_commands(connection)
            elif kind == INIT_EVENT and struct.unpack_from("<I", body)[0] == self._connection:
                self._serve_events(connection)
            else:
                send(connection, INIT_FAIL, struct.pack("<I", 1))

    def _serve_commands(self, connection: socket.socket) -> None:
        if not self._take_over(connection):
            send(connection, INIT_FAIL, struct.pack("<I", 2))
            return
        if self.faults.late_events_s > 0:
            threading.Thread(target=self._open_late, daemon=True).start()
        try:
            guid = uuid.uuid5(uuid.NAMESPACE_OID, self.body.names.serial).bytes
            name = (self.body.names.model + "\0").encode("utf-16-le")
            send(connection, INIT_COMMAND_ACK, struct.pack("<I", self._connection) + guid + name + b"\0\0\1\0")
            while True:
                self._serve_request(connection)
        finally:
            with self._lock:
                events, self._command, self._events = self._events, None, None
            self.body.disconnected()
            if events is not None:
                _end(events)

    def _take_over(self, connection: socket.socket) -> bool:
        """One computer at a time; one that has just left may take a moment to be noticed."""
        until = time.monotonic() + _TAKEOVER_S
        while True:
            with self._lock:
                if self._command is None:
                    self._command = connection
                    self._connection += 1
                    return True
            if time.monotonic() > until:
                return False
            time.sleep(0.01)

    def _serve_events(self, connection: socket.socket) -> None:
        with self._lock:
            self._events = connection
        send(connection, INIT_EVENT_ACK)
        while True:
            if receive(connection)[0] == PING:
                send(connection, PONG)

    def _serve_request(self, connection: socket.socket) -> None:
        kind, body = receive(connection)
        if kind == PING:
            send(connection, PONG)
        if kind in (PING, PONG, CANCEL):
            return
        if kind != REQUEST:
            raise Gone
        phase, code, transaction = struct.unpack_from("<IHI", body)
        parameters = struct.unpack_from(f"<{(len(body) - 10) // 4}I", body, 10)
        data = receive_data(connection) if phase == 2 else b""
        self._hold_back()
        if self.faults.take("garbage"):
            connection.sendall(os.urandom(64))
            return
        self._reply(connection, transaction, self.body.answer(code, parameters, data))

    def _hold_back(self) -> None:
        """Slow and silent cameras; a silent one continues once it may answer again."""
        if self.faults.slow_s:
            self.body.stopped.wait(self.faults.slow_s)
        while self.faults.silent and not self.body.stopped.is_set():
            time.sleep(0.01)

    def _reply(self, connection: socket.socket, transaction: int, outcome: PtpOutcome) -> None:
        if outcome.data is not None:
            large = len(outcome.data) > 1000
            wrong = 7 if large and self.faults.take("wrong_lengths") else 0
            if large and self.faults.take("drop_in_transfer"):
                half = outcome.data[: len(outcome.data) // 2]
                send_data(connection, transaction, half, announce=len(outcome.data))
                raise Gone
            send_data(connection, transaction, outcome.data, announce=len(outcome.data) + wrong)
        answer = struct.pack(f"<HI{len(outcome.parameters)}I", outcome.code, transaction, *outcome.parameters)
        send(connection, RESPONSE, answer)

    def _send_event(self, code: int, parameters: tuple[int, ...]) -> None:
        with self._lock:
            events = self._events
        if events is not None:
            with contextlib.suppress(Gone):
                send(events, EVENT, struct.pack(f"<HI{len(parameters)}I", code, 0, *parameters))


def _end(connection: socket.socket) -> None:
    """Close a socket that another thread may be waiting on."""
    with contextlib.suppress(OSError):
        connection.shutdown(socket.SHUT_RDWR)
    connection.close()
