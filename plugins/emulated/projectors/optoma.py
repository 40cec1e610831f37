"""What an Optoma projector of a later model does with the bytes on its serial line.

Written from the "RS232 Protocol Function List" of the manuals, on its own: it shares no parser with the driver, so that
a common mistake would show. Bytes in, bytes out; the lamp is the only state it acts on.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from plugins.emulated.projectors.lamp import EmulatedLamp, LampPhase

CR: Final = b"\r"
_LONGEST: Final = 32
_INFO: Final = {LampPhase.STANDBY: 0, LampPhase.WARMING: 1, LampPhase.COOLING: 2}
_LAMP_FAIL, _OVER_TEMPERATURE = 4, 7


@dataclass(frozen=True, slots=True)
class OptomaQuirks:
    """By model: ``ok`` is how it spells OK; ``p_first``: it acknowledges a question before it answers."""

    ok: bytes = b"OK"
    p_first: bool = False
    model_code: int = 2
    firmware: bytes = b"C07"


class OptomaBoard:
    """The control board: ``feed`` it bytes from the line, send what it returns; ``notices`` are sent unasked."""

    def __init__(self, lamp: EmulatedLamp, *, number: int = 1, quirks: OptomaQuirks | None = None) -> None:
        self._lamp = lamp
        self._number = number
        self._quirks = quirks or OptomaQuirks()
        self._line = bytearray()
        self._told_phase = lamp.phase
        self._reported_trouble: set[int] = set()

    def feed(self, data: bytes, *, busy: bool = False) -> list[bytes]:
        """The answers to the commands that ``data`` completes, one an element."""
        answers = []
        for byte in data:
            if byte == CR[0]:
                answers.append(self._answer(bytes(self._line), busy))
                self._line.clear()
            elif byte == ord("~"):
                self._line[:] = b"~"  # a command always starts here, after any noise
            elif len(self._line) < _LONGEST:
                self._line.append(byte)
        return [answer for answer in answers if answer]

    def notices(self) -> list[bytes]:
        """INFO lines due since the last call: changes of the lamp's phase, and trouble."""
        due = []
        phase = self._lamp.phase
        if phase is not self._told_phase:
            self._told_phase = phase
            if phase in _INFO:
                due.append(_INFO[phase])
        trouble = {_OVER_TEMPERATURE} if self._lamp.too_hot else set()
        if self._lamp.failed and (self._lamp.strikes or self._reported_trouble):
            trouble.add(_LAMP_FAIL)
        due += sorted(trouble - self._reported_trouble)
        self._reported_trouble = trouble
        return [b"INFO%d\r" % code for code in due]

    def _answer(self, line: bytes, busy: bool) -> bytes:
        """``~XXnnn p``: two digits of projector number, the command, a space, the parameter."""
        if len(line) < 6 or line[:1] != b"~" or not line[1:3].isdigit():
            return b"F\r" if line else b""
        if int(line[1:3]) not in (0, self._number):
            return b""  # another projector on the same cable is meant
        command, space, parameter = line[3:].partition(b" ")
        if not command.isdigit() or not space or busy:
            return b"F\r"
        return self._act(int(command), parameter)

    def _act(self, command: int, parameter: bytes) -> bytes:
        if command == 0:
            return self._switch(parameter)
        if command == 2:
            return self._mute(parameter)
        status = self._read(command) if parameter == b"1" else None
        if status is None:
            return b"F\r"
        return (b"P\r" if self._quirks.p_first else b"") + self._quirks.ok + status + CR

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
            self._reported_trouble.discard(_LAMP_FAIL)  # every strike of a dead lamp is reported again
        return struck

    def _mute(self, parameter: bytes) -> bytes:
        if parameter not in (b"0", b"1", b"2") or not self._lamp.burning:
            return b"F\r"
        self._lamp.shutter_closed = parameter == b"1"
        return b"P\r"

    def _read(self, command: int) -> bytes | None:
        burning = self._lamp.burning
        if command == 124:
            return b"1" if burning else b"0"
        if command == 108:
            return b"%04d" % self._lamp.hours
        if command == 121:
            return b"7" if burning else b"0"
        if command == 122:
            return self._quirks.firmware
        if command == 151:
            return b"%d" % self._quirks.model_code
        return None
