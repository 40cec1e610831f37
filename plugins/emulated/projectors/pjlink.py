"""An emulated network projector: PJLink class 1 and 2 over TCP.

Written from the PJLink specification on its own: it shares no parser with the driver, so that a common mistake would
show.
"""

from __future__ import annotations

import contextlib
import errno
import random
import socket
import threading
import time
from collections.abc import Callable, Iterator
from types import TracebackType
from typing import Final

from hal.errors import DeviceError
from plugins.emulated.faults import Faults
from plugins.emulated.projectors.lamp import EmulatedLamp, LampPhase
from plugins.emulated.projectors.pjlink_board import CR, REFUSAL, PasswordCheck, PjLinkBoard, PjLinkOddities
from plugins.emulated.scenario import ScenarioPlayer

_LONGEST: Final = 200
_TICK_S: Final = 0.05


class EmulatedPjLinkProjector:
    """A projector on loopback TCP. ``start`` and ``stop`` it, or use it in a ``with`` statement.

    Parameters
    ----------
    lamp : its lamp; the optical bench reads the same one
    port : TCP port, 0 for any free one (see ``address`` once started)
    password : asked of every client, or None
    idle_s : seconds after which an idle connection is closed (the specification says 30)
    chatty : it tells that it came up before it answers, and pads with NUL, as users report of some
    odd : in what it differs from the specification
    wedges_below_s : asked twice within this time while it warms or cools, it hangs: ``wedged`` is true for good

    ``heard``: the commands that it read, without their CR.

    ``faults`` are its knobs, ``scenario`` a script that turns them at what it hears; ``silent`` and ``slow_s`` hold for
    the greeting too.
    """

    def __init__(
        self,
        lamp: EmulatedLamp,
        *,
        port: int = 0,
        password: str | None = None,
        name: str = "emulated",
        idle_s: float = 30.0,
        seed: int = 1,
        chatty: bool = False,
        odd: PjLinkOddities | None = None,
        wedges_below_s: float = 0.0,
    ) -> None:
        self.lamp = lamp
        self.faults = Faults()
        self.scenario: ScenarioPlayer | None = None
        self._board = PjLinkBoard(lamp, name, odd)
        self.heard: list[bytes] = []
        self._board_lock = threading.Lock()
        self._wanted_port = port
        self._password = password
        self._idle_s = idle_s
        self._chatty = chatty
        self._wedges_below_s = wedges_below_s
        self._heard_at_s = 0.0
        self.wedged = False
        self._random = random.Random(seed)
        self._stop = threading.Event()
        self._listener: socket.socket | None = None
        self._threads: list[threading.Thread] = []

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

    def set_oddities(self, odd: PjLinkOddities) -> None:
        """Behave so from the next message on."""
        self._board.odd = odd

    def start(self) -> None:
        """Listen. Raises DeviceError("port-in-use") naming the port."""
        listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listener.bind(("127.0.0.1", self._wanted_port))
            listener.listen(8)
        except OSError as error:
            listener.close()
            raise _no_port(self._wanted_port, error) from error
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

    def __enter__(self) -> EmulatedPjLinkProjector:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    def _spawn(self, work: Callable[[socket.socket], None], on: socket.socket) -> None:
        self._threads = [thread for thread in self._threads if thread.is_alive()]
        thread = threading.Thread(target=work, args=(on,), name="pjlink projector", daemon=True)
        self._threads.append(thread)
        thread.start()

    def _accept(self, listener: socket.socket) -> None:
        while not self._stop.is_set():
            with contextlib.suppress(TimeoutError):
                client, _ = listener.accept()
                self._spawn(self._serve, client)

    def _serve(self, client: socket.socket) -> None:
        with client, contextlib.suppress(OSError):
            client.settimeout(_TICK_S)
            check = None if self._password is None else PasswordCheck(self._password, self._board.odd, self._random)
            self._send(
                client,
                self._board.odd.before
                + (check.greeting if check else self._board.odd.open_greeting + self._board.odd.ending),
            )
            for line in self._lines(client):
                if self.scenario is not None:
                    self.scenario.tick()
                    self.scenario.heard(len(line) + 1)
                if check is not None and not check.passed:
                    said = check.hears(line)
                    if said:
                        self._send(client, said)
                        if said == REFUSAL:
                            return
                        continue
                    line = check.command  # noqa: PLW2901 - the proof goes before the first command only
                self._wedge()
                self.heard.append(line)
                with self._board_lock:
                    answer = self._board.answer(line, busy=self.faults.now.busy)
                if self._board.odd.closes_unanswered == line[2:].decode("ascii", "replace"):
                    return
                if answer and not self.wedged:
                    self._send(client, b"%2LKUP=02:00:00:00:00:01\r\0\0" + answer if self._chatty else answer)
                    if self._board.odd.closes:
                        return

    def _wedge(self) -> None:
        now_s, before_s = time.monotonic(), self._heard_at_s
        self._heard_at_s = now_s
        occupied = self.lamp.phase in (LampPhase.WARMING, LampPhase.COOLING)
        self.wedged |= occupied and now_s - before_s < self._wedges_below_s

    def _lines(self, client: socket.socket) -> Iterator[bytes]:
        """Lines without their CR until the client goes, is idle too long, or sends a line that never ends."""
        buffer = bytearray()
        heard = time.monotonic()
        while not self._stop.is_set() and time.monotonic() - heard < self._idle_s and len(buffer) < _LONGEST:
            while (end := buffer.find(CR)) >= 0:
                line = bytes(buffer[:end])
                del buffer[: end + 1]
                yield line
            try:
                data = client.recv(1024)
            except TimeoutError:
                continue
            if not data:
                return
            heard = time.monotonic()
            buffer += data

    def _send(self, client: socket.socket, data: bytes) -> None:
        lost = self.faults.loses_this_one()
        carried, wait_s = self.faults.bent(data)
        if wait_s:
            self._stop.wait(wait_s)
        if not lost:
            client.sendall(carried)


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
