"""An emulated Stream Deck (0fd9:0080, fifteen keys with pictures), from its firmware's side.

Written from the maker's description of its HID reports, as the Python library ``streamdeck`` also uses them.
"""

from __future__ import annotations

import struct
from typing import Final

from plugins.emulated.usb.device import INTERRUPT, Endpoint, Stall, UsbNames
from plugins.emulated.usb.hid import FEATURE, OUTPUT, EmulatedHidDevice

_KEYS: Final = 15
_INPUT_LENGTH: Final = 512
_FEATURE_LENGTH: Final = 32
_PICTURE: Final = struct.Struct("<BBBBHH")
_LARGEST_PICTURE: Final = 1 << 20


class EmulatedKeyPanel(EmulatedHidDevice):
    """``pictures``: the JPEG file on each key, b"" for none; ``brightness`` in percent."""

    numbered = True
    endpoints = (Endpoint(0x81, INTERRUPT, 512), Endpoint(0x02, INTERRUPT, 1024))
    # Consumer control; input report 1 of 511 bytes, output report 2 of 1023, feature reports 3, 5 and 6 of 31.
    hid_descriptor = bytes.fromhex(
        "050c0901a101 0900150026ff007508 850196ff018102 0900850296ff039102"
        "0900850395 1fb102 0900850595 1fb102 0900850695 1fb102 c0".replace(" ", "")
    )

    def __init__(self, *, serial: str = "AL12K1A00001", firmware: str = "1.00.012") -> None:
        super().__init__(UsbNames(0x0FD9, 0x0080, "Elgato", "Stream Deck MK.2", serial))
        self.firmware = firmware
        self.pictures = [b""] * _KEYS
        self.brightness = 50
        self._pressed = [False] * _KEYS
        self._arriving = b""

    def plugged(self) -> None:
        super().plugged()
        self.pictures = [b""] * _KEYS
        self._pressed = [False] * _KEYS
        self._arriving = b""

    def press(self, key: int) -> None:
        """A finger goes down on ``key`` and up again."""
        for down in (True, False):
            self.hold(key, down)

    def hold(self, key: int, down: bool) -> None:
        self._pressed[key] = down
        self.input(struct.pack("<BBH", 1, 0, _KEYS).ljust(4) + bytes(self._pressed) + bytes(_INPUT_LENGTH - 4 - _KEYS))

    def picture_of(self, key: int) -> str:
        """The JPEG file on ``key`` in hexadecimal digits."""
        return self.pictures[key].hex()

    def get_report(self, kind: int, number: int) -> bytes:
        if kind != FEATURE:
            raise Stall
        if number == 5:
            text = self.firmware.encode()
            return (bytes([5, len(text) + 4, 0, 0, 0, 0]) + text).ljust(_FEATURE_LENGTH, b"\0")
        if number == 6:
            text = self.names.serial.encode()
            return (bytes([6, len(text)]) + text).ljust(_FEATURE_LENGTH, b"\0")
        raise Stall

    def set_report(self, kind: int, number: int, data: bytes) -> None:
        if kind == OUTPUT and number == 2:
            self._page(data)
        elif kind == FEATURE and number == 3 and len(data) >= 3:
            if data[1] == 2:
                self.pictures = [b""] * _KEYS
            elif data[1] == 8:
                self.brightness = min(data[2], 100)
        else:
            raise Stall

    def _page(self, data: bytes) -> None:
        """One page of a picture; a page out of order starts a new one, and one without command clears it."""
        if len(data) < _PICTURE.size or data[1] != 7:
            self._arriving = b""
            return
        _, _, key, last, length, page = _PICTURE.unpack(data[: _PICTURE.size])
        if page == 0:
            self._arriving = b""
        self._arriving += data[_PICTURE.size :][:length]
        if key >= _KEYS or len(self._arriving) > _LARGEST_PICTURE:
            raise Stall
        if last:
            self.pictures[key], self._arriving = self._arriving, b""
