"""An emulated network projector: PJLink class 1 and 2 over TCP.

Written from the PJLink specification on its own: it shares no parser with the driver, so that a common mistake would
show.
"""

from __future__ import annotations

import contextlib
import hashlib
import hmac
import random
import socket
import threading
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Final

from lab.emulated.servers import BackgroundDevice, TcpServer
from plugins.emulated.projectors.lamp import EmulatedLamp, LampPhase
from plugins.emulated.projectors.projector import EmulatedProjector

CR: Final = b"\r"
REFUSAL: Final = b"PJLINK ERRA\r"
_POWER: Final = {LampPhase.STANDBY: b"0", LampPhase.LIT: b"1", LampPhase.COOLING: b"2", LampPhase.WARMING: b"3"}
_FIXED: Final = {
    b"INF1": b"Velatura",
    b"INF2": b"Emulated PJLink projector",
    b"INFO": b"",
    b"CLSS": b"2",
    b"INST": b"11 12 31 32",
}
_SECOND: Final = {b"SNUM": b"VE-0001", b"SVER": b"1.0"}


@dataclass(frozen=True, slots=True)
class PjLinkOddities:
    """In what a projector differs from the specification; users and other clients' source report each of these.

    ``answers``: by command, what it answers to the question instead (after the ``=``), None: nothing at all.
    ``before``: what it sends before its greeting; ``open_greeting``: that greeting where it wants no password;
    ``ending`` of its lines; ``salt_digits`` of the random number for the password. ``closes``: it closes the connection
    after each answer; ``closes_unanswered``: a command (such as ``POWR 1``) that it carries out and then closes the
    connection without an answer. ``mutes``: the parameters of AVMT that it accepts. ``second_level_only``: it accepts
    no MD5 digest, but SHA-256 after ``PJLINK 2`` (class 2, version 2.10). ``digest_each``: it wants the digest with
    each command of a connection. ``dark_answer``: what it answers to the question for its power in standby. ``chatty``:
    it reports that it came up before it answers, and pads with NUL.
    """

    answers: Mapping[str, bytes | None] = field(default_factory=dict)
    before: bytes = b""
    open_greeting: bytes = b"PJLINK 0"
    ending: bytes = CR
    salt_digits: int = 8
    closes: bool = False
    closes_unanswered: str = ""
    mutes: tuple[bytes, ...] = (b"10", b"11", b"20", b"21", b"30", b"31")
    second_level_only: bool = False
    digest_each: bool = False
    dark_answer: bytes = b"0"
    chatty: bool = False


class PjLinkBoard:
    """What the projector answers to a command: bytes in, bytes out; the lamp is the state."""

    def __init__(self, lamp: EmulatedLamp, name: str, odd: PjLinkOddities | None = None) -> None:
        self._lamp = lamp
        self.odd = odd or PjLinkOddities()
        self._name = name.encode("utf-8")
        self._input = b"31"
        self._audio_muted = False

    def answer(self, line: bytes, *, busy: bool) -> bytes:
        """The answer to one command line without its CR; b"" for what is not PJLink at all, and for no answer."""
        if len(line) < 8 or line[:1] != b"%" or line[1:2] not in b"12" or line[6:7] != b" ":
            return b""
        pj_class, name, parameter = line[1:2], line[2:6].upper(), line[7:]
        reply: bytes | None = b"ERR3" if busy else self._act(pj_class, name, parameter)
        if parameter == b"?":
            reply = self.odd.answers.get(name.decode("ascii", "replace"), reply)
        return b"" if reply is None else b"%" + pj_class + name + b"=" + reply + self.odd.ending

    def _act(self, pj_class: bytes, name: bytes, parameter: bytes) -> bytes:
        if parameter == b"?":
            return self._answer(pj_class, name)
        actions: dict[bytes, Callable[[bytes], bytes]] = {
            b"POWR": self._switch,
            b"AVMT": self._mute,
            b"INPT": self._select,
        }
        return actions[name](parameter) if name in actions else b"ERR1"

    def _answer(self, pj_class: bytes, name: bytes) -> bytes:
        if name in _FIXED:
            return _FIXED[name]
        if pj_class == b"2" and name in _SECOND:
            return _SECOND[name]
        if name in (b"INPT", b"AVMT") and not self._lamp.burning:
            return b"ERR3"
        power = self.odd.dark_answer if self._lamp.phase is LampPhase.STANDBY else _POWER[self._lamp.phase]
        state: dict[bytes, Callable[[], bytes]] = {
            b"POWR": lambda: power,
            b"LAMP": lambda: b"%d %d" % (self._lamp.hours, self._lamp.burning),
            b"ERST": lambda: b"0%d%d000" % (2 * self._lamp.failed, 2 * self._lamp.too_hot),
            b"NAME": lambda: self._name,
            b"INPT": lambda: self._input,
            b"AVMT": self._muted,
        }
        return state[name]() if name in state else b"ERR1"

    def _muted(self) -> bytes:
        video, audio = self._lamp.shutter_closed, self._audio_muted
        return b"31" if video and audio else b"11" if video else b"21" if audio else b"30"

    def _switch(self, parameter: bytes) -> bytes:
        if parameter == b"1":
            if not self._lamp.strike():
                return b"ERR3"
            return b"ERR4" if self._lamp.failed else b"OK"
        if parameter == b"0":
            self._lamp.extinguish()
            return b"OK"
        return b"ERR2"

    def _mute(self, parameter: bytes) -> bytes:
        if parameter not in self.odd.mutes:
            return b"ERR2"
        if not self._lamp.burning:
            return b"ERR3"
        on = parameter[1:] == b"1"
        if parameter[:1] in b"13":
            self._lamp.shutter_closed = on
        if parameter[:1] in b"23":
            self._audio_muted = on
        return b"OK"

    def _select(self, parameter: bytes) -> bytes:
        if parameter not in _FIXED[b"INST"].split():
            return b"ERR2"
        if not self._lamp.burning:
            return b"ERR3"
        self._input = parameter
        return b"OK"


