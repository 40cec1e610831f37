"""An emulated USB relay board of the USBRelayN family (16c0:05df), from its firmware's side."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from plugins.emulated.usb.device import Stall, UsbNames
from plugins.emulated.usb.hid import FEATURE, EmulatedHidDevice

_ON, _OFF, _ALL_ON, _ALL_OFF, _SET_SERIAL = 0xFF, 0xFD, 0xFE, 0xFC, 0xFA
_SERIAL_LENGTH: Final = 5


class EmulatedRelayBoard(EmulatedHidDevice):
    """``channels`` relays, all open after power-on; ``serial`` is five characters in its memory.

    ``stuck``: channels (1-based) whose contacts are welded and do not move any more. ``switched``: how often each
    channel has really moved; without power from USB all of them are open.
    """

    hid_descriptor = bytes.fromhex("0600ff0901a1010902150026ff00750895080902b102c0")
    wrongs: Mapping[str, tuple[Any, ...]] = {"stuck": ([1], [1, 2])}

    def __init__(self, *, channels: int = 2, serial: str = "BITFT") -> None:
        super().__init__(UsbNames(0x16C0, 0x05DF, "www.dcttech.com", f"USBRelay{channels}"))
        self.channels = channels
        self.serial = serial
        self.stuck: list[int] = []
        self.switched = [0] * channels
        self._closed = [False] * channels
        self._moves: list[tuple[int, bool]] = []

    @property
    def state(self) -> list[bool]:
        """Which relays pass current, channel 1 first."""
        return list(self._closed)

    def moves_since(self, count: int) -> list[tuple[int, bool]]:
        """Every (channel, closed) after the first ``count`` of them."""
        with self.lock:
            return self._moves[count:]

    def unplugged(self) -> None:
        for channel, closed in enumerate(self._closed, start=1):
            if closed and channel not in self.stuck:
                self._closed[channel - 1] = False
                self._moves.append((channel, False))

    def get_report(self, kind: int, number: int) -> bytes:
        if kind != FEATURE:
            raise Stall
        bits = sum(1 << channel for channel, closed in enumerate(self._closed) if closed)
        return self.serial.encode("ascii").ljust(_SERIAL_LENGTH, b"\0") + bytes([0, 0, bits])

    def set_report(self, kind: int, number: int, data: bytes) -> None:
        if len(data) < 2:
            raise Stall
        command, channel = data[0], data[1]
        if command in (_ALL_ON, _ALL_OFF):
            for each in range(1, self.channels + 1):
                self._move(each, command == _ALL_ON)
        elif command in (_ON, _OFF) and 1 <= channel <= self.channels:
            self._move(channel, command == _ON)
        elif command == _SET_SERIAL:
            self.serial = data[1 : 1 + _SERIAL_LENGTH].decode("ascii", errors="replace")
        # Any other command is ignored, as the firmware does.

    def _move(self, channel: int, closed: bool) -> None:
        if channel not in self.stuck and self._closed[channel - 1] is not closed:
            self._closed[channel - 1] = closed
            self.switched[channel - 1] += 1
            self._moves.append((channel, closed))
