"""Sony: ADCP (text) and SDCP (counted bytes).

Written from Sony's protocol manuals as programs of users quote them (docs/reference/projectors.md); shares no parser
with the driver, so that a common mistake would show.
"""

from __future__ import annotations

import struct
from typing import Final

from plugins.emulated.projectors.families.line_buffer import LineBuffer
from plugins.emulated.projectors.lamp import EmulatedLamp, LampPhase

_ADCP: Final = {
    LampPhase.STANDBY: b"standby",
    LampPhase.WARMING: b"startup",
    LampPhase.LIT: b"on",
    LampPhase.COOLING: b"cooling1",
}
_SDCP: Final = {LampPhase.STANDBY: 0, LampPhase.WARMING: 2, LampPhase.LIT: 3, LampPhase.COOLING: 4}


class AdcpBoard:
    """Lines that end in CR LF; values in quotes, answers to questions as JSON."""

    def __init__(self, lamp: EmulatedLamp) -> None:
        self._lamp = lamp
        self._lines = LineBuffer(ord("\n"))
        self._menu = {b"input": b'"hdmi1"', b"light_output_mode": b'"high"'}

    def feed(self, data: bytes, *, busy: bool = False) -> list[bytes]:
        return [
            (b"err_inactive" if busy else self._act(line.strip())) + b"\r\n"
            for line in self._lines.feed(data)
            if line.strip()
        ]

    def notices(self) -> list[bytes]:
        return []

    def _act(self, line: bytes) -> bytes:
        lamp = self._lamp
        replies = {
            b"power_status ?": b'"%s"' % _ADCP[lamp.phase],
            b"timer ?": b'[{"operation":%d},{"light_src":%d},{"prev_light_src":7}]' % (lamp.hours + 9, lamp.hours),
            b"modelname ?": b'"VPL-FHZ75"',
        }
        if line in replies:
            return replies[line]
        key, _, value = line.partition(b" ")
        if key == b"blank" or key in self._menu:
            return self._chosen(key, value)
        if line == b'power "on"':
            return b"ok" if lamp.strike() else b"err_inactive"
        if line == b'power "off"':
            lamp.extinguish()
            return b"ok"
        return b"err_val" if key == b"power" else b"err_cmd"

    def _chosen(self, key: bytes, value: bytes) -> bytes:
        """What a menu tells, or how it is set; ``blank`` also tells while it is dark."""
        lamp, burning = self._lamp, self._lamp.burning
        if value == b"?" and (burning or key == b"blank"):
            return (self._menu | {b"blank": b'"on"' if lamp.shutter_closed else b'"off"'})[key]
        if key == b"blank" and value not in (b'"on"', b'"off"'):
            return b"err_val"
        if not burning:
            return b"err_inactive"
        if key == b"blank":
            lamp.shutter_closed = value == b'"on"'
        else:
            self._menu[key] = value
        return b"ok"


class SdcpBoard:
    """Version 2, category 0A, community, set or get, item, count, data."""

    _OF_ITEM: Final = b"\x01\x01"
    _NOT_NOW: Final = b"\x01\x0a"

    def __init__(self, lamp: EmulatedLamp, *, community: bytes = b"SONY") -> None:
        self._lamp = lamp
        self._community = community
        self._kept = bytearray()

    def feed(self, data: bytes, *, busy: bool = False) -> list[bytes]:
        answers = []
        self._kept += data
        while (start := self._kept.find(b"\x02\x0a")) >= 0:
            del self._kept[:start]
            if len(self._kept) < 10 or len(self._kept) < 10 + self._kept[9]:
                break
            size = 10 + self._kept[9]
            asked = bytes(self._kept[:size])
            del self._kept[:size]
            done, body = (False, self._NOT_NOW) if busy else self._act(asked[2:6], asked[6], asked[7:9], asked[10:])
            answers.append(asked[:6] + bytes([done]) + asked[7:9] + bytes([len(body)]) + body)
        return answers

    def notices(self) -> list[bytes]:
        return []

    def _act(self, community: bytes, get: int, item: bytes, data: bytes) -> tuple[bool, bytes]:
        lamp = self._lamp
        if community != self._community:
            return False, b"\x02\x01"
        if get:
            replies = {b"\x01\x02": _SDCP[lamp.phase], b"\x01\x13": lamp.hours, b"\x00\x30": int(lamp.shutter_closed)}
            return (True, struct.pack(">H", replies[item])) if item in replies else (False, self._OF_ITEM)
        if item == b"\x01\x30" and data in (b"\0\0", b"\0\1"):
            if data == b"\0\0":
                lamp.extinguish()
            elif not lamp.strike():
                return False, self._NOT_NOW
            return True, b""
        if item == b"\x00\x30" and data in (b"\0\0", b"\0\1") and lamp.burning:
            lamp.shutter_closed = data == b"\0\1"
            return True, b""
        return False, self._NOT_NOW if item in (b"\x01\x30", b"\x00\x30") else self._OF_ITEM
