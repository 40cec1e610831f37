"""JVC D-ILA: a head, the unit 89 01, a command, LF; what can't be done now is not answered.

Written from JVC's LAN connection specification of 2021 (docs/reference/projectors.md); shares no parser with the
driver, so that a common mistake would show.
"""

from __future__ import annotations

from typing import Final

from plugins.emulated.projectors.families.line_buffer import LineBuffer
from plugins.emulated.projectors.lamp import EmulatedLamp, LampPhase

_UNIT: Final = b"\x89\x01"
_PHASES: Final = {LampPhase.STANDBY: b"0", LampPhase.LIT: b"1", LampPhase.COOLING: b"2", LampPhase.WARMING: b"3"}


class JvcBoard:
    """``!`` do, ``?`` ask, ``@`` answer, 06 acknowledged."""

    def __init__(self, lamp: EmulatedLamp) -> None:
        self._lamp = lamp
        self._lines = LineBuffer(ord("\n"))
        self._menu = {b"IP": b"6", b"PMLP": b"0"}

    def feed(self, data: bytes, *, busy: bool = False) -> list[bytes]:
        answers = []
        for line in self._lines.feed(data):
            noise, unit, command = line.rpartition(_UNIT)
            head = noise[-1:]  # what came before it is passed over
            if busy or not unit:
                continue
            if head == b"!" and self._do(command):
                answers.append(b"\x06" + _UNIT + command[:2] + b"\n")
            elif head == b"?" and (reply := self._answer(command)) is not None:
                answers.append(b"\x06" + _UNIT + command[:2] + b"\n")
                answers.append(b"@" + _UNIT + command[:2] + reply + b"\n")
        return answers

    def notices(self) -> list[bytes]:
        return []

    def _do(self, command: bytes) -> bool:
        if command == b"PW1":
            return self._lamp.strike()
        if command == b"PW0":
            self._lamp.extinguish()
            return True
        if command[:-1] in self._menu and self._lamp.burning:
            self._menu[command[:-1]] = command[-1:]
            return True
        return command == b""  # a check of the connection

    def _answer(self, command: bytes) -> bytes | None:
        power = b"4" if self._lamp.faulty else _PHASES[self._lamp.phase]
        replies = {b"PW": power, b"MD": b"ILAFPJ -- B5B1", b"IFLT": b"%04X" % self._lamp.hours}
        return (replies | self._menu if self._lamp.burning else replies).get(command)
