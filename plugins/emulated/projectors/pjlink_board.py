"""What an emulated PJLink projector answers, and in what it may be odd: bytes in, bytes out, no sockets.

Written from the PJLink specification on its own: it shares no parser with the driver, so that a common mistake would
show.
"""

from __future__ import annotations

import hashlib
import hmac
import random
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Final

from plugins.emulated.projectors.lamp import EmulatedLamp, LampPhase

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
    no MD5 digest, but SHA-256 after ``PJLINK 2`` (class 2, version 2.10).
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
        state: dict[bytes, Callable[[], bytes]] = {
            b"POWR": lambda: _POWER[self._lamp.phase],
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
