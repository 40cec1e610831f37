"""What a plugged USB device looks like in ``/sys``, and the messages that udev sends about it.

Written as the kernel and systemd lay them out (Documentation/ABI/testing/sysfs-bus-usb; libsystemd's device-monitor.c).
"""

from __future__ import annotations

import contextlib
import itertools
import os
import shutil
import socket
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Final

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