class PasswordCheck:
    """The password of one connection: ``greeting`` first, then each line until ``passed``."""

    def __init__(self, password: str, odd: PjLinkOddities, source: random.Random) -> None:
        self._password = password
        self._odd = odd
        self._salt = "".join(source.choice("0123456789abcdef") for _ in range(odd.salt_digits))
        self._second_salt = f"{source.getrandbits(128):032x}"
        self._second_level = False
        self.passed = False
        self.command = b""
        """The command that came with the proof."""

    @property
    def greeting(self) -> bytes:
        return f"PJLINK 1 {self._salt}".encode() + self._odd.ending

    def hears(self, line: bytes) -> bytes:
        """What is said to a line before the password was proven; b"" once it is: then ``command`` is to be answered."""
        if line == b"PJLINK 2" and self._odd.second_level_only:
            self._second_level = True
            return f"PJLINK 2 {self._second_salt}".encode() + self._odd.ending
        if self._second_level:
            proof, expected, self.command = line[32:96], self._second_digest(line[:32]), line[96:]
        else:
            digest = hashlib.md5(f"{self._salt}{self._password}".encode(), usedforsecurity=False)
            proof, expected, self.command = line[:32], digest.hexdigest().encode(), line[32:]
        allowed = self._second_level or not self._odd.second_level_only
        self.passed = allowed and hmac.compare_digest(proof.lower(), expected)
        return b"" if self.passed else REFUSAL

    def _second_digest(self, theirs: bytes) -> bytes:
        """SHA-256 of both random numbers, xor-ed and in hex, and of the password."""
        try:
            mixed = int(theirs, 16) ^ int(self._second_salt, 16)
        except ValueError:
            return b""
        return hashlib.sha256(f"{mixed:032x}{self._password}".encode()).hexdigest().encode()


_LONGEST: Final = 200
_TICK_S: Final = 0.05


