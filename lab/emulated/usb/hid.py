"""Emulated HID devices, and an open ``/dev/hidraw`` file on one (HID 1.11; include/uapi/linux/hidraw.h)."""

from __future__ import annotations

import enum
import errno
import struct
import time
from collections import deque
from collections.abc import Callable
from typing import Final

from lab.emulated.usb.device import INTERRUPT, EmulatedUsbDevice, Endpoint, SetupPacket, Stall, UsbNames
from lab.emulated.usb.umockdev_server import CallFailed, Memory

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

    endpoints: tuple[Endpoint, ...] = (Endpoint(0x81, INTERRUPT, 64),)

    def __init__(self, names: UsbNames) -> None:
        super().__init__(names)
        self.listeners: list[Callable[[bytes], None]] = []
        """Called with every input report, under the device's lock or not."""

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
        """Send an input report to every listener."""
        self.send(0x81, report)
        for listener in tuple(self.listeners):
            listener(report)

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


class _Call(enum.IntEnum):
    """Numbers of hidraw's calls, within the letter "H"."""

    DESCRIPTOR_SIZE = 1
    DESCRIPTOR = 2
    INFO = 3
    NAME = 4
    SET_FEATURE = 6
    GET_FEATURE = 7
    SERIAL = 8
    GET_INPUT = 10
    SET_OUTPUT = 11


class HidrawFile:
    """One program's open hidraw file (``umockdev_server.OpenFile``)."""

    def __init__(self, device: EmulatedHidDevice, show_readable: Callable[[bool], None]) -> None:
        self._device = device
        self._show = show_readable
        self._waiting: deque[bytes] = deque(maxlen=_MOST_WAITING)
        self.gone = False
        device.listeners.append(self._queue)

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
        return self._set(OUTPUT, memory.peek(address, count))

    def ioctl(self, request: int, argument: int, memory: Memory) -> int:
        """Do one call; ``request`` holds its number, the letter "H" and the length of ``argument``'s buffer."""
        number, length = request & 0xFF, request >> 16 & 0x3FFF
        if request >> 8 & 0xFF != ord("H"):
            raise CallFailed(errno.ENOTTY)
        self._check()
        names = self._device.names
        match number:
            case _Call.DESCRIPTOR_SIZE:
                memory.poke(argument, struct.pack("<I", len(self._device.hid_descriptor)))
            case _Call.DESCRIPTOR:
                size = min(struct.unpack("<I", memory.peek(argument, 4))[0], _DESCRIPTOR_ROOM)
                memory.poke(argument + 4, self._device.hid_descriptor[:size])
            case _Call.INFO:
                memory.poke(argument, struct.pack("<IHH", _BUS_USB, names.vendor, names.product))
            case _Call.NAME | _Call.SERIAL:
                text = f"{names.maker} {names.model}" if number == _Call.NAME else names.serial
                data = text.encode()[: length - 1] + b"\0"
                memory.poke(argument, data)
                return len(data)
            case _Call.SET_FEATURE | _Call.SET_OUTPUT:
                kind = FEATURE if number == _Call.SET_FEATURE else OUTPUT
                return self._set(kind, memory.peek(argument, length))
            case _Call.GET_FEATURE | _Call.GET_INPUT:
                return self._get(FEATURE if number == _Call.GET_FEATURE else INPUT, argument, length, memory)
            case _:
                raise CallFailed(errno.ENOTTY)
        return 0

    def closed(self) -> None:
        with self._device.lock:
            self._device.listeners.remove(self._queue)

    def _check(self) -> None:
        if self.gone:
            raise CallFailed(errno.ENODEV)

    def _queue(self, report: bytes) -> None:
        with self._device.lock:
            self._waiting.append(report)
            self._show(True)

    def _set(self, kind: int, data: bytes) -> int:
        """Report number 0 means: this device has no numbers, and the byte is not sent. Returns the bytes taken."""
        self._check()
        self._transfer(SetupPacket(0x21, _SET_REPORT, kind << 8 | data[0], 0, len(data)), data if data[0] else data[1:])
        return len(data)

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
