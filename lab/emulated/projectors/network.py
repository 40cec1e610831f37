"""An emulated projector on its own LAN port: a control board behind TCP, with the login of its family.

The logins are written from the makers' documents (docs/reference/projectors.md) and share no parser with the driver, so
that a common mistake would show.
"""

from __future__ import annotations

import contextlib
import hashlib
import random
import select
import socket
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final, Protocol

from lab.emulated.servers import TcpServer
from plugins.emulated.projectors.board import Board
from plugins.emulated.projectors.lamp import EmulatedLamp
from plugins.emulated.projectors.projector import BoardProjector

_TICK_S: Final = 0.02


@dataclass(frozen=True, slots=True)
class Heard:
    """What received bytes lead to: ``say`` back at once, ``commands`` for the board, ``close`` the connection."""

    say: bytes = b""
    commands: bytes = b""
    close: bool = False


class Gate(Protocol):
    """``greeting`` is sent first; ``closes``: the connection ends after each answer."""

    greeting: bytes
    closes: bool

    def hear(self, data: bytes) -> Heard: ...

    def answer(self, reply: bytes) -> bytes:
        """An answer of the board as it goes out."""


class OpenGate:
    """Commands at once, as on the serial line."""

    greeting = b""
    closes = False

    def __init__(self, password: str = "", source: random.Random | None = None) -> None:
        self._password = password
        self._source = source or random.Random()
        self._passed = False
        self._kept = bytearray()

    def hear(self, data: bytes) -> Heard:
        return Heard(commands=data)

    def answer(self, reply: bytes) -> bytes:
        return reply


class EscVpNetGate(OpenGate):
    """Epson: 16 bytes of CONNECT with any number of headers of 18; 0x20 accepts."""

    def hear(self, data: bytes) -> Heard:
        if self._passed:
            return Heard(commands=data)
        self._kept += data
        if len(self._kept) < 16 or len(self._kept) < 16 + 18 * self._kept[15]:
            return Heard()
        head, count = bytes(self._kept[:16]), self._kept[15]
        headers = [bytes(self._kept[16 + 18 * n : 34 + 18 * n]) for n in range(count)]
        rest = bytes(self._kept[16 + 18 * count :])
        if head[:12] != b"ESC/VP.net\x10\x03":
            return Heard(b"ESC/VP.net\x10\x03\0\0\x40\0", close=True)
        passwords = [header[2:].rstrip(b"\0") for header in headers if header[:1] == b"\x01"]
        if self._password and not passwords:
            return Heard(b"ESC/VP.net\x10\x03\0\0\x41\0", close=True)
        if self._password and passwords[0] != self._password.encode():
            return Heard(b"ESC/VP.net\x10\x03\0\0\x43\0", close=True)
        self._passed = True
        return Heard(b"ESC/VP.net\x10\x03\0\0\x20\0", rest)


class NtControlGate(OpenGate):
    """Panasonic: each command has the digest of account, password and random text before it; closes by default."""

    closes = True
    digest = "md5"

    def __init__(self, password: str = "", source: random.Random | None = None) -> None:
        super().__init__(password, source)
        salt = f"{self._source.getrandbits(32):08x}"
        number = {"md5": 1, "sha256": 2}[self.digest]
        self.greeting = f"NTCONTROL {number} {salt}\r".encode() if password else b"NTCONTROL 0\r"
        secret = f"admin1:{password}:{salt}".encode()
        self._proof = hashlib.new(self.digest, secret).hexdigest().encode() if password else b""

    def hear(self, data: bytes) -> Heard:
        self._kept += data
        line, end, rest = bytes(self._kept).partition(b"\r")
        if not end:
            return Heard()
        self._kept[:] = rest
        if not line.startswith(self._proof + b"00"):
            return Heard(b"ERRA\r" if self._proof else b"ERR1\r", close=True)
        return Heard(commands=b"\x02ADZZ;" + line[len(self._proof) + 2 :] + b"\x03")

    def answer(self, reply: bytes) -> bytes:
        body = reply.strip(b"\x02\x03")
        if body.startswith(b"ER"):
            return {b"ER401": b"ERR3", b"ER402": b"ERR2"}.get(body, b"ERR1") + b"\r"
        return b"00" + body + b"\r"


