"""What emulated devices have in common as servers: a thread of their own, a TCP port."""

from __future__ import annotations

import contextlib
import errno
import socket
import threading
from abc import abstractmethod
from collections.abc import Callable
from typing import Final

from hal.errors import DeviceError
from plugins.emulated.core.servers import HOST, Switchable

_TICK_S: Final = 0.02


class BackgroundDevice(Switchable):
    """Works in a thread of its own from ``start`` to ``stop``."""

    def __init__(self) -> None:
        self._stopped = threading.Event()
        self._thread: threading.Thread | None = None

    @abstractmethod
    def _run(self) -> None:
        """Work until ``_stopped`` is set."""

    def start(self) -> None:
        """Begin to work."""
        self._stopped.clear()
        self._thread = threading.Thread(target=self._run, name=type(self).__name__, daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End the work."""
        self._stopped.set()
        if self._thread is not None:
            self._thread.join(timeout=2.0)
            self._thread = None


class TcpServer(Switchable):
    """Listens on ``port``, 0 for any free one (see ``address`` once started), and serves each client in a thread."""

    def __init__(self, port: int = 0) -> None:
        self._port = port
        self._stopped = threading.Event()
        self._listener: socket.socket | None = None
        self._threads: list[threading.Thread] = []

    @abstractmethod
    def _serve(self, client: socket.socket) -> None:
        """Talk to a client until it goes or ``_stopped`` is set; closes it."""

    @property
    def address(self) -> str:
        """``127.0.0.1:port``, once started."""
        if self._listener is None:
            raise DeviceError(
                "emulator-not-started",
                what="The emulated device has no address before it starts.",
                remedy="Start it first.",
            )
        return f"{HOST}:{self._port}"

    def start(self) -> None:
        """Listen. Raises DeviceError("port-in-use" or "port-not-opened") naming the port."""
        try:
            listener = socket.create_server((HOST, self._port))
        except OSError as error:
            raise _no_port(self._port, error) from error
        self._port = listener.getsockname()[1]
        listener.settimeout(_TICK_S)
        self._stopped.clear()
        self._listener = listener
        self._spawn(self._accept, listener)

    def stop(self) -> None:
        """Close every connection and end. ``start`` opens the same port again."""
        self._stopped.set()
        for thread in self._threads:
            thread.join(timeout=2.0)
        self._threads.clear()
        if self._listener is not None:
            self._listener.close()
            self._listener = None

    def _accept(self, listener: socket.socket) -> None:
        while not self._stopped.is_set():
            self._tick()
            with contextlib.suppress(TimeoutError):
                client, _ = listener.accept()
                self._accepted(client)

    def _tick(self) -> None:
        """Hook: called often while it listens."""

    def _accepted(self, client: socket.socket) -> None:
        self._spawn(self._serve, client)

    def _spawn(self, work: Callable[[socket.socket], None], on: socket.socket) -> None:
        self._threads = [thread for thread in self._threads if thread.is_alive()]
        thread = threading.Thread(target=work, args=(on,), name=type(self).__name__, daemon=True)
        self._threads.append(thread)
        thread.start()


def _no_port(port: int, error: OSError) -> DeviceError:
    if error.errno == errno.EADDRINUSE:
        return DeviceError(
            "port-in-use",
            what=f"TCP port {port} is in use by another program.",
            remedy=f"Stop that program (ss -ltnp | grep {port} names it), or choose another port.",
        )
    return DeviceError(
        "port-not-opened",
        what=f"TCP port {port} could not be opened: {error.strerror}.",
        remedy="Choose a port of 1024 or above.",
    )
