"""An emulated USB device as its firmware sees it: descriptors, control requests and pipes (USB 2.0, chapter 9)."""

from __future__ import annotations

import struct
import threading
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final

from plugins.emulated.core.faults import FaultCounts

BULK, INTERRUPT = 2, 3
_DEVICE, _CONFIGURATION, _STRING, _INTERFACE, _ENDPOINT, _HID, _REPORT = 1, 2, 3, 4, 5, 0x21, 0x22
_LANGUAGES: Final = 0
_ENGLISH: Final = 0x0409


class Stall(Exception):
    """The device answers this request, or this pipe, with STALL."""


@dataclass(frozen=True, slots=True)
class SetupPacket:
    """The eight bytes that begin a control transfer."""

    request_type: int
    request: int
    value: int
    index: int
    length: int

    @property
    def to_host(self) -> bool:
        return bool(self.request_type & 0x80)


@dataclass(frozen=True, slots=True)
class Endpoint:
    """``address`` with 0x80 for IN; ``kind`` BULK or INTERRUPT; ``packet``: largest packet in bytes."""

    address: int
    kind: int
    packet: int


@dataclass(frozen=True, slots=True)
class UsbNames:
    """Who the device says it is; an empty serial number: it has none."""

    vendor: int
    product: int
    maker: str
    model: str
    serial: str = ""


