"""A projector's control board: what it does with the bytes that it hears. Bytes in, bytes out.

The families are each written from the makers' command lists (docs/reference/projectors.md; Optoma's here from its
"RS232 Protocol Function List") and share no parser with the drivers, so that a common mistake would show. The lamp is
the only state that they act on. Those of other makers are in velatura-lab.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar, Final, Protocol

from plugins.emulated.projectors.lamp import EmulatedLamp, LampPhase

_LONGEST: Final = 256


class Board(Protocol):
    """The control board of a projector."""

    def feed(self, data: bytes, *, busy: bool = False) -> list[bytes]:
        """The answers to the commands that ``data`` completes, one an element; ``busy``: each is refused."""

    def notices(self) -> list[bytes]:
        """Lines that are due now, unasked."""


class LampBoard(ABC):
    """What the boards have in common: they collect whole commands, answer each, and send nothing unasked."""

    def __init__(self, lamp: EmulatedLamp) -> None:
        self._lamp = lamp
        self._received = bytearray()

    def feed(self, data: bytes, *, busy: bool = False) -> list[bytes]:
        """See ``Board``."""
        self._received += data
        answers = []
        while (command := self._take()) is not None:
            answers += self._answers(command, busy)
        return answers

    def notices(self) -> list[bytes]:
        """See ``Board``."""
        return []

    @abstractmethod
    def _take(self) -> bytes | None:
        """Remove the next whole command from ``_received``, with any noise before it; None while there is none."""

    @abstractmethod
    def _answers(self, command: bytes, busy: bool) -> list[bytes]:
        """The answers to one command."""

    def _cut(self, length: int) -> bytes | None:
        """The first ``length`` received bytes; None while there are fewer."""
        if len(self._received) < length:
            return None
        command = bytes(self._received[:length])
        del self._received[:length]
        return command


class LineBoard(LampBoard):
    """A board whose commands end in one byte, ``end``; with ``start``, each begins at that byte, after any noise, so
    no command may contain it later on. Commands come without their end."""

    end: ClassVar = b"\r"
    start: ClassVar = b""

    def _take(self) -> bytes | None:
        line, end, rest = bytes(self._received).partition(self.end)
        if not end:
            del self._received[:-_LONGEST]
            return None
        self._received[:] = rest
        return line[max(0, line.rfind(self.start)) :] if self.start else line


@dataclass(frozen=True, slots=True)
class OptomaQuirks:
    """By model: ``ok`` is how it spells OK; ``p_first``: it acknowledges a question before it answers."""

    ok: bytes = b"OK"
    p_first: bool = False
    model_code: int = 2


class OptomaBoard(LineBoard):
    """A later model: ``~XXnnn p``, two digits of the projector's ``number``, the command, a space, the parameter."""

    start = b"~"
    _INFO: Final = {LampPhase.STANDBY: 0, LampPhase.WARMING: 1, LampPhase.COOLING: 2}
    _LAMP_FAIL, _OVER_TEMPERATURE = 4, 7

    def __init__(self, lamp: EmulatedLamp, *, number: int = 1, quirks: OptomaQuirks | None = None) -> None:
        super().__init__(lamp)
        self._number = number
        self._quirks = quirks or OptomaQuirks()
        self._reported_phase = lamp.phase
        self._reported_trouble: set[int] = set()

    def notices(self) -> list[bytes]:
        """INFO lines due since the last call: changes of the lamp's phase, and trouble."""
        due = []
        phase = self._lamp.phase
        if phase is not self._reported_phase:
            self._reported_phase = phase
            if phase in self._INFO:
                due.append(self._INFO[phase])
        trouble = {self._OVER_TEMPERATURE} if self._lamp.too_hot else set()
        if self._lamp.failed and (self._lamp.strikes or self._reported_trouble):
            trouble.add(self._LAMP_FAIL)
        due += sorted(trouble - self._reported_trouble)
        self._reported_trouble = trouble
        return [b"INFO%d\r" % code for code in due]

    def _answers(self, command: bytes, busy: bool) -> list[bytes]:
        if len(command) < 6 or command[:1] != b"~" or not command[1:3].isdigit():
            return [b"F\r"] if command else []
        if int(command[1:3]) not in (0, self._number):
            return []  # another projector on the same cable is meant
        code, space, parameter = command[3:].partition(b" ")
        if not code.isdigit() or not space or busy:
            return [b"F\r"]
        return [self._act(int(code), parameter)]

    def _act(self, command: int, parameter: bytes) -> bytes:
        if command == 0:
            return self._switch(parameter)
        if command == 2:
            return self._mute(parameter)
        status = self._read(command) if parameter == b"1" else None
        if status is None:
            return b"F\r"
        return (b"P\r" if self._quirks.p_first else b"") + self._quirks.ok + status + b"\r"

    def _switch(self, parameter: bytes) -> bytes:
        if parameter == b"1":
            return b"P\r" if self._strike() else b"F\r"
        if parameter in (b"0", b"2"):
            self._lamp.extinguish()
            return b"P\r"
        return b"F\r"

    def _strike(self) -> bool:
        struck = self._lamp.strike()
        if struck and self._lamp.failed:
            self._reported_trouble.discard(self._LAMP_FAIL)  # every strike of a dead lamp is reported again
        return struck

    def _mute(self, parameter: bytes) -> bytes:
        if parameter not in (b"0", b"1", b"2") or not self._lamp.burning:
            return b"F\r"
        self._lamp.shutter_closed = parameter == b"1"
        return b"P\r"

    def _read(self, command: int) -> bytes | None:
        burning = self._lamp.burning
        states = {
            108: b"%04d" % self._lamp.hours,
            121: b"7" if burning else b"0",
            122: b"C07",
            124: b"1" if burning else b"0",
            151: b"%d" % self._quirks.model_code,
        }
        return states.get(command)
