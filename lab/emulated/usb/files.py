"""An open ``/dev/bus/usb`` file: Linux' usbfs calls on an emulated device (include/uapi/linux/usbdevice_fs.h)."""

from __future__ import annotations

import contextlib
import enum
import errno
import struct
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

from lab.emulated.usb.device import EmulatedUsbDevice, SetupPacket, Stall
from lab.emulated.usb.umockdev_server import CallFailed, Memory


class _Call(enum.IntEnum):
    """Numbers of the calls, within the letter "U"."""

    RESET_EP = 3
    SET_INTERFACE = 4
    SET_CONFIGURATION = 5
    GET_DRIVER = 8
    SUBMIT = 10
    DISCARD = 11
    REAP = 12
    REAP_NOW = 13
    CLAIM = 15
    RELEASE = 16
    DRIVER_CALL = 18
    RESET = 20
    CLEAR_HALT = 21
    DISCONNECT = 22
    CONNECT = 23
    CAPABILITIES = 26
    SPEED = 31


# Zero packets, urbs of any size, and reaping after an unplug.
_ABLE: Final = 0x01 | 0x04 | 0x10
_HIGH_SPEED: Final = 3
_URB: Final = struct.Struct("<BBxxiIxxxxQiiiiiIQ")
_CONTROL_URB: Final = 2
_SETUP: Final = struct.Struct("<BBHHH")


@dataclass(slots=True, eq=False)
class Urb:
    """One transfer that a program has submitted; ``result`` once it is done: (status, bytes that moved)."""

    address: int
    kind: int
    endpoint: int
    buffer: int
    length: int
    setup: SetupPacket | None = None
    data: bytes = b""
    ready_at: float = 0.0
    lost: bool = False
    result: tuple[int, int] = (0, 0)
    answer: bytes | memoryview = field(default=b"")


class Plugged:
    """A device while it is on the bus, shared by all who have it open."""

    def __init__(self, device: EmulatedUsbDevice) -> None:
        self.device = device
        self.lock = device.lock
        self.gone = False
        self.driver_bound = bool(device.kernel_driver)
        self.claimed_by: UsbFile | None = None
        self.files: list[UsbFile] = []
        self._pumping = self._again = False
        self.on_completed: Callable[[bool], None] = lambda waiting: None
        device.on_ready = self.pump

    def open(self) -> UsbFile:
        file = UsbFile(self)
        with self.lock:
            self.files.append(file)
        return file

    def pump(self) -> None:
        """Complete whatever can be completed."""
        with self.lock:
            self._again = True
            if self._pumping:  # a device that answers at once calls this from within
                return
            self._pumping = True
            try:
                while self._again:
                    self._again = False
                    for file in tuple(self.files):
                        file.pump()
            finally:
                self._pumping = False
            self.show()

    def show(self) -> None:
        self.on_completed(any(file.done for file in self.files))

    def leave(self) -> None:
        """Unplugged: every transfer ends, and no call works any more."""
        with self.lock:
            self.gone = True
            for file in self.files:
                file.end_all(-errno.ESHUTDOWN)
            self.show()


