"""Finding a still camera on the USB bus: by serial number, by maker and model number, or by port."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final, Self

import usb.core
import usb.util

from hal.codecs.ptp.values import printable
from hal.deadline import Deadline
from hal.errors import DeviceGone, DeviceRefused, PluginError
from plugins.ptp.ip import still_time
from plugins.ptp.link import camera_off
from plugins.ptp.usb.link import PtpUsbLink
from plugins.ptp.usb.pipes import PyusbPipes, still_interface

_NUMBERS: Final = re.compile(r"([0-9a-f]{4}):([0-9a-f]{4})", re.IGNORECASE)
_PORT: Final = re.compile(r"[0-9]{1,3}-[0-9]{1,3}(\.[0-9]{1,3}){0,6}")
_SERIAL: Final = re.compile(r"[!-~]{1,126}")


@dataclass(frozen=True, slots=True)
class UsbAddress:
    """Which camera: ``serial`` number, ``vendor`` and ``product`` number, or ``port`` path; all empty: the only one."""

    serial: str = ""
    vendor: int = 0
    product: int = 0
    port: str = ""

    @classmethod
    def parse(cls, text: str) -> Self:
        """Read ``usb:``, ``usb:04a9:3110``, ``usb:1-2.3`` or ``usb:SERIAL``. Raises PluginError."""
        scheme, _, rest = text.partition(":")
        if scheme == "usb":
            if not rest:
                return cls()
            if numbers := _NUMBERS.fullmatch(rest):
                return cls(vendor=int(numbers[1], 16), product=int(numbers[2], 16))
            if _PORT.fullmatch(rest):
                return cls(port=rest)
            if _SERIAL.fullmatch(rest):
                return cls(serial=rest)
        raise PluginError(
            "camera-address",
            what=f"{text!r} is not the address of a camera on USB.",
            remedy="Write usb:SERIALNUMBER, usb:VENDOR:PRODUCT in hexadecimal, usb:1-2.3 for a port, or usb: for any.",
        )


@dataclass(frozen=True, slots=True)
class UsbCamera:
    """A still camera on the bus. ``serial`` of its USB descriptor: "" if it has none or can't be read."""

    device: Any
    vendor: int
    product: int
    port: str
    serial: str

    def __str__(self) -> str:
        return f"{self.vendor:04x}:{self.product:04x} at port {self.port}" + (
            f", number {self.serial}" * bool(self.serial)
        )


def usb_cameras() -> list[UsbCamera]:
    """Every still camera on every bus, by port. Raises DeviceRefused without libusb."""
    try:
        return sorted(_cameras(), key=lambda camera: camera.port)
    except usb.core.NoBackendError as error:
        raise DeviceRefused(
            "usb-no-library",
            what="The library for USB devices (libusb) is not installed.",
            remedy="Install it (Debian: apt install libusb-1.0-0), then try again.",
        ) from error


class UsbFinder:
    """Opens the camera of an address, and the same camera again after it was plugged in elsewhere."""

    def __init__(self, address: UsbAddress) -> None:
        self._address = address
        self._known = address.serial

    def connect(self, deadline: Deadline) -> PtpUsbLink:
        """Raises DeviceGone("camera-off") if it is missing, DeviceRefused if several cameras fit, DeviceBusy."""
        still_time(deadline)
        camera = self._choose(usb_cameras())
        pipes = PyusbPipes.open(camera.device)
        link = PtpUsbLink.over(pipes, deadline=deadline)
        self._known = camera.serial
        return link

    def _choose(self, cameras: list[UsbCamera]) -> UsbCamera:
        wanted = self._address
        if self._known:
            fitting = [camera for camera in cameras if camera.serial.lstrip("0") == self._known.lstrip("0")]
        elif wanted.port:
            fitting = [camera for camera in cameras if camera.port == wanted.port]
        elif wanted.vendor:
            fitting = [
                camera for camera in cameras if (camera.vendor, camera.product) == (wanted.vendor, wanted.product)
            ]
        else:
            fitting = cameras
        if len(fitting) == 1:
            return fitting[0]
        if not fitting:
            raise self._not_there(cameras)
        raise DeviceRefused(
            "camera-which",
            what=f"There are {len(fitting)} cameras that fit: {'; '.join(map(str, fitting))}.",
            remedy="Give a serial number or port, for example usb:1-2.",
        )

    def _not_there(self, cameras: list[UsbCamera]) -> DeviceGone:
        others = f"; there is {'; '.join(map(str, cameras))}" if cameras else ""
        what = f" with number {self._known}" if self._known else ""
        return camera_off("the USB bus", f"there is no camera{what}{others}")


def _cameras() -> Iterator[UsbCamera]:
    for device in usb.core.find(find_all=True):
        try:
            if still_interface(device) is None:
                continue
            port = f"{device.bus}-{'.'.join(map(str, device.port_numbers or ()))}"
        except usb.core.USBError:
            continue  # it was just unplugged, or can't be read
        yield UsbCamera(device, device.idVendor, device.idProduct, port, _serial(device))


def _serial(device: Any) -> str:
    try:
        return printable(device.serial_number or "")
    except (usb.core.USBError, ValueError, NotImplementedError):
        return ""
    finally:
        usb.util.dispose_resources(device)
