"""Digital Projection: commands with a star, and commands with V.

Written from its protocol guide 115-482H as others read it, and the manuals of E-Vision Laser 5000 and 6500
(docs/reference/projectors.md); shares no parser with the driver, so that a common mistake would show.
"""

from __future__ import annotations

from typing import Final

from plugins.emulated.projectors.families.line_buffer import LineBuffer
from plugins.emulated.projectors.lamp import EmulatedLamp, LampPhase

_STATES: Final = {LampPhase.STANDBY: b"0", LampPhase.WARMING: b"1", LampPhase.LIT: b"2", LampPhase.COOLING: b"3"}


class DigitalProjectionBoard:
    """``*name = value``, ``*name ?`` or ``*name``; ``ack name = value`` or ``nack name``."""

    def __init__(self, lamp: EmulatedLamp) -> None:
        self._lamp = lamp
        self._lines = LineBuffer(ord("\r"), ord("*"))

    def feed(self, data: bytes, *, busy: bool = False) -> list[bytes]:
        lines = [line[1:] for line in self._lines.feed(data) if line.startswith(b"*")]
        return [self._reply(line, busy) + b"\r" for line in lines]

    def notices(self) -> list[bytes]:
        return []

    def _reply(self, line: bytes, busy: bool) -> bytes:
        name, _, value = line.replace(b"?", b"=?").partition(b"=")
        name, value = name.strip(), value.strip(b"= ")
        done = None if busy else self._act(name, value)
        if done is None:
            return b"nack " + name
        return b"ack " + name + (b" = " + done if done else b"")

    def _act(self, name: bytes, value: bytes) -> bytes | None:
        lamp = self._lamp
        if value == b"?":
            replies = {
                b"status": b"4" if lamp.faulty else _STATES[lamp.phase],
                b"laser.hours": b"%d" % lamp.hours,
                b"shutter": b"%d" % lamp.shutter_closed,
            }
            return replies.get(name)
        if name == b"power.on":
            return b"" if lamp.strike() else None
        if name == b"power.off":
            lamp.extinguish()
            return b""
        if name == b"shutter" and value in (b"0", b"1") and lamp.burning:
            lamp.shutter_closed = value == b"1"
            return value
        return None


class DigitalProjectionVBoard:
    """``V``, two digits of the projector's number, S or G, four digits, CR; P or F back. Warming is reported as on."""

    _STATES: Final = {LampPhase.STANDBY: b"1", LampPhase.WARMING: b"2", LampPhase.LIT: b"2", LampPhase.COOLING: b"3"}

    def __init__(self, lamp: EmulatedLamp, *, number: bytes = b"00") -> None:
        self._lamp = lamp
        self._number = number
        self._lines = LineBuffer(ord("\r"), ord("V"))

    def feed(self, data: bytes, *, busy: bool = False) -> list[bytes]:
        lines = [line for line in self._lines.feed(data) if line[1:3] in (self._number, b"99")]
        return [(b"F" if busy else self._act(line[3:])) + b"\r" for line in lines]

    def notices(self) -> list[bytes]:
        return []

    def _act(self, command: bytes) -> bytes:
        match command:
            case b"S0001":
                return b"P" if self._lamp.strike() else b"F"
            case b"S0002":
                self._lamp.extinguish()
                return b"P"
            case b"G0004":
                return b"P%05d" % self._lamp.hours
            case b"G0007":
                return b"P" + self._STATES[self._lamp.phase]
            case b"G0008":
                return b"PMD05"
        return b"F"
