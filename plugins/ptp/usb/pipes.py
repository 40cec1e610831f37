"""The pipes of a still camera on USB, through pyusb, and their interface.

A thread reads the events of the interrupt pipe in short waits, because another thread can't end a read. It closes the
pipes if it is the last user.
"""

from __future__ import annotations

import contextlib
import errno
import threading
from array import array
from collections import deque
from typing import Any, Final, Protocol, Self

import usb.core
import usb.util

from hal.codecs.ptp import usb as ptp_usb
from hal.codecs.ptp.usb import LARGEST_EVENT, STILL_IMAGE_CLASS, ClassRequest
from hal.errors import DeviceBusy, DeviceError, DeviceGone, DeviceRefused, ProtocolError
from plugins.ptp.link import LinkEvent, camera_lost

_CLASS_OUT: Final = 0x21
_CLASS_IN: Final = 0xA1
_LIBUSB_PIPE, _LIBUSB_TIMEOUT = -9, -7
_GONE: Final = (errno.ENODEV, errno.ESHUTDOWN, errno.EPROTO, errno.ENOENT, errno.EIO)
RULE: Final = "firmware_configs/udev/70-velatura-camera.rules"


class PipeStalled(Exception):
    """The camera answers a transfer or a class request with STALL."""


class Pipes(Protocol):
    """A claimed still image interface. Every method ends within ``seconds``, and raises DeviceGone or PipeStalled."""

    packet: int
    """Largest packet of the bulk pipes, in bytes."""

    def read(self, buffer: array[int], seconds: float) -> int:
        """Receive at most as many bytes as ``buffer`` holds, until a short packet; how many came, 0 for none."""

    def write(self, data: bytes, seconds: float) -> int:
        """Send; how many bytes the camera took."""

    def read_event(self, seconds: float) -> bytes:
        """What came on the interrupt pipe; b"" for nothing. Called by another thread than the rest."""

    def send_request(self, request: ClassRequest, data: bytes, seconds: float) -> None: ...

    def class_request(self, request: ClassRequest, count: int, seconds: float) -> bytes: ...

    def clear_halts(self) -> None:
        """Make halted bulk pipes work again."""

    def close(self) -> None: ...


class PyusbPipes:
    """See ``Pipes``. Made by ``open``."""

    def __init__(self, device: Any, interface: Any, endpoints: tuple[int, int, int], packet: int) -> None:
        self.packet = packet
        self._device = device
        self._interface: int = interface.bInterfaceNumber
        self._in, self._out, self._events = endpoints

    @classmethod
    def open(cls, device: Any) -> Self:
        """Claim the still image interface of a pyusb ``device``.

        Raises DeviceBusy("camera-in-use") if another program has it, DeviceRefused("camera-permission") if this
        user may not use it, DeviceGone, DeviceRefused("camera-no-interface").
        """
        try:
            interface = still_interface(device)
            if interface is None:
                raise _no_interface()
            pipes = cls(device, interface, *_pipes_of(interface))
            with contextlib.suppress(NotImplementedError):
                if device.is_kernel_driver_active(pipes._interface):
                    device.detach_kernel_driver(pipes._interface)
            usb.util.claim_interface(device, pipes._interface)
        except usb.core.USBError as error:
            usb.util.dispose_resources(device)
            raise _cannot_open(error) from error
        except DeviceError:
            usb.util.dispose_resources(device)
            raise
        return pipes

    def read(self, buffer: array[int], seconds: float) -> int:
        try:
            count: int = self._device.read(self._in, buffer, timeout=_milliseconds(seconds))
        except usb.core.USBTimeoutError:
            return 0
        except usb.core.USBError as error:
            raise _failed(error) from error
        return count

    def write(self, data: bytes, seconds: float) -> int:
        try:
            count: int = self._device.write(self._out, data, timeout=_milliseconds(seconds))
        except usb.core.USBTimeoutError:
            return 0
        except usb.core.USBError as error:
            raise _failed(error) from error
        return count

    def read_event(self, seconds: float) -> bytes:
        try:
            return bytes(self._device.read(self._events, LARGEST_EVENT, timeout=_milliseconds(seconds)))
        except usb.core.USBTimeoutError:
            return b""
        except usb.core.USBError as error:
            raise _failed(error) from error

    def send_request(self, request: ClassRequest, data: bytes, seconds: float) -> None:
        self._control(_CLASS_OUT, request, data, seconds)

    def class_request(self, request: ClassRequest, count: int, seconds: float) -> bytes:
        return bytes(self._control(_CLASS_IN, request, count, seconds))

    def clear_halts(self) -> None:
        try:
            for endpoint in (self._in, self._out):
                self._device.clear_halt(endpoint)
        except usb.core.USBError as error:
            raise _failed(error) from error

    def close(self) -> None:
        with contextlib.suppress(usb.core.USBError):
            usb.util.dispose_resources(self._device)

    def _control(self, kind: int, request: ClassRequest, data: bytes | int, seconds: float) -> Any:
        try:
            return self._device.ctrl_transfer(
                kind, int(request), 0, self._interface, data, timeout=_milliseconds(seconds)
            )
        except usb.core.USBError as error:
            raise _failed(error) from error


