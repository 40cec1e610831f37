"""An emulated USB bus: devices come and go; programs under the umockdev preload library find and use them.

They see what Linux shows of a real bus: ``/sys``, ``/dev/bus/usb``, ``/dev/hidraw*`` and udev's messages, so that
unchanged libusb and hidapi work on it. Run such programs with ``environment(folder)``, in another process than this::

    class Echo(EmulatedUsbDevice):
        endpoints = (Endpoint(0x81, BULK, 512), Endpoint(0x02, BULK, 512))

        def out(self, endpoint: int, data: bytes) -> None:  # the computer has sent ``data``
            self.send(0x81, data)  # offer it one transfer


    with UsbBus(folder) as bus:
        bus.plug(echo := Echo(UsbNames(0x1209, 0x0001, "maker", "model", "serial")))
        subprocess.run(client, env={**os.environ, **environment(folder)})
        bus.unplug(echo)

A device's hooks run with its ``lock`` held: one that unplugs its own device must do it from another thread.
``usb_bus_process`` runs a bus in a process of its own, with commands.
The folder's path must be short (below about 70 characters): ``tempfile.mkdtemp(prefix="usb", dir="/tmp")``.
"""

from __future__ import annotations

import errno
import os
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Final, Self

from plugins.emulated.usb.device import EmulatedUsbDevice
from plugins.emulated.usb.files import Plugged
from plugins.emulated.usb.hid import EmulatedHidDevice, HidrawFile
from plugins.emulated.usb.sysfs import SysFolder
from plugins.emulated.usb.umockdev_server import CallFailed, Node, OpenFile, UmockdevServer

PRELOAD: Final = "libumockdev-preload.so.0"
_USB_MAJOR: Final = 189


def environment(folder: Path) -> dict[str, str]:
    """What a program's environment must have besides, so that it sees the bus in ``folder``."""
    return {"LD_PRELOAD": PRELOAD, "UMOCKDEV_DIR": os.fspath(folder)}


@dataclass(slots=True)
class _Place:
    """Where a plugged device is."""

    plugged: Plugged
    port: str
    node: Node
    uevent: Mapping[str, str]
    raw: Node | None = None
    raw_files: list[HidrawFile] = field(default_factory=list)


