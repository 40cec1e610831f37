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
``process`` runs a bus in a process of its own, with commands.
What ``/sys`` and udev's messages look like is written as the kernel and systemd lay them out
(Documentation/ABI/testing/sysfs-bus-usb; libsystemd's device-monitor.c).
The folder's path must be short (below about 70 characters): ``tempfile.mkdtemp(prefix="usb", dir="/tmp")``.
"""

from __future__ import annotations

import contextlib
import errno
import itertools
import os
import shutil
import socket
import struct
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Final, Self

from lab.emulated.usb.device import EmulatedUsbDevice
from lab.emulated.usb.files import Plugged
from lab.emulated.usb.hid import EmulatedHidDevice, HidrawFile
from lab.emulated.usb.umockdev_server import CallFailed, Node, OpenFile, UmockdevServer

_HUB: Final = "sys/devices/pci0000:00/0000:00:14.0/usb1"
_MAGIC: Final = 0xFEEDCAFE
_MONITOR_HEADER: Final = struct.Struct("<8sIIIIIIII")
_sequence = itertools.count(1)


class SysFolder:
    """The ``/sys`` of one emulated machine under ``root``."""

    def __init__(self, root: Path) -> None:
        self._root = root

    def add(
        self,
        subsystem: str,
        place: str,
        *,
        attributes: Mapping[str, str | bytes],
        uevent: Mapping[str, str],
        is_class: bool = False,
    ) -> None:
        """Add a device: ``place`` is below the USB hub, e.g. ``1-1/1-1:1.0``; its last part is its name."""
        device = self._root / _HUB / place
        device.mkdir(parents=True, exist_ok=True)
        for name, value in attributes.items():
            data = value if isinstance(value, bytes) else f"{value}\n".encode()
            (device / name).write_bytes(data)
        (device / "uevent").write_text("".join(f"{key}={value}\n" for key, value in uevent.items()))
        home = self._root / "sys" / ("class" if is_class else "bus") / subsystem
        listing = home if is_class else home / "devices"
        listing.mkdir(parents=True, exist_ok=True)
        _link(device / "subsystem", home)
        _link(listing / device.name, device)
        if is_class:
            _link(device / "device", device.parent.parent)
        if "MAJOR" in uevent:
            number = f"{uevent['MAJOR']}:{uevent['MINOR']}"
            (device / "dev").write_text(number + "\n")
            _link(self._root / "sys" / "dev" / "char" / number, device)

    def remove(self, place: str) -> None:
        """Remove a device with everything below it, and all that points to it."""
        device = self._root / _HUB / place
        shutil.rmtree(device, ignore_errors=True)
        for listing in (*(self._root / "sys").glob("*/*/devices"), *(self._root / "sys/class").glob("*")):
            _forget_dangling(listing)
        _forget_dangling(self._root / "sys" / "dev" / "char")

    def announce(self, action: str, place: str, subsystem: str, uevent: Mapping[str, str]) -> None:
        """Tell every program that listens for udev's messages: ``action`` is ``add`` or ``remove``."""
        message = _message(action, f"/{_HUB.removeprefix('sys/')}/{place}", subsystem, uevent)
        for listener in self._root.glob("event*"):
            with contextlib.closing(socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)) as sender:
                try:
                    sender.connect(os.fspath(listener))
                    sender.send(message)
                except OSError:
                    listener.unlink(missing_ok=True)  # the program has stopped listening


def _link(place: Path, target: Path) -> None:
    place.parent.mkdir(parents=True, exist_ok=True)
    place.unlink(missing_ok=True)
    place.symlink_to(os.path.relpath(target, place.parent))


def _forget_dangling(folder: Path) -> None:
    if folder.is_dir():
        for entry in folder.iterdir():
            if entry.is_symlink() and not entry.exists():
                entry.unlink(missing_ok=True)


def _message(action: str, devpath: str, subsystem: str, uevent: Mapping[str, str]) -> bytes:
    """A message in libudev's monitor format, with the hashes that its socket filter looks at."""
    pairs = {"ACTION": action, "DEVPATH": devpath, "SUBSYSTEM": subsystem, "SEQNUM": str(next(_sequence)), **uevent}
    if "DEVNAME" in pairs:
        pairs["DEVNAME"] = f"/dev/{pairs['DEVNAME']}"
    properties = b"".join(f"{key}={value}".encode() + b"\0" for key, value in pairs.items())
    kind = pairs.get("DEVTYPE")
    header = _MONITOR_HEADER.pack(
        b"libudev\0",
        socket.htonl(_MAGIC),
        _MONITOR_HEADER.size,
        _MONITOR_HEADER.size,
        len(properties),
        socket.htonl(murmur_hash(subsystem.encode())),
        socket.htonl(murmur_hash(kind.encode())) if kind else 0,
        0,
        0,
    )
    return header + properties


def murmur_hash(data: bytes) -> int:
    """MurmurHash2 with seed 0, 32 bits, as udev's socket filter uses it."""
    factor, mask = 0x5BD1E995, 0xFFFF_FFFF
    value = len(data)
    whole = len(data) // 4 * 4
    for (word,) in struct.iter_unpack("<I", data[:whole]):
        mixed = word * factor & mask
        mixed = (mixed ^ mixed >> 24) * factor & mask
        value = (value * factor & mask) ^ mixed
    if rest := data[whole:]:
        value = (value ^ int.from_bytes(rest, "little")) * factor & mask
    value = (value ^ value >> 13) * factor & mask
    return value ^ value >> 15


PRELOAD: Final = "libumockdev-preload.so.0"
_USB_MAJOR: Final = 189


def environment(folder: Path) -> dict[str, str]:
    """The variables that a program needs to see the bus in ``folder``."""
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
