"""Emulated USB adapters with GPIO lines, as their data sheets and the kernel's drivers know them.

``Cp2112`` (Silicon Labs AN495): eight lines; its driver has interrupts. ``Mcp2221`` (Microchip DS20005565): four lines,
without. ``levels``: what each line has now; ``looks``: how often levels were read. ``busy``: that many next looks are
answered with "not now".
"""

from __future__ import annotations

from typing import Final

from lab.emulated.usb.device import INTERRUPT, Endpoint, Stall, UsbNames
from lab.emulated.usb.hid import FEATURE, EmulatedHidDevice

_REPORTS: Final = (0x02, 0x03, 0x04, 0x05, 0x06, 0x20)
_CONFIG, _GET, _SET, _VERSION, _SMBUS, _LOCK = _REPORTS


def _collection(reports: bytes) -> bytes:
    return b"\x06\x00\xff\x09\x01\xa1\x01\x15\x00\x26\xff\x00\x75\x08" + reports + b"\xc0"


class Cp2112(EmulatedHidDevice):
    """Feature reports with numbers."""

    numbered = True
    endpoints = (Endpoint(0x81, INTERRUPT, 64), Endpoint(0x01, INTERRUPT, 64))
    hid_descriptor = _collection(
        b"".join(bytes((0x85, number, 0x95, 63, 0x09, number, 0xB1, 2)) for number in _REPORTS)
        + b"\x85\x16\x95\x3f\x09\x16\x81\x02\x85\x15\x95\x3f\x09\x15\x91\x02"
    )

    def __init__(self) -> None:
        super().__init__(UsbNames(0x10C4, 0xEA90, "Silicon Labs", "CP2112", "GPIO-1"))
        self.levels = [True] * 8
        self.looks = 0
        self._kept = {_CONFIG: bytes((_CONFIG, 0, 0, 0, 0)), _SMBUS: bytes((_SMBUS, *bytes(13)))}

    def get_report(self, kind: int, number: int) -> bytes:
        if kind != FEATURE:
            raise Stall
        if number == _GET:
            self.looks += 1
            return bytes((_GET, sum(level << line for line, level in enumerate(self.levels))))
        if number == _VERSION:
            return bytes((_VERSION, 0x0C, 0x02))
        if number == _LOCK:
            return bytes((_LOCK, 0xFF))
        if number not in self._kept:
            raise Stall
        return self._kept[number]

    def set_report(self, kind: int, number: int, data: bytes) -> None:
        if kind == FEATURE and number in self._kept:
            self._kept[number] = data


class Mcp2221(EmulatedHidDevice):
    """Commands and answers of 64 bytes without numbers."""

    endpoints = (Endpoint(0x83, INTERRUPT, 64), Endpoint(0x03, INTERRUPT, 64))
    hid_descriptor = _collection(b"\x95\x40\x09\x01\x81\x02\x95\x40\x09\x01\x91\x02")
    _STATUS, _SET_GPIO, _GET_GPIO, _GET_SETTINGS = 0x10, 0x50, 0x51, 0x61
    _INPUT, _BUSY, _UNKNOWN = 1, 1, 1

    def __init__(self) -> None:
        super().__init__(UsbNames(0x04D8, 0x00DD, "Microchip", "MCP2221", "GPIO-2"))
        self.levels = [True] * 4
        self.looks = self.busy = 0
        self._directions = [self._INPUT] * 4

    def out(self, endpoint: int, data: bytes) -> None:
        command, told = data[0], bytearray(64)
        told[0] = command
        if command == self._GET_GPIO and self.busy > 0:
            self.busy -= 1
            told[1] = self._BUSY
        elif command == self._GET_GPIO:
            self.looks += 1
            for line, (level, direction) in enumerate(zip(self.levels, self._directions, strict=True)):
                told[2 + 2 * line : 4 + 2 * line] = level, direction
        elif command == self._SET_GPIO:
            told[2:18] = data[2:18]
            for line in range(4):
                if data[4 + 4 * line]:
                    self._directions[line] = data[5 + 4 * line]
        elif command == self._GET_SETTINGS:
            # Each pin is a GPIO. A driver without one asks for this ten times a second, for ever.
            told[22:26] = bytes(direction << 3 for direction in self._directions)
        elif command != self._STATUS:
            told[1] = self._UNKNOWN
        self.send(0x83, bytes(told))
