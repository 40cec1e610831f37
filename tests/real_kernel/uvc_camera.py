"""An emulated USB camera (UVC 1.1) with a bulk pipe: a linear sensor behind what webcams do by themselves."""

from __future__ import annotations

import io
import re
import struct
import threading
from typing import Final

import numpy as np
import numpy.typing as npt

from lab.emulated.usb.device import BULK, EmulatedUsbDevice, Endpoint, SetupPacket, Stall, UsbNames

WIDTH, HEIGHT = 64, 48
INTERVAL_S: Final = 0.1
FULL: Final = 4095
"""The converter has 12 bits, whatever the format says."""
BLACK: Final = 64
Y16, BGGR8, YUYV, MJPEG = range(1, 5)
_CODES: Final = {Y16: b"Y16 ", BGGR8: b"BA81", YUYV: b"YUY2"}
_GUID_END: Final = bytes.fromhex("0000100080 0000aa00389b71")
_BITS: Final = {Y16: 16, BGGR8: 8, YUYV: 16}
_CLASS: Final = 0x24
_SET_CUR, _GET_CUR, _GET_MIN, _GET_MAX, _GET_RES, _GET_LEN, _GET_INFO, _GET_DEF = 1, *range(0x81, 0x88)
_MODE, _TIME, _GAMMA = (1, 0x02), (1, 0x04), (2, 0x09)
"""Controls by entity and selector: mode of the exposure, its time in 0.1 ms, gamma in hundredths."""
_RANGES: Final = {_MODE: (1, 9, 9, 8), _TIME: (1, 10000, 1, 156), _GAMMA: (72, 500, 1, 220)}
"""Lowest, highest, step (the modes that it has: manual 1, automatic 8), at the beginning."""
_SIZES: Final = {_MODE: 1, _TIME: 4, _GAMMA: 2}
_PROBE: Final = struct.Struct("<HBBIHHHHHIIIBBBB")


