"""Emulated HID devices from their firmware's side: relay board, light sensor, key panel.

A relay board of the USBRelayN family (16c0:05df), a ColorHug ALS (273f:1008) that tells ambient light through the HID
sensor usages, and a Stream Deck (0fd9:0080, fifteen keys with pictures), written from the maker's description of its
reports, as the Python library ``streamdeck`` also uses them.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from lab.emulated.usb.device import INTERRUPT, Endpoint, Stall, UsbNames
from lab.emulated.usb.hid import FEATURE, INPUT, OUTPUT, EmulatedHidDevice

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


LUX_AT_WHITE: Final = 400.0
"""Illuminance for one unit of the bench's linear light: projectors of this class at white, at a metre."""
_LUX_UNIT: Final = 0.01
_READY, _CHANGED = 2, 2
"""State of a sensor that works, and the event "data has changed"."""
_FULL_POWER: Final = 2


class EmulatedLightSensor(EmulatedHidDevice):
    """Reports ``lux`` when asked, and by itself whenever it changes while it is at full power."""

    numbered = True
    # Collection "Sensor: Environmental: Light" with feature and input report 1 (HID usage page 0x20).
    hid_descriptor = bytes.fromhex(
        "05200941a10085010a09031500250275089501b1020a16031500250575089501b1020a19031500250575089501b102"
        "0a01021500250675089501b1020a0e0315002700ffffff75209501b102"
        "0a01021500250675089501810 20a02021500250575089501810 20ad1041500 27ffffff7f75209501550e8102c0".replace(" ", "")
    )
    wrongs: Mapping[str, tuple[Any, ...]] = {"lux": (300.0,), "state": (5, 7, 9)}
    """A bright room; "initializing" for ever, "error", and a state that does not exist."""

    def __init__(self, *, lux: float = 0.5, serial: str = "") -> None:
        super().__init__(UsbNames(0x273F, 0x1008, "Hughski Ltd.", "ColorHugALS", serial))
        self._lux = lux
        self.state = _READY
        """The state that it reports with each reading; 5 is "initializing"."""
        self.settings = (0, 0, 0, 0, 0)
        """Connection, reporting, power, state, interval in ms."""

    @property
    def lux(self) -> float:
        return self._lux

    @lux.setter
    def lux(self, lux: float) -> None:
        self._lux = lux
        if self.settings[2] == _FULL_POWER:
            self.input(self._reading())

    def follow(self, stage: str) -> float:
        """See the ambient light of an emulated stage, with its bumps, as it is now; the lux. Raises DeviceError."""
        # Here: the bench's geometry is slow to load, and few who have a bus have a bench.
        from lab.emulated.bumps import bumped, read_bumps
        from plugins.emulated.core.truth import BUMPS_FILE, read_truth

        folder = Path(stage)
        set_up = read_truth(folder)
        truth = bumped(set_up, read_bumps(folder / BUMPS_FILE, set_up))
        self.lux = LUX_AT_WHITE * sum(truth.ambient) / len(truth.ambient)
        return self.lux

    def plugged(self) -> None:
        super().plugged()
        self.settings = (0, 0, 0, 0, 0)

    def get_report(self, kind: int, number: int) -> bytes:
        if number != 1 or kind not in (INPUT, FEATURE):
            raise Stall
        return self._reading() if kind == INPUT else struct.pack("<BBBBBI", 1, *self.settings)

    def set_report(self, kind: int, number: int, data: bytes) -> None:
        if kind != FEATURE or number != 1 or len(data) < 9:
            raise Stall
        _, *settings = struct.unpack("<BBBBBI", data[:9])
        connection, reporting, power, state, interval = settings
        self.settings = (connection, reporting, power, state, interval)

    def _reading(self) -> bytes:
        return struct.pack("<BBBI", 1, self.state, _CHANGED, max(0, round(self._lux / _LUX_UNIT)))


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
