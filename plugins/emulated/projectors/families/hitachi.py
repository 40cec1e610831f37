"""Hitachi and Maxell: 13 bytes with a CRC; one or three bytes back.

Written from the RS-232C command tables of CP-EX301N and CP-X models (docs/reference/projectors.md); shares no parser
with the driver, so that a common mistake would show.
"""

from __future__ import annotations

import struct
from typing import Final

from plugins.emulated.projectors.lamp import EmulatedLamp, LampPhase

_HEAD: Final = b"\xbe\xef\x03\x06\x00"
_SET: Final = 1
_GET: Final = 2


class HitachiBoard:
    """06 done, 15 not known, 1C an error, 1D data, 1F busy. Warming is reported as on."""

    _PHASES: Final = {LampPhase.STANDBY: 0, LampPhase.WARMING: 1, LampPhase.LIT: 1, LampPhase.COOLING: 2}

    def __init__(self, lamp: EmulatedLamp) -> None:
        self._lamp = lamp
        self._kept = bytearray()

    def feed(self, data: bytes, *, busy: bool = False) -> list[bytes]:
        answers = []
        self._kept += data
        while (start := self._kept.find(_HEAD)) >= 0:
            del self._kept[:start]
            if len(self._kept) < 13:
                break
            message = bytes(self._kept[:13])
            del self._kept[:13]
            answers.append(b"\x1f\x00\x00" if busy else self._reply(message))
        del self._kept[:-64]
        return answers

    def notices(self) -> list[bytes]:
        return []

    def _reply(self, message: bytes) -> bytes:
        if _crc(message[7:]) != message[5:7]:
            return b"\x15"
        action, kind, value = struct.unpack("<HHH", message[7:])
        lamp = self._lamp
        if action == _GET:
            replies = {0x6000: self._PHASES[lamp.phase], 0x1090: lamp.hours & 0xFFFF, 0x3020: int(lamp.shutter_closed)}
            return b"\x1d" + struct.pack("<H", replies[kind]) if kind in replies else b"\x15"
        if action == _SET and kind == 0x6000:
            if not value:
                lamp.extinguish()
            elif not lamp.strike():
                return b"\x1c\x00\x01"
            return b"\x06"
        if action == _SET and kind == 0x3020 and lamp.burning:
            lamp.shutter_closed = value == 1
            return b"\x06"
        return b"\x1c\x00\x02"


def _crc(data: bytes) -> bytes:
    """As in the tables: CRC-16 with the reversed polynomial A001, begun so that the head is included."""
    crc = 0x1C17
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc >> 1) ^ (0xA001 if crc & 1 else 0)
    return struct.pack(">H", crc)