class EmulatedPjLinkProjector(EmulatedProjector, TcpServer):
    """A projector on loopback TCP. ``start`` and ``stop`` it, or use it in a ``with`` statement.

    Parameters
    ----------
    lamp : its lamp; the optical bench reads the same one
    port : TCP port, 0 for any free one (see ``address`` once started)
    password : asked of every client, or None
    idle_s : seconds of its lamp's clock after which an idle connection is closed (the specification says 30)
    odd : in what it differs from the specification
    wedges_below_s : asked twice within this time while it warms or cools, it hangs: ``wedged`` is true for good

    ``heard``: the commands that it read, without their CR; ``connections``: how many it accepted.

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
        odd: PjLinkOddities | None = None,
        wedges_below_s: float = 0.0,
    ) -> None:
        EmulatedProjector.__init__(self, lamp, wedges_below_s=wedges_below_s)
        TcpServer.__init__(self, port)
        self._board = PjLinkBoard(lamp, name, odd)
        self.heard: list[bytes] = []
        self.connections = 0
        self._board_lock = threading.Lock()
        self._password = password
        self._idle_s = idle_s
        self._random = random.Random(1)

    def set_oddities(self, odd: PjLinkOddities) -> None:
        """Behave so from the next message on."""
        self._board.odd = odd

    def _serve(self, client: socket.socket) -> None:
        self.connections += 1
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
                if check is not None and (not check.passed or self._board.odd.digest_each):
                    reply = check.hears(line)
                    if reply:
                        self._send(client, reply)
                        if reply == REFUSAL:
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
                    self._send(client, b"%2LKUP=02:00:00:00:00:01\r\0\0" + answer if self._board.odd.chatty else answer)
                    if self._board.odd.closes:
                        return

    def _lines(self, client: socket.socket) -> Iterator[bytes]:
        """Lines without their CR until the client goes, is idle too long, or sends a line that never ends."""
        buffer = bytearray()
        clock = self.lamp.clock
        heard = clock()
        while not self._stopped.is_set() and clock() - heard < self._idle_s and len(buffer) < _LONGEST:
            while (end := buffer.find(CR)) >= 0:
                line = bytes(buffer[:end])
                del buffer[: end + 1]
                yield line
            try:
                data = client.recv(1024)
            except TimeoutError:
                continue
            if not data or clock() - heard >= self._idle_s:
                return
            heard = clock()
            buffer += data

    def _send(self, client: socket.socket, data: bytes) -> None:
        lost = self.faults.loses_this_one()
        carried, wait_s = self.faults.bent(data)
        if wait_s:
            self._stopped.wait(wait_s)
        if not lost:
            client.sendall(carried)


_UDP_TICK_S: Final = 0.02


class EmulatedPjLinkUdp(BackgroundDevice):
    """The UDP side of a projector, on loopback. ``start`` and ``stop`` it, or use it in a ``with`` statement.

    Parameters
    ----------
    lamp : its lamp; power and errors follow from it
    mac : its address as it tells it, with or without colons
    controller : host and port registered for notifications; a search is answered to its sender
    answer_after_s : how long it takes to answer a search (real ones choose 0 to 10 s)
    """

    def __init__(
        self, lamp: EmulatedLamp, *, mac: str, controller: tuple[str, int] | None = None, answer_after_s: float = 0.0
    ) -> None:
        super().__init__()
        self._lamp = lamp
        self._mac = mac.encode("ascii")
        self._controller = controller
        self._answer_after_s = answer_after_s
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.settimeout(_UDP_TICK_S)

    @property
    def address(self) -> tuple[str, int]:
        host, port = self._socket.getsockname()[:2]
        return str(host), int(port)

    def stop(self) -> None:
        """End, and close its port."""
        super().stop()
        self._socket.close()

    def select_input(self, name: str) -> None:
        """Somebody chose another input by the projector's own keys."""
        self._send(b"%2INPT=" + name.encode("ascii") + b"\r")

    def _run(self) -> None:
        before = self._state()
        self._send(b"%2LKUP=" + self._mac + b"\r")
        while not self._stopped.is_set():
            self._answer()
            now = self._state()
            for line, old in zip(now, before, strict=True):
                if line != old:
                    self._send(line)
            before = now

    def _state(self) -> tuple[bytes, bytes]:
        errors = b"0%d%d000" % (2 * self._lamp.failed, 2 * self._lamp.too_hot)
        return b"%%2POWR=%d\r" % int(_POWER[self._lamp.phase]), b"%2ERST=" + errors + b"\r"

    def _answer(self) -> None:
        with contextlib.suppress(TimeoutError, ConnectionError):
            data, sender = self._socket.recvfrom(256)
            if data == b"%2SRCH\r" and not self._stopped.wait(self._answer_after_s):
                self._socket.sendto(b"%2ACKN=" + self._mac + b"\r", sender)

    def _send(self, data: bytes) -> None:
        if self._controller is not None:
            with contextlib.suppress(OSError):
                self._socket.sendto(data, self._controller)