class UsbFile:
    """One program's open file (``umockdev_server.OpenFile``)."""

    def __init__(self, plugged: Plugged) -> None:
        self._plugged = plugged
        self._device = plugged.device
        self._pending: list[Urb] = []
        self.done: deque[Urb] = deque()

    def read(self, address: int, count: int, memory: Memory) -> int:
        raise CallFailed(errno.EINVAL)

    def write(self, address: int, count: int, memory: Memory) -> int:
        raise CallFailed(errno.EINVAL)

    def ioctl(self, request: int, argument: int, memory: Memory) -> int:
        number = request & 0xFF
        with self._plugged.lock:
            if self._plugged.gone and number not in (_Call.REAP, _Call.REAP_NOW):
                raise CallFailed(errno.ENODEV)
            if request >> 8 & 0xFF != ord("U"):
                raise CallFailed(errno.ENOTTY)
            match number:
                case _Call.SUBMIT:
                    self._submit(argument, memory)
                case _Call.DISCARD:
                    self._discard(argument)
                case _Call.REAP | _Call.REAP_NOW:
                    self._reap(argument, memory)
                case _Call.CAPABILITIES:
                    memory.poke(argument, struct.pack("<I", _ABLE))
                case _Call.SPEED:
                    return _HIGH_SPEED
                case _:
                    return self._manage(number, argument, memory)
        return 0

    def closed(self) -> None:
        with self._plugged.lock:
            self._pending.clear()
            self.done.clear()
            if self._plugged.claimed_by is self:
                self._plugged.claimed_by = None
            if self in self._plugged.files:
                self._plugged.files.remove(self)
            self._plugged.show()

    def pump(self) -> None:
        """Try every pending transfer; those of one endpoint keep their order."""
        blocked: set[int] = set()
        now = time.monotonic()
        for urb in tuple(self._pending):
            if urb.endpoint in blocked:
                continue
            if urb.lost or self._device.faults.silent or urb.ready_at > now or not self._attempt(urb):
                blocked.add(urb.endpoint)
                continue
            if urb in self._pending:  # the device may have left because of it
                self._pending.remove(urb)
                self.done.append(urb)

    def end_all(self, status: int) -> None:
        for urb in self._pending:
            urb.result = (status, 0)
            self.done.append(urb)
        self._pending.clear()

    def _manage(self, number: int, argument: int, memory: Memory) -> int:
        """Interfaces, drivers, halts: what has no transfer of its own."""
        plugged = self._plugged
        if number == _Call.CLAIM:
            if plugged.driver_bound or plugged.claimed_by not in (None, self):
                raise CallFailed(errno.EBUSY)
            plugged.claimed_by = self
        elif number == _Call.RELEASE:
            if plugged.claimed_by is self:
                plugged.claimed_by = None
        elif number == _Call.GET_DRIVER:
            if not plugged.driver_bound:
                raise CallFailed(errno.ENODATA)
            memory.poke(argument + 4, self._device.kernel_driver.encode() + b"\0")
        elif number == _Call.DRIVER_CALL:
            return self._driver_call(struct.unpack("<iiQ", memory.peek(argument, 16))[1] & 0xFF)
        elif number in (_Call.CLEAR_HALT, _Call.RESET_EP):
            self._device.clear_halt(struct.unpack("<I", memory.peek(argument, 4))[0])
        elif number == _Call.RESET:
            self._device.plugged()
        elif number not in (_Call.SET_INTERFACE, _Call.SET_CONFIGURATION):
            raise CallFailed(errno.ENOTTY)
        return 0

    def _driver_call(self, number: int) -> int:
        """As Linux: whether there is a driver that was connected, and 0 for disconnecting."""
        if number == _Call.DISCONNECT:
            if not self._plugged.driver_bound:
                raise CallFailed(errno.ENODATA)
            self._plugged.driver_bound = False
        elif number == _Call.CONNECT:
            self._plugged.driver_bound = bool(self._device.kernel_driver)
            return int(self._plugged.driver_bound)
        else:
            raise CallFailed(errno.ENOTTY)
        return 0

    def _submit(self, address: int, memory: Memory) -> None:
        kind, endpoint, _, _, buffer, length, *_ = _URB.unpack(memory.peek(address, _URB.size))
        urb = Urb(address, kind, endpoint, buffer, length)
        if kind == _CONTROL_URB:
            urb.setup = SetupPacket(*_SETUP.unpack(memory.peek(buffer, _SETUP.size)))
            if not urb.setup.to_host:
                urb.data = memory.peek(buffer + _SETUP.size, length - _SETUP.size)
            self._device.on_control(length)
            urb.lost = self._device.faults.take("drop")
        elif self._plugged.claimed_by is not self or endpoint not in {one.address for one in self._device.endpoints}:
            raise CallFailed(errno.ENOENT)
        elif not endpoint & 0x80:
            urb.data = memory.peek(buffer, length)
        if slow_s := self._device.faults.slow_s:
            urb.ready_at = time.monotonic() + slow_s
            waiting = threading.Timer(slow_s + 0.005, self._plugged.pump)
            waiting.daemon = True
            waiting.start()
        self._pending.append(urb)
        self._plugged.pump()

    def _attempt(self, urb: Urb) -> bool:
        """Try one transfer; False while the device has nothing to say."""
        try:
            if urb.setup is not None:
                urb.answer = self._device.control(urb.setup, urb.data)
                urb.result = (0, len(urb.answer) if urb.setup.to_host else len(urb.data))
            elif urb.endpoint & 0x80:
                if (data := self._device.pipes[urb.endpoint].take(urb.length)) is None:
                    return False
                urb.answer, urb.result = data, (0, len(data))
            else:
                self._device.out(urb.endpoint, urb.data)
                urb.result = (0, len(urb.data))
        except Stall:
            urb.result = (-errno.EPIPE, 0)
        return True

    def _discard(self, address: int) -> None:
        for urb in self._pending:
            if urb.address == address:
                urb.result = (-errno.ENOENT, 0)
                self._pending.remove(urb)
                self.done.append(urb)
                self._plugged.show()
                return
        raise CallFailed(errno.EINVAL)

    def _reap(self, pointer: int, memory: Memory) -> None:
        """Hand one finished transfer back, as the kernel does: data, then the counts, then which one it was."""
        if not self.done:
            raise CallFailed(errno.ENODEV if self._plugged.gone else errno.EAGAIN)
        urb = self.done.popleft()
        status, moved = urb.result
        if urb.answer:
            memory.poke(urb.buffer + (_SETUP.size if urb.setup is not None else 0), urb.answer)
        memory.poke(urb.address + 4, struct.pack("<i", status))
        memory.poke(urb.address + 28, struct.pack("<i", moved))
        memory.poke(urb.address + 40, struct.pack("<i", 0))
        memory.poke(pointer, struct.pack("<Q", urb.address))
        with contextlib.suppress(OSError):
            self._plugged.show()