class NtControlSha256Gate(NtControlGate):
    """The same with SHA-256, as later models may be set to."""

    digest = "sha256"


class AdcpGate(OpenGate):
    """Sony: a random text, answered by the SHA-256 of it and the password; ``NOKEY`` without one."""

    def __init__(self, password: str = "", source: random.Random | None = None) -> None:
        super().__init__(password, source)
        salt = f"{self._source.getrandbits(32):08x}"
        self.greeting = f"{salt}\r\n".encode() if password else b"NOKEY\r\n"
        self._proof = hashlib.sha256((salt + password).encode()).hexdigest().encode() if password else b""
        self._passed = not password

    def hear(self, data: bytes) -> Heard:
        if self._passed:
            return Heard(commands=data)
        self._kept += data
        line, end, rest = bytes(self._kept).partition(b"\r\n")
        if not end:
            return Heard()
        if line.lower() != self._proof:
            return Heard(b"err_auth\r\n", close=True)
        self._passed = True
        return Heard(b"ok\r\n", rest)


class JvcGate(OpenGate):
    """JVC, models of 2021: ``PJ_OK``, then ``PJREQ_`` and the password, filled up with NUL; ``PJACK``."""

    greeting = b"PJ_OK"

    def _expected(self) -> tuple[bytes, ...]:
        if not self._password:
            return (b"PJREQ",)
        request = b"PJREQ_" + self._password.encode()
        return (request.ljust(16, b"\0"), request.ljust(22, b"\0"))

    def hear(self, data: bytes) -> Heard:
        if self._passed:
            return Heard(commands=data)
        self._kept += data
        received = bytes(self._kept)
        for expected in sorted(self._expected(), key=len, reverse=True):
            if received.startswith(expected):
                self._passed = True
                return Heard(b"PJACK", received[len(expected) :])
        if received != b"PJREQ" and any(expected.startswith(received) for expected in self._expected()):
            return Heard()
        self._kept.clear()
        return Heard(b"PJNAK")


class JvcHashedGate(JvcGate):
    """JVC, later models: the SHA-256 of the password and a fixed text."""

    def _expected(self) -> tuple[bytes, ...]:
        return (b"PJREQ_" + hashlib.sha256((self._password + "JVCKWPJ").encode()).hexdigest().encode(),)


GATES: Final[Mapping[str, Callable[[str, random.Random], Gate]]] = {
    "none": OpenGate,
    "escvpnet": EscVpNetGate,
    "ntcontrol": NtControlGate,
    "adcp": AdcpGate,
    "jvc": JvcGate,
}
"""By the login that a profile names."""


class EmulatedNetworkProjector(BoardProjector, TcpServer):
    """A projector on loopback TCP. ``start`` and ``stop`` it, or use it in a ``with`` statement.

    Parameters
    ----------
    lamp : its lamp; the optical bench reads the same one
    board : what it does with commands
    port : TCP port, 0 for any free one (see ``address`` once started)
    gate : makes what comes before the commands, for each connection
    password : of the login; "" for none
    wedges_below_s : with two commands within this time while it warms or cools, it hangs until its mains were cut
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
    ) -> None:
        BoardProjector.__init__(self, lamp, board, wedges_below_s=wedges_below_s, boot_s=boot_s)
        TcpServer.__init__(self, port)
        self.connections = 0
        self._gate = gate
        self._password = password
        self._random = random.Random(1)
        self._board_turn = threading.Lock()
        self._clients: set[socket.socket] = set()

    def unplug(self) -> None:
        """Pull the network cable: connections end, and none is accepted. The projector itself stays as it is."""
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
        super().cut_mains()
        self.hang_up()

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
            while not self._stopped.is_set() and self.awake:
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
                self._stopped.wait(wait_s)
                client.sendall(carried)
        return not (answered and gate.closes)
