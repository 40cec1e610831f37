"""Control boards of counted and binary protocols: Hitachi, JVC, NEC, Optoma's EP910, Sony's SDCP, ViewSonic.

See ``board``. Sources, beside docs/reference/projectors.md: the RS-232C command tables of CP-EX301N and CP-X models
(Hitachi), JVC's LAN connection specification of 2021, Sony's manuals as programs of users quote them, and ViewSonic's
RS-232 and LAN control protocol specification.
"""

from __future__ import annotations

import struct
from typing import Final

from plugins.emulated.projectors.board import LampBoard, LineBoard
from plugins.emulated.projectors.lamp import EmulatedLamp, LampPhase


class NecBoard(LampBoard):
    """The binary protocol: five bytes of header, of which the last counts the data, the data, and the sum.

    ``lens_shutter``: a model that has one; ``heard``: the codes of the commands that it read.
    """

    _ID_AND_MODEL: Final = b"\x01\x31"
    _OPERATION: Final = {LampPhase.STANDBY: 0x00, LampPhase.WARMING: 0x04, LampPhase.LIT: 0x04, LampPhase.COOLING: 0x05}

    def __init__(self, lamp: EmulatedLamp, *, lens_shutter: bool = False) -> None:
        super().__init__(lamp)
        self._shutters = (b"\x02\x10", b"\x02\x11") + ((b"\x02\x16", b"\x02\x17") if lens_shutter else ())
        self.heard: list[bytes] = []

    def _take(self) -> bytes | None:
        while self._received and self._received[0] > 0x03:
            del self._received[0]
        return self._cut(self._received[4] + 6) if len(self._received) >= 5 else None

    def _answers(self, command: bytes, busy: bool) -> list[bytes]:
        return [self._reply(command, busy)] if sum(command[:-1]) & 0xFF == command[-1] else []

    def _reply(self, command: bytes, busy: bool) -> bytes:
        data = None if busy else self._act(command[:2], command[5:-1])
        first = command[0] | (0xA0 if data is None else 0x20)
        data = b"\x02\x0d" if data is None else data
        frame = bytes([first, command[1], *self._ID_AND_MODEL, len(data)]) + data
        return frame + bytes([sum(frame) & 0xFF])

    def _act(self, code: bytes, data: bytes) -> bytes | None:
        """The data of the answer; None: an error."""
        self.heard.append(code)
        if code == b"\x02\x00":
            return b"" if self._lamp.strike() else None
        if code == b"\x02\x01":
            self._lamp.extinguish()
            return b""
        if code in self._shutters:
            if not self._lamp.burning:
                return None
            self._lamp.shutter_closed = code in (b"\x02\x10", b"\x02\x16")
            return b""
        replies = {b"\x00\x85\x01": self._running, b"\x00\xbf\x02": self._basic}
        if (tell := replies.get(code + data)) is not None:
            return tell()
        return self._information() if code == b"\x03\x8a" else None

    def _running(self) -> bytes:
        """078-2: 16 bytes; the third to sixth tell power, cooling, whether a power process runs, and the operation."""
        phase = self._lamp.phase
        status = bytes([self._lamp.burning, phase is LampPhase.COOLING, phase is LampPhase.WARMING, self._operation()])
        return b"\x40\xff" + status + b"\xff" * 10

    def _operation(self) -> int:
        return 0x06 if self._lamp.faulty else self._OPERATION[self._lamp.phase]

    def _basic(self) -> bytes:
        """305-3: 16 bytes; what was asked, the operation, what is shown, the signal's types, the mutes, freeze."""
        muted = self._lamp.shutter_closed
        return bytes([0x02, self._operation(), 0x00, 0x01, 0x01, 0x01, muted, 0x00, 0x00, 0x00]) + b"\xff" * 6

    def _information(self) -> bytes:
        """037: 98 bytes; name, reserved, lamp seconds, filter seconds, reserved."""
        seconds = struct.pack("<II", self._lamp.hours * 3600, 0)
        return b"NP-PA500U".ljust(49, b"\0") + b"\xff" * 33 + seconds + b"\xff" * 8


