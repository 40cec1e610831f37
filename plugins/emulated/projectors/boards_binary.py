"""What projectors of counted protocols do with the bytes on their serial line: NEC and Optoma's EP910.

Each is written from the makers' command lists (docs/reference/projectors.md) and shares no parser with the driver,
so that a common mistake would show. Bytes in, bytes out; the lamp is the only state they act on.
"""

from __future__ import annotations

import struct
from typing import Final

from plugins.emulated.projectors.lamp import EmulatedLamp, LampPhase


class NecBoard:
    """The binary protocol: five bytes of header, of which the last counts the data, the data, and the sum.

    ``lens_shutter``: a model that has one; ``heard``: the codes of the commands that it read.
    """

    _OPERATION: Final = {LampPhase.STANDBY: 0x00, LampPhase.WARMING: 0x04, LampPhase.LIT: 0x04, LampPhase.COOLING: 0x05}

    def __init__(
        self, lamp: EmulatedLamp, *, projector_id: int = 1, model_code: int = 0x31, lens_shutter: bool = False
    ) -> None:
        self._lamp = lamp
        self._shutters = (b"\x02\x10", b"\x02\x11") + ((b"\x02\x16", b"\x02\x17") if lens_shutter else ())
        self.heard: list[bytes] = []
        self._ids = bytes([projector_id, model_code])
        self._buffer = bytearray()

    def feed(self, data: bytes, *, busy: bool = False) -> list[bytes]:
        answers = []
        self._buffer += data
        while (command := self._taken()) is not None:
            if sum(command[:-1]) & 0xFF == command[-1]:
                answers.append(self._reply(command, busy))
        return answers

    def notices(self) -> list[bytes]:
        return []

    def _taken(self) -> bytes | None:
        """The next whole command; bytes that begin none are noise."""
        while self._buffer and self._buffer[0] > 0x03:
            del self._buffer[0]
        if len(self._buffer) < 5 or len(self._buffer) < self._buffer[4] + 6:
            return None
        length = self._buffer[4] + 6
        command = bytes(self._buffer[:length])
        del self._buffer[:length]
        return command

    def _reply(self, command: bytes, busy: bool) -> bytes:
        data = None if busy else self._act(command[:2], command[5:-1])
        first = command[0] | (0xA0 if data is None else 0x20)
        data = b"\x02\x0d" if data is None else data
        frame = bytes([first, command[1]]) + self._ids + bytes([len(data)]) + data
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


class Ep910Board:
    """Optoma EP910: ``IR``, two hexadecimal digits that count the rest, three of the command, data.

    Of its commands only those of the first page of its table are known, and here only AV mute.
    """

    def __init__(self, lamp: EmulatedLamp) -> None:
        self._lamp = lamp
        self._buffer = bytearray()

    def feed(self, data: bytes, *, busy: bool = False) -> list[bytes]:
        self._buffer += data
        answers = []
        while (start := self._buffer.find(b"IR")) >= 0:
            del self._buffer[:start]
            try:
                length = 4 + int(self._buffer[2:4], 16) if len(self._buffer) >= 4 else 1 << 20
            except ValueError:
                del self._buffer[:2]
                continue
            if len(self._buffer) < length:
                break
            answers.append(self._reply(bytes(self._buffer[4:length]), busy))
            del self._buffer[:length]
        return answers

    def notices(self) -> list[bytes]:
        return []

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