class UvcCamera(EmulatedUsbDevice):
    """``scene``: electrons a second (rows, columns); ``light``: factor of it now.

    A new exposure acts on the frame after the next, as in sensors. ``cut``, ``bad``: that many next frames are too
    short, or are marked as faulty.
    """

    endpoints = (Endpoint(0x81, BULK, 512),)

    def __init__(self, serial: str = "UVC-7") -> None:
        super().__init__(UsbNames(0x1D6B, 0x0102, "Acme", "Emulated webcam", serial))
        self.scene: npt.NDArray[np.float64] = np.full((HEIGHT, WIDTH), 20000.0)
        self.light = 1.0
        self.values = {key: ranges[3] for key, ranges in _RANGES.items()}
        self.cut = self.bad = 0
        self._dice = np.random.default_rng(4)
        self._exposures = [self._exposure_s()] * 3
        self._format = Y16
        self._streaming = threading.Event()
        self._frame_id = 0
        self._gone = threading.Event()

    def plugged(self) -> None:
        super().plugged()
        self.values = {key: ranges[3] for key, ranges in _RANGES.items()}
        self._streaming.clear()
        self._gone = threading.Event()
        threading.Thread(target=self._run, args=[self._gone], daemon=True).start()

    def unplugged(self) -> None:
        self._gone.set()

    def clear_halt(self, endpoint: int) -> None:
        """The host does this when it stops the pictures of a bulk pipe."""
        self._streaming.clear()
        self.pipes[0x81].clear()

    def _run(self, gone: threading.Event) -> None:
        while not gone.wait(INTERVAL_S):
            with self.lock:
                self._exposures = [*self._exposures[1:], self._exposure_s()]
                if self._streaming.is_set() and self.pipes[0x81].empty:
                    self._frame_id ^= 1
                    info = 0x82 | self._frame_id | (0x40 if self._take("bad") else 0)
                    frame = self._frame()
                    self.send(0x81, bytes((2, info)) + (frame[: len(frame) // 2] if self._take("cut") else frame))

    def _take(self, name: str) -> bool:
        left: int = getattr(self, name)
        setattr(self, name, max(0, left - 1))
        return left > 0

    def _exposure_s(self) -> float:
        """An automatic one makes the picture half as bright as it can be."""
        if self.values[_MODE] == 1:
            return self.values[_TIME] * 1e-4
        return float(FULL / 2 / max(1e-6, self.light * self.scene.mean()))

    def _frame(self) -> bytes:
        electrons = self.light * self.scene * self._exposures[0]
        noise = self._dice.standard_normal(electrons.shape)
        counts = np.clip(np.rint(electrons + BLACK + np.sqrt(electrons + 4) * noise), 0, FULL)
        if self.values[_GAMMA] != 100:
            counts = np.rint(FULL * (counts / FULL) ** (100 / self.values[_GAMMA]))
        if self._format == Y16:
            return counts.astype("<u2").tobytes()
        grey = (counts * (255 / FULL)).astype(np.uint8)
        if self._format == BGGR8:
            return grey.tobytes()
        if self._format == YUYV:
            return np.stack([grey, np.full_like(grey, 128)], axis=-1).tobytes()
        return _motion_jpeg(grey)

    def class_request(self, setup: SetupPacket, data: bytes) -> bytes:
        selector, entity, interface = setup.value >> 8, setup.index >> 8, setup.index & 0xFF
        if interface == 1 and selector in (1, 2):
            return self._negotiate(setup, selector, data)
        key = (entity, selector)
        if key not in _RANGES:
            raise Stall
        if setup.request == _SET_CUR:
            self.values[key] = int.from_bytes(data, "little")
            return b""
        if setup.request == _GET_INFO:
            return b"\x03"
        if setup.request == _GET_LEN:
            return _SIZES[key].to_bytes(2, "little")
        lowest, highest, step, first = _RANGES[key]
        told = {_GET_CUR: self.values[key], _GET_MIN: lowest, _GET_MAX: highest, _GET_RES: step, _GET_DEF: first}
        return told[setup.request].to_bytes(_SIZES[key], "little")

    def _negotiate(self, setup: SetupPacket, selector: int, data: bytes) -> bytes:
        """Probe and commit (4.3.1.1)."""
        if setup.request == _SET_CUR:
            self._format = min(max(data[2], Y16), MJPEG)
            if selector == 2:
                self.pipes[0x81].clear()
                self._streaming.set()
            return b""
        if setup.request == _GET_INFO:
            return b"\x03"
        if setup.request == _GET_LEN:
            return _PROBE.size.to_bytes(2, "little")
        size = _frame_bytes(self._format)
        return _PROBE.pack(1, self._format, 1, _interval(), 0, 0, 0, 0, 0, size, size + 2, 48_000_000, 0, 0, 0, 0)

    def device_descriptor(self) -> bytes:
        made = bytearray(super().device_descriptor())
        made[4:7] = b"\xef\x02\x01"  # an interface association follows
        return bytes(made)

    def configuration_descriptor(self) -> bytes:
        units = (
            struct.pack("<BBBBHBBHHHB3s", 18, _CLASS, 2, 1, 0x0201, 0, 0, 0, 0, 0, 3, b"\x0a\0\0")
            + struct.pack("<BBBBBHB2sBB", 12, _CLASS, 5, 2, 1, 0, 2, b"\x20\0", 0, 0)
            + struct.pack("<BBBBHBBB", 9, _CLASS, 3, 3, 0x0101, 0, 2, 0)
        )
        head = struct.pack("<BBBHHIBB", 13, _CLASS, 1, 0x0110, 13 + len(units), 48_000_000, 1, 1)
        formats = b"".join(_described(number) for number in (Y16, BGGR8, YUYV, MJPEG))
        streams = struct.pack("<BBBBHBBBBBBB4s", 17, _CLASS, 1, 4, 17 + len(formats), 0x81, 0, 3, 0, 0, 0, 1, bytes(4))
        body = (
            struct.pack("<8B", 8, 0x0B, 0, 2, 0x0E, 3, 0, 0)
            + struct.pack("<9B", 9, 4, 0, 0, 0, 0x0E, 1, 0, 0) + head + units
            + struct.pack("<9B", 9, 4, 1, 0, 1, 0x0E, 2, 0, 0) + streams + formats
            + struct.pack("<BBBBHB", 7, 5, 0x81, BULK, 512, 0)
        )  # fmt: skip
        return struct.pack("<BBHBBBBB", 9, 2, 9 + len(body), 2, 1, 0, 0x80, 50) + body


def _interval() -> int:
    return round(INTERVAL_S * 1e7)


def _frame_bytes(code: int) -> int:
    return WIDTH * HEIGHT * (1 if code == BGGR8 else 2)


def _described(code: int) -> bytes:
    """A format and its only size."""
    if code == MJPEG:
        head = struct.pack("<11B", 11, _CLASS, 6, code, 1, 1, 1, 0, 0, 0, 0)
    else:
        guid = _CODES[code] + _GUID_END
        head = struct.pack("<BBBBB16sBBBBBB", 27, _CLASS, 4, code, 1, guid, _BITS[code], 1, 0, 0, 0, 0)
    size = _frame_bytes(code)
    rate = round(8 * size / INTERVAL_S)
    frame = struct.pack("<BBBBBHHIIIIBI", 30, _CLASS, 7 if code == MJPEG else 5, 1, 0, WIDTH, HEIGHT, rate, rate, size,
                        _interval(), 1, _interval())  # fmt: skip
    return head + frame


def _motion_jpeg(grey: npt.NDArray[np.uint8]) -> bytes:
    """Without Huffman tables, as many webcams send them."""
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(grey).convert("RGB").save(file, "JPEG", quality=90)
    data = file.getvalue()
    while (found := re.search(rb"\xff\xc4", data)) is not None:
        length = int.from_bytes(data[found.end() : found.end() + 2], "big")
        data = data[: found.start()] + data[found.end() + length :]
    return data