class Ep910Board(LampBoard):
    """Optoma EP910: ``IR``, two hexadecimal digits that count the rest, three of the command, data.

    Of its commands only those of the first page of its table are known, and here only AV mute.
    """

    def _take(self) -> bytes | None:
        while (start := self._received.find(b"IR")) >= 0:
            del self._received[:start]
            if len(self._received) < 4:
                return None
            try:
                return self._cut(4 + int(self._received[2:4], 16))
            except ValueError:
                del self._received[:2]
        return None

    def _answers(self, command: bytes, busy: bool) -> list[bytes]:
        return [self._reply(command[4:], busy)]

    def _reply(self, body: bytes, busy: bool) -> bytes:
        if busy or self._lamp.phase is LampPhase.COOLING:
            return b"IR0500001"
        if body[:3] != b"002":
            return b"IR0500000"
        if body[3:] == b"?":
            return b"IR04002%d" % self._lamp.shutter_closed
        if body[3:] not in (b"0", b"1"):
            return b"IR0500002"
        self._lamp.shutter_closed = body[3:] == b"1"
        return b"IR03002"


class HitachiBoard(LampBoard):
    """Hitachi and Maxell: 13 bytes with a CRC; back 06 done, 15 not known, 1C an error, 1D data, 1F busy.

    Warming is reported as on.
    """

    _HEAD: Final = b"\xbe\xef\x03\x06\x00"
    _SET: Final = 1
    _GET: Final = 2
    _PHASES: Final = {LampPhase.STANDBY: 0, LampPhase.WARMING: 1, LampPhase.LIT: 1, LampPhase.COOLING: 2}

    def _take(self) -> bytes | None:
        start = self._received.find(self._HEAD)
        if start < 0:
            del self._received[:-64]
            return None
        del self._received[:start]
        return self._cut(13)

    def _answers(self, command: bytes, busy: bool) -> list[bytes]:
        return [b"\x1f\x00\x00" if busy else self._reply(command)]

    def _reply(self, message: bytes) -> bytes:
        if _hitachi_crc(message[7:]) != message[5:7]:
            return b"\x15"
        action, kind, value = struct.unpack("<HHH", message[7:])
        lamp = self._lamp
        if action == self._GET:
            replies = {0x6000: self._PHASES[lamp.phase], 0x1090: lamp.hours & 0xFFFF, 0x3020: int(lamp.shutter_closed)}
            return b"\x1d" + struct.pack("<H", replies[kind]) if kind in replies else b"\x15"
        if action == self._SET and kind == 0x6000:
            if not value:
                lamp.extinguish()
            elif not lamp.strike():
                return b"\x1c\x00\x01"
            return b"\x06"
        if action == self._SET and kind == 0x3020 and lamp.burning:
            lamp.shutter_closed = value == 1
            return b"\x06"
        return b"\x1c\x00\x02"


def _hitachi_crc(data: bytes) -> bytes:
    """As in the tables: CRC-16 with the reversed polynomial A001, begun so that the head is included."""
    crc = 0x1C17
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc >> 1) ^ (0xA001 if crc & 1 else 0)
    return struct.pack(">H", crc)


class JvcBoard(LineBoard):
    """JVC D-ILA: a head, the unit 89 01, a command, LF. ``!`` do, ``?`` ask, ``@`` answer, 06 acknowledged.

    What can't be done now is not answered.
    """

    end = b"\n"
    _UNIT: Final = b"\x89\x01"
    _PHASES: Final = {LampPhase.STANDBY: b"0", LampPhase.LIT: b"1", LampPhase.COOLING: b"2", LampPhase.WARMING: b"3"}

    def __init__(self, lamp: EmulatedLamp) -> None:
        super().__init__(lamp)
        self._menu = {b"IP": b"6", b"PMLP": b"0"}

    def _answers(self, command: bytes, busy: bool) -> list[bytes]:
        noise, unit, code = command.rpartition(self._UNIT)
        head = noise[-1:]  # what came before it is passed over
        if busy or not unit:
            return []
        acknowledged = b"\x06" + self._UNIT + code[:2] + b"\n"
        if head == b"!" and self._do(code):
            return [acknowledged]
        if head == b"?" and (reply := self._answer(code)) is not None:
            return [acknowledged, b"@" + self._UNIT + code[:2] + reply + b"\n"]
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
        power = b"4" if self._lamp.faulty else self._PHASES[self._lamp.phase]
        replies = {b"PW": power, b"MD": b"ILAFPJ -- B5B1", b"IFLT": b"%04X" % self._lamp.hours}
        return (replies | self._menu if self._lamp.burning else replies).get(command)


