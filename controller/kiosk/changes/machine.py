"""Facts about the computer: system, graphics, USB adapters, clock, network. All are read from files below one root."""

from __future__ import annotations

import hashlib
import re
import socket
import struct
from collections.abc import Iterator
from importlib.metadata import distributions
from pathlib import Path
from typing import Final

from controller.kiosk.changes.inventory import Fact
from controller.play.display.edid import serial_names

_PACKAGES: Final = re.compile(
    r"(xserver-xorg|libgl|libegl|libglx|libdrm|libx11|libxrandr|mesa|nvidia|libnvidia|firmware-|intel-microcode|amd64-micro"
    r"|libusb|libhidapi|libgphoto2|libaravis|systemd|udev|libc6|python3|velatura)"
)
"""The Debian packages between the program and the projectors, the camera and the clock."""
_MODELINE: Final = re.compile(r'Identifier +"([^"]+)"|Option +"(PreferredMode|Position)" +"([^"]*)"')
_DPKG: Final = Path("var/lib/dpkg/status")
_X_SETTINGS: Final = Path("etc/X11/xorg.conf.d/20-velatura-outputs.conf")
_LOCAL: Final = re.compile(r"\|-- (\d+\.\d+\.\d+\.\d+)\s+/32 host LOCAL")


class Machine:
    """``root``: below it lie /proc, /sys, /etc, /run and /var; ``python``: the folders with the program's packages,
    None for those of this process.
    """

    def __init__(self, root: Path = Path("/"), python: list[str] | None = None) -> None:
        self._root, self._python = root, python

    def facts(self) -> tuple[Fact, ...]:
        """Every fact that can be read; what is not there has none. Tenths of a second."""
        parts = (self._system(), self._graphics(), self._outputs(), self._adapters(), self._clock(), self._network())
        return tuple(fact for part in parts for fact in part)

    # -- parts

    def _system(self) -> Iterator[Fact]:
        yield Fact("kernel", "", self._text("proc/sys/kernel/osrelease"))
        for name, version in self._debian():
            yield Fact("package", name, version)
        found = distributions() if self._python is None else distributions(path=self._python)
        for package in found:
            yield Fact("package", f"{package.metadata['Name']} (Python)", package.version)

    def _debian(self) -> Iterator[tuple[str, str]]:
        for block in (self._text(_DPKG) or "").split("\n\n"):
            fields = dict(re.findall(r"^(Package|Version|Status): (.*)$", block, re.MULTILINE))
            name = fields.get("Package", "")
            if fields.get("Status", "").endswith(" installed") and _PACKAGES.match(name):
                yield name, fields.get("Version", "")

    def _graphics(self) -> Iterator[Fact]:
        """The driver of each card, with the version of its module (NVIDIA) or of the kernel that it belongs to."""
        kernel = self._text("proc/sys/kernel/osrelease")
        for card in self._glob("sys/class/drm/card[0-9]"):
            driver = self._link_name(card / "device/driver")
            if driver is None:
                continue
            own = self._text(f"sys/module/{driver.replace('-', '_')}/version")
            model = f"{self._read(card / 'device/vendor') or ''}:{self._read(card / 'device/device') or ''}"
            yield Fact("gpu driver", card.name, f"{driver} {own or f'of kernel {kernel}'}")
            yield Fact("gpu", card.name, model)

    def _outputs(self) -> Iterator[Fact]:
        """What is plugged into each connector of the cards, and the modes that are written for the X server."""
        for connector in self._glob("sys/class/drm/card[0-9]-*"):
            block = self._bytes(connector / "edid")
            name = connector.name.partition("-")[2]
            if self._read(connector / "status") == "connected" or block:
                yield Fact("edid", name, described(block))
        identifier = ""
        for found in _MODELINE.finditer(self._text(_X_SETTINGS) or ""):
            if found[1]:
                identifier = found[1]
            elif found[2] == "PreferredMode":
                yield Fact("mode", f"{identifier} (X settings)", found[3])
            else:
                yield Fact("output order", f"{identifier} (X settings)", f"at {found[3]}")

    def _adapters(self) -> Iterator[Fact]:
        for link in self._glob("dev/serial/by-id/*"):
            yield Fact("serial adapter", link.name, "plugged in")
        for link in self._glob("dev/serial/by-path/*"):
            tty = self._link_name(link) or ""
            device = next((one.name for one in self._glob("dev/serial/by-id/*") if self._link_name(one) == tty), tty)
            yield Fact("serial adapter", f"USB port {link.name}", device)

    def _clock(self) -> Iterator[Fact]:
        zone = self._link_name(self._root / "etc/localtime", whole=True) or ""
        yield Fact("clock", "time zone", zone.partition("zoneinfo/")[2] or self._text("etc/timezone"))
        yield Fact("clock", "source", self._text("sys/devices/system/clocksource/clocksource0/current_clocksource"))
        if (self._root / "run/systemd").is_dir():
            there = (self._root / "run/systemd/timesync/synchronized").exists()
            yield Fact("clock", "set by a time server", "yes" if there else "no")

    def _network(self) -> Iterator[Fact]:
        yield Fact("network", "name of this computer", self._text("proc/sys/kernel/hostname"))
        for interface in self._glob("sys/class/net/*"):
            if interface.name != "lo" and (interface / "device").exists():
                yield Fact("network", f"{interface.name}, its hardware address", self._read(interface / "address"))
                yield Fact("network", f"{interface.name}, its link", self._read(interface / "operstate"))
        addresses = sorted(set(_LOCAL.findall(self._text("proc/net/fib_trie") or "")), key=socket.inet_aton)
        yield Fact("network", "addresses", ", ".join(one for one in addresses if not one.startswith("127.")))
        yield Fact("network", "gateway", self._gateway())
        servers = re.findall(r"^nameserver +(\S+)", self._text("etc/resolv.conf") or "", re.MULTILINE)
        yield Fact("network", "name servers", ", ".join(servers))

    def _gateway(self) -> str:
        for line in (self._text("proc/net/route") or "").splitlines()[1:]:
            words = line.split()
            if len(words) > 2 and words[1] == "00000000" and re.fullmatch("[0-9A-F]{8}", words[2]):
                return socket.inet_ntoa(struct.pack("<I", int(words[2], 16)))
        return ""

    # -- files

    def _glob(self, pattern: str) -> list[Path]:
        return sorted(self._root.glob(pattern))

    def _text(self, path: Path | str) -> str | None:
        return self._read(self._root / path)

    def _read(self, path: Path) -> str | None:
        data = self._bytes(path)
        return None if data is None else data.decode("utf-8", "replace").strip()

    def _bytes(self, path: Path) -> bytes | None:
        try:
            return path.read_bytes()
        except OSError:
            return None

    def _link_name(self, path: Path, *, whole: bool = False) -> str | None:
        try:
            target = str(path.readlink())
        except OSError:
            return None
        return target if whole else Path(target).name


def described(edid: bytes | None) -> str:
    """A display by its number and the sum of its whole description: projectors of one model may share the number."""
    if not edid:
        return "no description"
    names = serial_names(edid)
    return f"{names[-1] if names else 'unnamed'} ({hashlib.sha256(edid).hexdigest()[:8]})"