@dataclass(slots=True)
class UsbFaults(FaultCounts):
    """Knobs, turned at any time; counts go down as they are used.

    ``silent``: nothing completes; ``slow_s`` before every transfer completes; ``stalls``, ``drop``, ``cut``,
    ``garble``: that many next control requests are stalled, never complete, or are answered with half of their bytes,
    or with noise; ``stuck``: the kernel's HID driver hangs, and a program's call in it with it;
    ``lingers_s``: so long it is still listed after its cable was pulled, as on a machine that is busy.
    """

    silent: bool = False
    slow_s: float = 0.0
    stalls: int = 0
    drop: int = 0
    cut: int = 0
    garble: int = 0
    stuck: bool = False
    lingers_s: float = 0.0

    def bent(self, answer: bytes) -> bytes:
        """An answer as it comes through."""
        if self.take("garble"):
            answer = bytes(byte ^ 0xA5 for byte in answer)
        return answer[: len(answer) // 2] if self.take("cut") else answer


class InPipe:
    """What waits in the device for one IN endpoint: whole transfers, each ended by a short packet.

    ``zero_packets``: whether a transfer that fills its last packet is followed by an empty one, as the standard wants.
    """

    def __init__(self, packet: int, *, zero_packets: bool = True, most: int | None = None) -> None:
        self._packet = packet
        self._zero_packets = zero_packets
        self._waiting: deque[memoryview] = deque(maxlen=most)
        self.halted = False

    def put(self, data: bytes | memoryview, *, whole: bool = True) -> None:
        """Queue one transfer; ``whole`` False: the next one continues it, with no short packet between them."""
        self._waiting.append(memoryview(bytes(data) if len(data) < self._packet else data))
        if whole and self._zero_packets and data and len(data) % self._packet == 0:
            self._waiting.append(memoryview(b""))

    @property
    def empty(self) -> bool:
        return not self._waiting

    def clear(self) -> None:
        self._waiting.clear()
        self.halted = False

    def take(self, length: int) -> bytes | memoryview | None:
        """The next up to ``length`` bytes, None while there is nothing. Raises Stall."""
        if self.halted:
            raise Stall
        if not self._waiting:
            return None
        first = self._waiting.popleft()
        if len(first) > length:
            self._waiting.appendleft(first[length:])
            return first[:length]
        if first and len(first) < length and len(first) % self._packet == 0 and self._waiting and not self._waiting[0]:
            self._waiting.popleft()  # the empty packet ends this very transfer
        return first


class EmulatedUsbDevice:
    """A device with one configuration and one interface; kinds override ``class_request`` and ``out``.

    ``lock`` guards all of it. ``on_ready`` is called, without the lock, when a pipe has got something. ``pull`` and
    ``push`` are set by the bus: the device's own way off it and back.
    """

    interface_class: tuple[int, int, int] = (0xFF, 0, 0)
    endpoints: tuple[Endpoint, ...] = ()
    hid_descriptor: bytes = b""
    kernel_driver: str = ""
    wrongs: Mapping[str, tuple[Any, ...]] = {}
    """Knobs outside ``faults``, and their values that cause a fault."""

    def __init__(self, names: UsbNames) -> None:
        self.names = names
        self.faults = UsbFaults()
        self.lock = threading.RLock()
        self.on_ready: Callable[[], None] = lambda: None
        self.on_control: Callable[[int], None] = lambda count: None
        self.pull: Callable[[], None] = lambda: None
        self.push: Callable[[], None] = lambda: None
        self.pipes = {one.address: InPipe(one.packet) for one in self.endpoints if one.address & 0x80}

    def plugged(self) -> None:
        """Hook: power has come; the state is new."""
        for pipe in self.pipes.values():
            pipe.clear()

    def unplugged(self) -> None:
        """Hook: power has gone."""

    def class_request(self, setup: SetupPacket, data: bytes) -> bytes:
        """Hook: a class or vendor request; the answer, b"" where the data went to the device. Raises Stall."""
        raise Stall

    def out(self, endpoint: int, data: bytes) -> None:
        """Hook: a transfer towards the device. Raises Stall."""
        raise Stall

    def send(self, endpoint: int, data: bytes | memoryview, *, whole: bool = True) -> None:
        """Offer one transfer to the computer."""
        with self.lock:
            self.pipes[endpoint].put(data, whole=whole)
        self.on_ready()

    def control(self, setup: SetupPacket, data: bytes) -> bytes:
        """Answer a control transfer. Raises Stall."""
        if self.faults.take("stalls"):
            raise Stall
        kind = setup.request_type >> 5 & 3
        answer = self._standard(setup) if kind == 0 else self.class_request(setup, data)
        return self.faults.bent(answer)[: setup.length]

    def clear_halt(self, endpoint: int) -> None:
        if endpoint in self.pipes:
            self.pipes[endpoint].halted = False

    def _standard(self, setup: SetupPacket) -> bytes:
        match setup.request_type, setup.request:
            case 0x80 | 0x81 | 0x82, 0:
                return b"\0\0"
            case 0x02, 1:
                self.clear_halt(setup.index)
                return b""
            case 0x80, 6:
                return self._descriptor(setup.value >> 8, setup.value & 0xFF)
            case 0x81, 6 if setup.value >> 8 == _REPORT and self.hid_descriptor:
                return self.hid_descriptor
            case 0x80, 8:
                return b"\1"
            case (0x00, 9) | (0x01, 11):
                return b""
            case _:
                raise Stall

    def _descriptor(self, kind: int, index: int) -> bytes:
        if kind == _DEVICE:
            return self.device_descriptor()
        if kind == _CONFIGURATION and index == 0:
            return self.configuration_descriptor()
        if kind == _STRING:
            if index == _LANGUAGES:
                return struct.pack("<BBH", 4, _STRING, _ENGLISH)
            texts = (self.names.maker, self.names.model, self.names.serial)
            if index <= len(texts) and texts[index - 1]:
                data = texts[index - 1].encode("utf-16-le")
                return bytes([2 + len(data), _STRING]) + data
        raise Stall

    def device_descriptor(self) -> bytes:
        names = self.names
        strings = (1 if names.maker else 0, 2 if names.model else 0, 3 if names.serial else 0)
        return struct.pack("<BBHBBBBHHHBBBB", 18, _DEVICE, 0x0200, 0, 0, 0, 64, names.vendor, names.product, 0x0100,
                           *strings, 1)  # fmt: skip

    def configuration_descriptor(self) -> bytes:
        """The configuration with its interface, its HID descriptor if it is one, and its endpoints."""
        body = struct.pack("<BBBBBBBBB", 9, _INTERFACE, 0, 0, len(self.endpoints), *self.interface_class, 0)
        if self.hid_descriptor:
            body += struct.pack("<BBHBBBH", 9, _HID, 0x0111, 0, 1, _REPORT, len(self.hid_descriptor))
        for one in self.endpoints:
            body += struct.pack("<BBBBHB", 7, _ENDPOINT, one.address, one.kind, one.packet, 4)
        return struct.pack("<BBHBBBBB", 9, _CONFIGURATION, 9 + len(body), 1, 1, 0, 0x80, 50) + body