class SdcpBoard(LampBoard):
    """Sony: version 2, category 0A, community, set or get, item, count, data."""

    _OF_ITEM: Final = b"\x01\x01"
    _NOT_NOW: Final = b"\x01\x0a"
    _PHASES: Final = {LampPhase.STANDBY: 0, LampPhase.WARMING: 2, LampPhase.LIT: 3, LampPhase.COOLING: 4}

    def _take(self) -> bytes | None:
        start = self._received.find(b"\x02\x0a")
        if start < 0:
            return None
        del self._received[:start]
        return self._cut(10 + self._received[9]) if len(self._received) >= 10 else None

    def _answers(self, command: bytes, busy: bool) -> list[bytes]:
        community, get, item, data = command[2:6], command[6], command[7:9], command[10:]
        done, body = (False, self._NOT_NOW) if busy else self._act(community, get, item, data)
        return [command[:6] + bytes([done]) + item + bytes([len(body)]) + body]

    def _act(self, community: bytes, get: int, item: bytes, data: bytes) -> tuple[bool, bytes]:
        lamp = self._lamp
        if community != b"SONY":
            return False, b"\x02\x01"
        if get:
            state = {
                b"\x01\x02": self._PHASES[lamp.phase],
                b"\x01\x13": lamp.hours,
                b"\x00\x30": int(lamp.shutter_closed),
            }
            return (True, struct.pack(">H", state[item])) if item in state else (False, self._OF_ITEM)
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


class ViewSonicBoard(LampBoard):
    """06 writes, 07 reads; byte 4 counts, the last byte is the sum of all but the first. Noise before is skipped."""

    _DONE: Final = b"\x03\x14\x00\x00\x00\x14"
    _REFUSED: Final = b"\x00\x14\x00\x00\x00\x14"
    _PHASES: Final = {LampPhase.STANDBY: 0, LampPhase.LIT: 1, LampPhase.WARMING: 2, LampPhase.COOLING: 3}

    def _take(self) -> bytes | None:
        received = self._received
        while received and (received[0] not in (0x06, 0x07) or (len(received) > 1 and received[1] != 0x14)):
            del received[0]
        return self._cut(received[3] + 6) if len(received) >= 5 else None

    def _answers(self, command: bytes, busy: bool) -> list[bytes]:
        if sum(command[1:-1]) & 0xFF != command[-1]:
            return []
        return [self._REFUSED if busy else self._reply(command)]

    def _reply(self, message: bytes) -> bytes:
        lamp = self._lamp
        if message[0] == 0x07:
            replies = {
                b"\x11\x00": struct.pack("<B", self._PHASES[lamp.phase]),
                b"\x15\x01": struct.pack("<I", lamp.hours),
                b"\x12\x09": struct.pack("<B", lamp.shutter_closed),
            }
            body = replies.get(message[8:10])
            return self._REFUSED if body is None else self._framed(b"\0\0" + body)
        item, value = message[6:8], message[8]
        if item == b"\x11\x00":
            return self._DONE if lamp.strike() else self._REFUSED
        if item == b"\x11\x01":
            lamp.extinguish()
            return self._DONE
        if item == b"\x12\x09" and lamp.burning:
            lamp.shutter_closed = value == 1
            return self._DONE
        return self._REFUSED

    @staticmethod
    def _framed(body: bytes) -> bytes:
        frame = b"\x05\x14" + struct.pack(">BBB", 0, len(body), 0) + body
        return frame + bytes([sum(frame[1:]) & 0xFF])
