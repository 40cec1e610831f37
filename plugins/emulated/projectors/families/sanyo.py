"""What a Sanyo projector does with the bytes on its serial line: the basic serial commands of its PLC series.

Written from "Basic Serial Command Functional Specifications" (PLC-XM100): three characters and CR; ACK or ``?`` back.
"""

from __future__ import annotations

from typing import Final

from plugins.emulated.projectors.lamp import EmulatedLamp, LampPhase

_ACK: Final = b"\x06\r"
_NO: Final = b"?\r"
_LONGEST: Final = 64


class SanyoBoard:
    """``lamps``: a model with several tells the hours of each. ``deaf``: it answers 02 to everybody who asks."""

    def __init__(self, lamp: EmulatedLamp, *, lamps: int = 1, deaf: bool = False) -> None:
        self._lamp = lamp
        self._lamps = lamps
        self.deaf = deaf
        self._line = bytearray()

    def feed(self, data: bytes, *, busy: bool = False) -> list[bytes]:
        answers = []
        for byte in data:
            if byte != ord("\r"):
                del self._line[_LONGEST:]
                self._line.append(byte)
                continue
            # Only the last three characters count: noise before them is passed over.
            answers.append(_NO if busy else self._act(bytes(self._line[-3:])))
            self._line.clear()
        return answers

    def notices(self) -> list[bytes]:
        return []

    def _act(self, command: bytes) -> bytes:
        lamp = self._lamp
        match command:
            case b"CR0":
                return self._state() + b"\r"
            case b"CR3":
                return b" ".join([b"%05d" % lamp.hours] * self._lamps) + b"\r"
            case b"C00":
                return _ACK if lamp.strike() else _NO
            case b"C01":
                lamp.extinguish()
                return _ACK
            case b"C0D" | b"C0E" if lamp.phase is LampPhase.LIT:
                lamp.shutter_closed = command == b"C0D"
                return _ACK
        return _NO

    def _state(self) -> bytes:
        if self.deaf:
            return b"02"
        phase = self._lamp.phase
        dark = phase in (LampPhase.STANDBY, LampPhase.COOLING)
        if dark and self._lamp.too_hot:
            return b"28" if phase is LampPhase.COOLING else b"88"
        if dark and self._lamp.failed and self._lamp.strikes:
            return b"21" if phase is LampPhase.COOLING else b"81"
        codes = {LampPhase.STANDBY: b"80", LampPhase.WARMING: b"40", LampPhase.LIT: b"00", LampPhase.COOLING: b"20"}
        return codes[phase]
