"""Emulated HID devices, and an open ``/dev/hidraw`` file on one (HID 1.11; include/uapi/linux/hidraw.h)."""

from __future__ import annotations

import errno
import struct
import time
from collections import deque
from collections.abc import Callable
from typing import Final

from plugins.emulated.usb.device import INTERRUPT, EmulatedUsbDevice, Endpoint, SetupPacket, Stall
from plugins.emulated.usb.umockdev_server import CallFailed, Memory

INPUT, OUTPUT, FEATURE = 1, 2, 3
_GET_REPORT, _SET_REPORT, _SET_IDLE = 1, 9, 10
_BUS_USB: Final = 3
_DESCRIPTOR_ROOM: Final = 4096
_LOOK_S: Final = 0.01
_MOST_WAITING: Final = 64
"""Input reports that are kept for a program that does not read."""


class EmulatedHidDevice(EmulatedUsbDevice):
    """A HID device with one interrupt IN endpoint. Reports are whole, with their number where they have one."""

    interface_class = (3, 0, 0)
    kernel_driver = "usbhid"
    numbered = False
    """Whether its reports begin with their report number."""

    def __init_subclass__(cls) -> None:
        if not cls.endpoints:
            cls.endpoints = (Endpoint(0x81, INTERRUPT, 64),)

    def get_report(self, kind: int, number: int) -> bytes:
        """Hook: what the device answers to GET_REPORT. Raises Stall."""
        raise Stall

    def set_report(self, kind: int, number: int, data: bytes) -> None:
        """Hook: SET_REPORT, or an output report. Raises Stall."""
        raise Stall

    def out(self, endpoint: int, data: bytes) -> None:
        """Output reports of devices that have a pipe for them."""
        self.set_report(OUTPUT, data[0] if self.numbered and data else 0, data)

    def input(self, report: bytes) -> None:
        """Send an input report to whoever listens."""
        self.send(0x81, report)
        for listener in tuple(self._listeners):
            listener(report)

    def listen(self, listener: Callable[[bytes], None]) -> Callable[[], None]:
        """Have ``listener`` called with every input report, until the function that is returned is called."""
        self._listeners.append(listener)
        return lambda: self._listeners.remove(listener)

    @property
    def _listeners(self) -> list[Callable[[bytes], None]]:
        return self.__dict__.setdefault("_all_listeners", [])  # type: ignore[no-any-return]

    def class_request(self, setup: SetupPacket, data: bytes) -> bytes:
        # Both the interface and the device are accepted as recipient: real relay boards are asked either way.
        if setup.request_type >> 5 & 3 != 1:
            raise Stall
        kind, number = setup.value >> 8, setup.value & 0xFF
        if setup.request == _GET_REPORT and setup.to_host:
            return self.get_report(kind, number)
        if setup.request == _SET_REPORT and not setup.to_host:
            self.set_report(kind, number, data)
        elif setup.request != _SET_IDLE:
            raise Stall
        return b""


class HidrawFile:
    """One program's open hidraw file (``umockdev_server.OpenFile``)."""

    def __init__(self, device: EmulatedHidDevice, show_readable: Callable[[bool], None]) -> None:
        self._device = device
        self._show = show_readable
        self._waiting: deque[bytes] = deque(maxlen=_MOST_WAITING)
        self._forget = device.listen(self._heard)
        self.gone = False

    def read(self, address: int, count: int, memory: Memory) -> int:
        with self._device.lock:
            self._check()
            if not self._waiting:
                raise CallFailed(errno.EAGAIN)
            report = self._waiting.popleft()[:count]
            memory.poke(address, report)
            self._show(bool(self._waiting))
            return len(report)

    def write(self, address: int, count: int, memory: Memory) -> int:
        data = memory.peek(address, count)
        self._set(OUTPUT, data)
        return count

    def ioctl(self, request: int, argument: int, memory: Memory) -> int:
        number, length = request & 0xFF, request >> 16 & 0x3FFF
        if request >> 8 & 0xFF != ord("H"):
            raise CallFailed(errno.ENOTTY)
        self._check()
        names = self._device.names
        match number:
            case 1:
                memory.poke(argument, struct.pack("<I", len(self._device.hid_descriptor)))
            case 2:
                size = min(struct.unpack("<I", memory.peek(argument, 4))[0], _DESCRIPTOR_ROOM)
                memory.poke(argument + 4, self._device.hid_descriptor[:size])
            case 3:
                memory.poke(argument, struct.pack("<IHH", _BUS_USB, names.vendor, names.product))
            case 4 | 8:
                text = (f"{names.maker} {names.model}" if number == 4 else names.serial).encode()[: length - 1] + b"\0"
                memory.poke(argument, text)
                return len(text)
            case 6 | 11:
                self._set(FEATURE if number == 6 else OUTPUT, memory.peek(argument, length))
                return length
            case 7 | 10:
                return self._get(FEATURE if number == 7 else INPUT, argument, length, memory)
            case _:
                raise CallFailed(errno.ENOTTY)
        return 0

    def closed(self) -> None:
        with self._device.lock:
            self._forget()

    def _check(self) -> None:
        if self.gone:
            raise CallFailed(errno.ENODEV)

    def _heard(self, report: bytes) -> None:
        with self._device.lock:
            self._waiting.append(report)
            self._show(True)

    def _set(self, kind: int, data: bytes) -> None:
        """Report number 0 means: this device has no numbers, and the byte is not sent."""
        self._check()
        self._transfer(SetupPacket(0x21, _SET_REPORT, kind << 8 | data[0], 0, len(data)), data if data[0] else data[1:])

    def _get(self, kind: int, argument: int, length: int, memory: Memory) -> int:
        number = memory.peek(argument, 1)[0]
        skip = 0 if number else 1
        answer = self._transfer(SetupPacket(0xA1, _GET_REPORT, kind << 8 | number, 0, length - skip), b"")
        memory.poke(argument + skip, answer)
        return len(answer) + skip

    def _transfer(self, setup: SetupPacket, data: bytes) -> bytes:
        """What usbhid does for hidraw; the five seconds that it gives a silent device are not waited for here."""
        faults = self._device.faults
        self._device.on_control(8 + len(data))
        time.sleep(faults.slow_s)
        while faults.stuck:
            time.sleep(_LOOK_S)
        self._check()
        if faults.silent or faults.take("drop"):
            raise CallFailed(errno.ETIMEDOUT)
        try:
            with self._device.lock:
                return self._device.control(setup, data)
        except Stall:
            raise CallFailed(errno.EPIPE) from None
