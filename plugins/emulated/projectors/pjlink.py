"""An emulated network projector: PJLink class 1 and 2 over TCP.

Written from the PJLink specification on its own: it shares no parser with the driver, so that a common mistake would
show.
"""

from __future__ import annotations

import contextlib
import random
import socket
import threading
import time
from collections.abc import Iterator
from typing import Final

from plugins.emulated.projectors.lamp import EmulatedLamp
from plugins.emulated.projectors.pjlink_board import CR, REFUSAL, PasswordCheck, PjLinkBoard, PjLinkOddities
from plugins.emulated.projectors.tcp_projector import TcpProjector

_LONGEST: Final = 200
_TICK_S: Final = 0.05


class EmulatedPjLinkProjector(TcpProjector):
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
        super().__init__(lamp, port=port, wedges_below_s=wedges_below_s)
        self._board = PjLinkBoard(lamp, name, odd)
        self.heard: list[bytes] = []
        self._board_lock = threading.Lock()
        self._password = password
        self._idle_s = idle_s
        self._chatty = chatty
        self._random = random.Random(seed)

    def set_oddities(self, odd: PjLinkOddities) -> None:
        """Behave so from the next message on."""
        self._board.odd = odd

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
                self._hang_if_too_soon()
                self.heard.append(line)
                with self._board_lock:
                    answer = self._board.answer(line, busy=self.faults.now.busy)
                if self._board.odd.closes_unanswered == line[2:].decode("ascii", "replace"):
                    return
                if answer and not self.wedged:
                    self._send(client, b"%2LKUP=02:00:00:00:00:01\r\0\0" + answer if self._chatty else answer)
                    if self._board.odd.closes:
                        return

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
