"""Acer: ``* 0`` and a key code or a question; *000 or *001 first, then the answer.

Written from the RS232 tables of Acer's user manuals (docs/reference/projectors.md); shares no parser with the driver,
so that a common mistake would show.
"""

from __future__ import annotations

from plugins.emulated.projectors.families.line_buffer import LineBuffer
from plugins.emulated.projectors.lamp import EmulatedLamp, LampPhase


class AcerBoard:
    """Warming is reported as lit, cooling as dark; a strike while it cools is refused."""

    def __init__(self, lamp: EmulatedLamp) -> None:
        self._lamp = lamp
        self._lines = LineBuffer(ord("\r"), ord("*"))

    def feed(self, data: bytes, *, busy: bool = False) -> list[bytes]:
        return [b"*001\r" if busy else self._act(line) for line in self._lines.feed(data) if line.startswith(b"* 0 ")]

    def notices(self) -> list[bytes]:
        return []

    def _act(self, line: bytes) -> bytes:
        lamp = self._lamp
        match line[4:]:
            case b"IR 001":
                return b"*000\r" if lamp.phase is not LampPhase.COOLING and lamp.strike() else b"*001\r"
            case b"IR 002":
                lamp.extinguish()
                return b"*000\r"
            case b"Lamp ?":
                return b"*000\rLamp %d\r" % lamp.burning
            case b"Lamp":
                return b"*000\r%04d\r" % lamp.hours
        return b"*001\r"
