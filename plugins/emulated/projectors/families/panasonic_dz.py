"""Panasonic PT-DZ and PT-RZ: STX, a projector number on the serial line, a command, ETX.

Written from the command lists of PT-DZ870 and PT-RZ34 (docs/reference/projectors.md); shares no parser with the
driver, so that a common mistake would show.
"""

from __future__ import annotations

from typing import Final

from plugins.emulated.projectors.families.line_buffer import LineBuffer
from plugins.emulated.projectors.lamp import EmulatedLamp, LampPhase

_PHASES: Final = {LampPhase.STANDBY: b"0", LampPhase.WARMING: b"1", LampPhase.LIT: b"2", LampPhase.COOLING: b"3"}


class PanasonicDzBoard:
    """``number``: its own on the line; ZZ is for all, and for what comes from the LAN port."""

    def __init__(self, lamp: EmulatedLamp, *, number: bytes = b"01") -> None:
        self._lamp = lamp
        self._number = number
        self._menu = {b"IIS": b"HD1", b"LPM": b"0"}
        self._lines = LineBuffer(0x03, 0x02)

    def feed(self, data: bytes, *, busy: bool = False) -> list[bytes]:
        answers = []
        for line in self._lines.feed(data):
            if not line.startswith(b"\x02"):
                continue
            head, _, command = line[1:].partition(b";")
            if head not in (b"AD" + self._number, b"ADZZ"):
                continue
            said = b"ER401" if busy else self._act(command)
            answers.append(b"\x02" + said + b"\x03")
        return answers

    def notices(self) -> list[bytes]:
        return []

    def _act(self, command: bytes) -> bytes:
        lamp = self._lamp
        replies = {
            b"Q$S": _PHASES[lamp.phase],
            b"Q$L:1": b"%d" % lamp.hours,
            b"QID": b"DZ870",
            b"QPW": b"001" if lamp.burning else b"000",
            b"QSH": b"%d" % lamp.shutter_closed,
        }
        if lamp.burning:
            replies |= {b"QIN": self._menu[b"IIS"], b"QSL": self._menu[b"LPM"]}
            key, _, value = command.partition(b":")
            if key in self._menu and value:
                self._menu[key] = value
                return command
        if command in replies:
            return replies[command]
        if command == b"POF":
            lamp.extinguish()
            return b"POF"
        if command in (b"OSH:0", b"OSH:1") and lamp.burning:
            lamp.shutter_closed = command == b"OSH:1"
            return command
        if command == b"PON" and lamp.strike():
            return b"PON"
        return b"ER402" if command.startswith(b"OSH") else b"ER401"
