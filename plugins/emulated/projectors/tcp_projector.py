"""What emulated projectors on loopback TCP share: they listen, serve each client in a thread, and may hang."""

from __future__ import annotations

import contextlib
import errno
import socket
import threading
import time
from abc import abstractmethod
from collections.abc import Callable
from typing import Final

from hal.errors import DeviceError
from plugins.emulated.faults import Faults
from plugins.emulated.projectors.lamp import EmulatedLamp, LampPhase
from plugins.emulated.scenario import ScenarioPlayer
from plugins.emulated.switched import Switched

_TICK_S: Final = 0.02


class TcpProjector(Switched):
    """Listens on ``port``, 0 for any free one (see ``address`` once started).

    ``wedges_below_s``: asked twice within this time while its lamp warms or cools, it hangs: ``wedged`` is true.
    ``faults`` are its knobs, ``scenario`` a script that turns them.
    """

    def __init__(self, lamp: EmulatedLamp, *, port: int, wedges_below_s: float) -> None:
        self.lamp = lamp
        self.faults = Faults()
        self.scenario: ScenarioPlayer | None = None
        self.wedged = False
        self._wanted_port = port
        self._wedges_below_s = wedges_below_s
        self._heard_at_s = 0.0
        self._stop = threading.Event()
        self._listener: socket.socket | None = None
        self._threads: list[threading.Thread] = []

    @abstractmethod
    def _serve(self, client: socket.socket) -> None:
        """Talk to a client until it goes or ``_stop`` is set; closes it."""

    @property
    def address(self) -> str:
        """``127.0.0.1:port``, once started."""
        if self._listener is None:
            raise DeviceError(
                "emulator-not-started",
                what="The emulated projector has no address before it starts.",
                remedy="Start it first.",
            )
        return "{}:{}".format(*self._listener.getsockname()[:2])

    def start(self) -> None:
        """Listen. Raises DeviceError("port-in-use" or "port-not-opened") naming the port."""
        try:
            listener = socket.create_server(("127.0.0.1", self._wanted_port))
        except OSError as error:
            raise _no_port(self._wanted_port, error) from error
        self._wanted_port = listener.getsockname()[1]
        listener.settimeout(_TICK_S)
        self._stop.clear()
        self._listener = listener
        self._spawn(self._accept, listener)

    def stop(self) -> None:
        """Close every connection and end. Harmless when called twice."""
        self._stop.set()
        for thread in self._threads:
            thread.join(timeout=2.0)
        self._threads.clear()
        if self._listener is not None:
            self._listener.close()
            self._listener = None

    def _accept(self, listener: socket.socket) -> None:
        while not self._stop.is_set():
            self._tick()
            with contextlib.suppress(TimeoutError):
                client, _ = listener.accept()
                self._accepted(client)

    def _tick(self) -> None:
        """Called often while it listens."""

    def _accepted(self, client: socket.socket) -> None:
        self._spawn(self._serve, client)

    def _spawn(self, work: Callable[[socket.socket], None], on: socket.socket) -> None:
        self._threads = [thread for thread in self._threads if thread.is_alive()]
        thread = threading.Thread(target=work, args=(on,), name=type(self).__name__, daemon=True)
        self._threads.append(thread)
        thread.start()

    def _hang_if_too_soon(self) -> None:
        """Hang if a command follows the last one too soon, while the control board is busy with the lamp."""
        now_s, before_s = time.monotonic(), self._heard_at_s
        self._heard_at_s = now_s
        busy = self.lamp.phase in (LampPhase.WARMING, LampPhase.COOLING)
        self.wedged |= busy and now_s - before_s < self._wedges_below_s


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