def still_interface(device: Any) -> Any | None:
    """The first still image interface of a pyusb device, or None. Raises USBError."""
    for configuration in device:
        for interface in configuration:
            kinds = (interface.bInterfaceClass, interface.bInterfaceSubClass, interface.bInterfaceProtocol)
            if kinds == STILL_IMAGE_CLASS:
                return interface
    return None


def _pipes_of(interface: Any) -> tuple[tuple[int, int, int], int]:
    """The addresses of bulk in, bulk out and interrupt in, and the packet size. Raises DeviceRefused."""
    found: dict[tuple[int, bool], Any] = {}
    for endpoint in interface:
        key = (usb.util.endpoint_type(endpoint.bmAttributes), bool(endpoint.bEndpointAddress & 0x80))
        found.setdefault(key, endpoint)
    try:
        three = [
            found[key]
            for key in (
                (usb.util.ENDPOINT_TYPE_BULK, True),
                (usb.util.ENDPOINT_TYPE_BULK, False),
                (usb.util.ENDPOINT_TYPE_INTR, True),
            )
        ]
    except KeyError as error:
        raise _no_interface() from error
    addresses = (three[0].bEndpointAddress, three[1].bEndpointAddress, three[2].bEndpointAddress)
    return addresses, max(8, three[0].wMaxPacketSize & 0x7FF)


def _no_interface() -> DeviceRefused:
    return DeviceRefused(
        "camera-no-interface",
        what="The USB device has no still image interface.",
        remedy="Set the camera's USB mode to PTP, PC connection or remote control.",
    )


def _milliseconds(seconds: float) -> int:
    """0 would mean without limit."""
    return max(1, round(1000 * seconds))


def _failed(error: usb.core.USBError) -> DeviceGone | PipeStalled:
    if error.errno == errno.EPIPE or error.backend_error_code == _LIBUSB_PIPE:
        return PipeStalled()
    return camera_lost(error.strerror or str(error))


def _cannot_open(error: usb.core.USBError) -> DeviceError:
    if error.errno == errno.EBUSY:
        return DeviceBusy(
            "camera-in-use",
            what="The camera is in use by another program.",
            remedy="Close photo programs and the desktop's file manager (gvfs-gphoto2-volume-monitor), then try again.",
        )
    if error.errno in (errno.EACCES, errno.EPERM):
        return DeviceRefused(
            "camera-permission",
            what="This user may not use the camera on the USB bus.",
            remedy=f"Install the udev rule {RULE} (see its first lines), then plug the camera in again.",
        )
    return camera_lost(error.strerror or str(error))


_SLICE_S: Final = 0.1
_MOST_EVENTS: Final = 10_000


class InterruptReader:
    """Reads from ``start`` to ``close``. ``ended``: why the camera is gone, None while it is connected."""

    def __init__(self, pipes: Pipes) -> None:
        self._pipes = pipes
        self._released = False
        self._events: deque[LinkEvent] = deque(maxlen=_MOST_EVENTS)
        self._news = threading.Condition()
        self.ended: DeviceGone | None = None
        self._stop = threading.Event()
        self._reader = threading.Thread(target=self._read, name="ptp-usb-events", daemon=True)

    def start(self) -> None:
        self._reader.start()

    def taken(self) -> list[LinkEvent]:
        """What has come since the last call."""
        with self._news:
            found = list(self._events)
            self._events.clear()
        return found

    def wait(self, seconds: float) -> bool:
        """Whether there are events, or news came within ``seconds``."""
        with self._news:
            return bool(self._events) or self._news.wait(seconds)

    def close(self) -> None:
        """Stop reading, and close the pipes; may be called before ``start``."""
        self._stop.set()
        if self._reader.is_alive():
            self._reader.join(3 * _SLICE_S)
        if not self._reader.is_alive():
            self._release()

    def _release(self) -> None:
        """Close the pipes once. If a dead bus still blocks the reader, the reader closes them later."""
        with self._news:
            released, self._released = self._released, True
        if not released:
            self._pipes.close()

    def _read(self) -> None:
        try:
            self._read_until_stopped()
        finally:
            if self._stop.is_set():
                self._release()

    def _read_until_stopped(self) -> None:
        stalls = 0
        while not self._stop.is_set():
            try:
                data = self._pipes.read_event(_SLICE_S)
                stalls = 0
                if data:
                    code, parameters = ptp_usb.parse_event(data)
                    with self._news:
                        self._events.append(LinkEvent(code, parameters))
                        self._news.notify_all()
            except ProtocolError:
                continue  # the bodies query the state after a lost event
            except PipeStalled:
                stalls += 1
                self._stop.wait(min(1.0, 0.05 * stalls))
            except DeviceGone as gone:
                with self._news:
                    self.ended = gone
                    self._news.notify_all()
                return
