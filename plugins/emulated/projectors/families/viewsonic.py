"""ViewSonic: 06 writes, 07 reads; byte 4 counts, the last byte is the sum of all but the first.

Written from its RS-232 and LAN control protocol specification (docs/reference/projectors.md); shares no parser with
the driver, so that a common mistake would show.
"""

from __future__ import annotations

import struct
from typing import Final

from plugins.emulated.projectors.lamp import EmulatedLamp, LampPhase

_DONE: Final = b"\x03\x14\x00\x00\x00\x14"
_REFUSED: Final = b"\x00\x14\x00\x00\x00\x14"
_PHASES: Final = {LampPhase.STANDBY: 0, LampPhase.LIT: 1, LampPhase.WARMING: 2, LampPhase.COOLING: 3}


class ViewSonicBoard:
    """Bytes in, bytes out; noise before a command is passed over."""

    def __init__(self, lamp: EmulatedLamp) -> None:
        self._lamp = lamp
        self._kept = bytearray()

    def feed(self, data: bytes, *, busy: bool = False) -> list[bytes]:
        answers = []
        self._kept += data
        while self._kept:
            if self._kept[0] not in (0x06, 0x07) or (len(self._kept) > 1 and self._kept[1] != 0x14):
                del self._kept[0]
                continue
            if len(self._kept) < 5 or len(self._kept) < self._kept[3] + 6:
                break
            size = self._kept[3] + 6
            message = bytes(self._kept[:size])
            del self._kept[:size]
            if sum(message[1:-1]) & 0xFF == message[-1]:
                answers.append(_REFUSED if busy else self._reply(message))
        return answers

    def notices(self) -> list[bytes]:
        return []

    def _reply(self, message: bytes) -> bytes:
        lamp = self._lamp
        if message[0] == 0x07:
            replies = {
                b"\x11\x00": struct.pack("<B", _PHASES[lamp.phase]),
                b"\x15\x01": struct.pack("<I", lamp.hours),
                b"\x12\x09": struct.pack("<B", lamp.shutter_closed),
            }
            body = replies.get(message[8:10])
            return _REFUSED if body is None else _framed(b"\0\0" + body)
        item, value = message[6:8], message[8]
        if item == b"\x11\x00":
            return _DONE if lamp.strike() else _REFUSED
        if item == b"\x11\x01":
            lamp.extinguish()
            return _DONE
        if item == b"\x12\x09" and lamp.burning:
            lamp.shutter_closed = value == 1
            return _DONE
        return _REFUSED


def _framed(body: bytes) -> bytes:
    frame = b"\x05\x14" + struct.pack(">BBB", 0, len(body), 0) + body
    return frame + bytes([sum(frame[1:]) & 0xFF])
