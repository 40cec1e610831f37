"""Plugs emulated USB devices into the kernel of this machine by USB/IP (Documentation/usb/usbip_protocol.rst).

The kernel's own hub and class drivers meet the device as on a cable.
"""

from __future__ import annotations

import contextlib
import errno
import socket
import struct
import threading
from pathlib import Path
from typing import Final

from lab.emulated.usb.device import EmulatedUsbDevice, SetupPacket, Stall

_HOST: Final = Path("/sys/devices/platform/vhci_hcd.0")
_HIGH_SPEED: Final = 3
_HEAD: Final = struct.Struct(">IIIII28s")
_SUBMIT: Final = struct.Struct(">Iiiii8s")
_RETURNED: Final = struct.Struct(">iiiii8x")
_SUBMITTED, _UNLINKED = 1, 2


class Cable:
    """One device in one port of the virtual hub, until ``pull``."""

    def __init__(self, device: EmulatedUsbDevice, port: int) -> None:
        self._device = device
        self._sending = threading.Lock()
        self._waiting: dict[int, tuple[int, int]] = {}
        """Transfers that wait for data: endpoint and length by sequence number."""
        device.on_ready = self._feed
        device.plugged()
        kernel, self._ours = socket.socketpair()
        with kernel:
            (_HOST / "attach").write_text(f"{port} {kernel.fileno()} {(1 << 16) + port + 1} {_HIGH_SPEED}")
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def pull(self) -> None:
        """As when somebody pulls the cable."""
        with contextlib.suppress(OSError):
            self._ours.shutdown(socket.SHUT_RDWR)
        self._thread.join()
        self._ours.close()
        self._device.unplugged()

    def _serve(self) -> None:
        with contextlib.suppress(OSError, EOFError):
            while True:
                command, number, _, inwards, endpoint, rest = _HEAD.unpack(self._read(_HEAD.size))
                if command == _SUBMITTED:
                    _, length, _, _, _, setup = _SUBMIT.unpack(rest)
                    data = b"" if inwards else self._read(length)
                    self._submitted(number, bool(inwards), endpoint, length, setup, data)
                elif command == _UNLINKED:
                    self._unlinked(number, int.from_bytes(rest[:4], "big"))

    def _submitted(self, number: int, inwards: bool, endpoint: int, length: int, setup: bytes, data: bytes) -> None:
        try:
            with self._device.lock:
                if endpoint == 0:
                    answer = self._device.control(SetupPacket(*struct.unpack("<BBHHH", setup)), data)
                    self._answer(number, answer if inwards else b"", len(answer) if inwards else length)
                elif inwards:
                    self._waiting[number] = (endpoint | 0x80, length)
                else:
                    self._device.out(endpoint, data)
                    self._answer(number, b"", length)
        except Stall:
            self._answer(number, b"", 0, -errno.EPIPE)
        self._feed()

    def _unlinked(self, number: int, victim: int) -> None:
        with self._device.lock:
            found = self._waiting.pop(victim, None)
        self._send(struct.pack(">IIIIIi24x", 4, number, 0, 0, 0, -errno.ECONNRESET if found else 0))

    def _feed(self) -> None:
        """Give what the device has to the transfers that wait for it, in their order."""
        with self._device.lock:
            for number, (endpoint, length) in tuple(self._waiting.items()):
                data = self._device.pipes[endpoint].take(length)
                if data is not None:
                    del self._waiting[number]
                    # Under the lock, so that two threads keep the order of the bytes.
                    self._answer(number, bytes(data), len(data))

    def _answer(self, number: int, data: bytes, length: int, status: int = 0) -> None:
        self._send(struct.pack(">IIIII", 3, number, 0, 0, 0) + _RETURNED.pack(status, length, 0, 0, 0) + data)

    def _send(self, data: bytes) -> None:
        with self._sending, contextlib.suppress(OSError):
            self._ours.sendall(data)

    def _read(self, count: int) -> bytes:
        data = b""
        while len(data) < count:
            piece = self._ours.recv(count - len(data))
            if not piece:
                raise EOFError
            data += piece
        return data
