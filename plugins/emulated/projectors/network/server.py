"""An emulated projector on its own LAN port: a control board behind TCP, with the login of its family."""

from __future__ import annotations

import contextlib
import copy
import random
import select
import socket
import threading
import time
from collections.abc import Callable
from typing import Final

from plugins.emulated.projectors.lamp import EmulatedLamp
from plugins.emulated.projectors.network.gates import Gate, OpenGate
from plugins.emulated.projectors.serial import Board
from plugins.emulated.projectors.tcp_projector import TcpProjector

_TICK_S: Final = 0.02


class EmulatedNetworkProjector(TcpProjector):
    """A projector on loopback TCP. ``start`` and ``stop`` it, or use it in a ``with`` statement.

    Parameters
    ----------
    lamp : its lamp; the optical bench reads the same one
    board : what it does with commands
    port : TCP port, 0 for any free one (see ``address`` once started)
    gate : makes what comes before the commands, for each connection
    password : of the login; "" for none
    wedges_below_s : spoken to twice within this time while it warms or cools, it hangs until its mains were cut
    boot_s : from mains on until it answers

    ``faults`` are its knobs, ``scenario`` a script that turns them. ``connections`` counts those that were accepted.
    """

    def __init__(
        self,
        lamp: EmulatedLamp,
        board: Board,
        *,
        port: int = 0,
        gate: Callable[[str, random.Random], Gate] = OpenGate,
        password: str = "",
        wedges_below_s: float = 0.0,
        boot_s: float = 0.0,
        seed: int = 1,
    ) -> None:
        super().__init__(lamp, port=port, wedges_below_s=wedges_below_s)
        self.connections = 0
        self._board = board
        self._new_board = self._copied(board)
        self._gate = gate
        self._password = password
        self._random = random.Random(seed)
        self._boot_s = boot_s
        self._awake_at_s: float | None = time.monotonic()
        self._board_turn = threading.Lock()
        self._clients: set[socket.socket] = set()

    def unplug(self) -> None:
        """Pull the network cable: connections end, and none is accepted. The projector itself goes on."""
        self.stop()

    def replug(self) -> None:
        """Plug it in again, at the same port."""
        if self._listener is None:
            self.start()

    def hang_up(self) -> None:
        """Close every connection, as a projector does that is silent for a while; new ones are accepted."""
        for client in tuple(self._clients):
            with contextlib.suppress(OSError):
                client.shutdown(socket.SHUT_RDWR)

    def cut_mains(self) -> None:
        """The projector is dead, and its network with it. See ``lamp.damages``."""
        self._awake_at_s = None
        self.lamp.cut_mains()
        self.hang_up()

    def restore_mains(self) -> None:
        """It boots for ``boot_s`` into standby, and has forgotten whatever it had heard."""
        if self._awake_at_s is None:
            self.wedged = False
            self._board = self._copied(self._new_board)
            self.lamp.restore_mains()
            self._awake_at_s = time.monotonic() + self._boot_s

    def power_cycle(self) -> None:
        """Pull the mains plug and put it back: a hanging control board restarts."""
        self.cut_mains()
        self.restore_mains()

    @property
    def awake(self) -> bool:
        """Whether it has mains, and has booted."""
        awake_at_s = self._awake_at_s
        return awake_at_s is not None and time.monotonic() >= awake_at_s

    def _copied(self, board: Board) -> Board:
        return copy.deepcopy(board, {id(self.lamp): self.lamp})

    def _tick(self) -> None:
        if self.scenario is not None:
            self.scenario.tick()

    def _accepted(self, client: socket.socket) -> None:
        self.connections += 1
        if self.awake:
            self._clients.add(client)
            super()._accepted(client)
        else:
            client.close()

    def _serve(self, client: socket.socket) -> None:
        gate = self._gate(self._password, self._random)
        with client, contextlib.suppress(OSError):
            if gate.greeting and not self.faults.now.silent:
                client.sendall(gate.greeting)
            while not self._stop.is_set() and self.awake:
                readable, _, _ = select.select([client], [], [], _TICK_S)
                data = client.recv(4096) if readable else b""
                if readable and not data:
                    break
                if not self._turn(client, gate, data):
                    break
        self._clients.discard(client)

    def _turn(self, client: socket.socket, gate: Gate, data: bytes) -> bool:
        """Act on what arrived; False: the connection ends."""
        heard = gate.hear(data) if data else None
        if heard is not None and heard.say:
            client.sendall(heard.say)
        if heard is not None and heard.close:
            return False
        answered = False
        with self._board_turn:
            answers = self._board.notices()
            if heard is not None and heard.commands:
                if self.scenario is not None:
                    self.scenario.heard(len(heard.commands))
                self._hang_if_too_soon()
                answers = [*answers, *self._board.feed(heard.commands, busy=self.faults.now.busy)]
        for answer in answers:
            answered = True
            if not self.faults.loses_this_one() and not self.wedged:
                carried, wait_s = self.faults.bent(gate.answer(answer))
                self._stop.wait(wait_s)
                client.sendall(carried)
        return not (answered and gate.closes)