class UsbBus:
    """Bus 1 of one emulated machine under ``folder`` (an existing, empty folder with a short path); also a context."""

    def __init__(self, folder: Path) -> None:
        self._server = UmockdevServer(folder)
        self._sys = SysFolder(folder)
        self._places: dict[int, _Place] = {}
        self._ports: dict[int, str] = {}
        self._address = 0
        self._raws = 0
        self._lock = threading.Lock()
        for empty in ("sys/bus/usb/devices", "sys/bus/hid/devices", "sys/class/hidraw", "sys/dev/char"):
            (folder / empty).mkdir(parents=True, exist_ok=True)

    def plug(self, device: EmulatedUsbDevice) -> None:
        """Plug ``device`` in: always at the same port, every time at another address."""
        with self._lock:
            self._plug(device)

    def _plug(self, device: EmulatedUsbDevice) -> None:
        if id(device) in self._places:
            return
        self._address = self._address % 127 + 1
        port = self._ports.setdefault(id(device), f"1-{len(self._ports) + 1}")
        device.pull, device.push = partial(self.unplug, device), partial(self.plug, device)
        device.plugged()
        plugged = Plugged(device)
        node = self._server.add(
            f"/dev/bus/usb/001/{self._address:03d}", plugged.open, number=(_USB_MAJOR, self._address - 1)
        )
        plugged.on_completed = node.set_writable
        node.set_writable(False)
        place = _Place(plugged, port, node, self._uevent(device))
        self._places[id(device)] = place
        self._describe(device, place)
        if isinstance(device, EmulatedHidDevice):
            self._add_hidraw(device, place)
        self._sys.announce("add", port, "usb", place.uevent)

    def unplug(self, device: EmulatedUsbDevice) -> None:
        """Pull the cable: its files stay open but fail, its nodes are gone."""
        with self._lock:
            place = self._places.pop(id(device), None)
            if place is not None:
                self._unplug(place)

    def _unplug(self, place: _Place) -> None:
        place.plugged.leave()
        with place.plugged.device.lock:
            place.plugged.device.unplugged()
        for file in place.raw_files:
            file.gone = True
        time.sleep(place.plugged.device.faults.lingers_s)
        self._sys.remove(place.port)
        place.node.remove()
        if place.raw is not None:
            place.raw.remove()
        self._sys.announce("remove", place.port, "usb", place.uevent)

    def address_of(self, device: EmulatedUsbDevice) -> int:
        """The device's address now. Raises KeyError where it is not plugged in."""
        return int(self._places[id(device)].uevent["DEVNUM"])

    def driver_bound(self, device: EmulatedUsbDevice) -> bool:
        """Whether the kernel's own driver has the device, and not a program. Raises KeyError."""
        return self._places[id(device)].plugged.driver_bound

    def close(self) -> None:
        for place in tuple(self._places.values()):
            self.unplug(place.plugged.device)
        self._server.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _uevent(self, device: EmulatedUsbDevice) -> dict[str, str]:
        return {
            "MAJOR": str(_USB_MAJOR),
            "MINOR": str(self._address - 1),
            "DEVNAME": f"bus/usb/001/{self._address:03d}",
            "DEVTYPE": "usb_device",
            "DRIVER": "usb",
            "PRODUCT": f"{device.names.vendor:x}/{device.names.product:x}/100",
            "TYPE": "0/0/0",
            "BUSNUM": "001",
            "DEVNUM": f"{self._address:03d}",
        }

    def _describe(self, device: EmulatedUsbDevice, place: _Place) -> None:
        names = device.names
        texts = {"manufacturer": names.maker, "product": names.model, "serial": names.serial}
        attributes: dict[str, str | bytes] = {
            "busnum": "1",
            "devnum": str(self._address),
            "devpath": place.port.removeprefix("1-"),
            "speed": "480",
            "bConfigurationValue": "1",
            "bNumConfigurations": "1",
            "bNumInterfaces": " 1",
            "bDeviceClass": "00",
            "bcdDevice": "0100",
            "idVendor": f"{names.vendor:04x}",
            "idProduct": f"{names.product:04x}",
            "descriptors": device.device_descriptor() + device.configuration_descriptor(),
            **{key: text for key, text in texts.items() if text},
        }
        self._sys.add("usb", place.port, attributes=attributes, uevent=place.uevent)
        kind, subkind, protocol = device.interface_class
        self._sys.add(
            "usb",
            f"{place.port}/{place.port}:1.0",
            attributes={
                "bInterfaceNumber": "00",
                "bInterfaceClass": f"{kind:02x}",
                "bInterfaceSubClass": f"{subkind:02x}",
                "bInterfaceProtocol": f"{protocol:02x}",
                "bAlternateSetting": " 0",
            },
            uevent={"DEVTYPE": "usb_interface", "INTERFACE": f"{kind}/{subkind}/{protocol}"},
        )

    def _add_hidraw(self, device: EmulatedHidDevice, place: _Place) -> None:
        """The kernel's HID layer above a USB interface: a hid device, and its hidraw node."""
        names = device.names
        files = place.raw_files

        def opened() -> OpenFile:
            # While a program has taken the interface from the kernel, there is no hidraw device.
            if not place.plugged.driver_bound or place.plugged.gone:
                return _NoDevice()
            files.append(HidrawFile(device, node.set_readable))
            return files[-1]

        name = f"hidraw{self._raws}"
        self._raws += 1
        node = place.raw = self._server.add(f"/dev/{name}", opened)
        hid = f"{place.port}/{place.port}:1.0/0003:{names.vendor:04X}:{names.product:04X}.{self._raws:04X}"
        self._sys.add(
            "hid",
            hid,
            attributes={"report_descriptor": device.hid_descriptor},
            uevent={
                "DRIVER": "hid-generic",
                "HID_ID": f"0003:{names.vendor:08X}:{names.product:08X}",
                "HID_NAME": f"{names.maker} {names.model}",
                "HID_PHYS": f"usb-0000:00:14.0-{place.port.removeprefix('1-')}/input0",
                "HID_UNIQ": names.serial,
            },
        )
        # Programs ask fstat for the number and look it up in /sys, so it must be the pty's.
        uevent = {"MAJOR": str(os.major(node.number)), "MINOR": str(os.minor(node.number)), "DEVNAME": name}
        self._sys.add("hidraw", f"{hid}/hidraw/{name}", attributes={}, uevent=uevent, is_class=True)


class _NoDevice:
    """An open file whose device is elsewhere."""

    def ioctl(self, request: int, argument: int, memory: object) -> int:
        raise CallFailed(errno.ENODEV)

    read = write = ioctl

    def closed(self) -> None:
        return
