"""A computer made of files: what /proc, /sys, /etc, /run, /dev and /var have on a kiosk with two projectors."""

from __future__ import annotations

from pathlib import Path

from controller.kiosk.changes.machine import Machine
from tests.controller.play.display.xorg import edid

FILES = {
    "proc/sys/kernel/osrelease": "6.1.0-28-amd64\n",
    "proc/sys/kernel/hostname": "vase\n",
    "proc/net/fib_trie": "  |-- 192.168.0.10\n     /32 host LOCAL\n  |-- 127.0.0.1\n     /32 host LOCAL\n",
    "proc/net/route": "Iface\tDestination\tGateway\tFlags\neth0\t00000000\t0100A8C0\t0003\n",
    "etc/resolv.conf": "nameserver 192.168.0.1\n",
    "sys/class/drm/card0/device/vendor": "0x10de\n",
    "sys/class/drm/card0/device/device": "0x1cb3\n",
    "sys/module/nvidia/version": "535.183.01\n",
    "sys/class/drm/card0-DP-1/status": "connected\n",
    "sys/class/drm/card0-DP-2/status": "connected\n",
    "sys/class/drm/card0-DP-3/status": "disconnected\n",
    "sys/class/net/eth0/address": "02:00:00:00:00:01\n",
    "sys/class/net/eth0/operstate": "up\n",
    "sys/class/net/eth0/device/vendor": "0x8086\n",
    "sys/devices/system/clocksource/clocksource0/current_clocksource": "tsc\n",
    "run/systemd/timesync/synchronized": "",
    "dev/ttyUSB0": "",
    "dev/ttyUSB1": "",
    "etc/X11/xorg.conf.d/20-velatura-outputs.conf": (
        'Section "Monitor"\n  Identifier "DP-1"\n  Option "PreferredMode" "1400x1050_60.00"\n'
        '  Option "Position" "0 0"\nEndSection\n'
        'Section "Monitor"\n  Identifier "DP-2"\n  Option "PreferredMode" "1400x1050_60.00"\n'
        '  Option "Position" "1400 0"\nEndSection\n'
    ),
    "var/lib/dpkg/status": (
        "Package: libgl1-mesa-dri\nStatus: install ok installed\nVersion: 22.3.6-1\n\n"
        "Package: cowsay\nStatus: install ok installed\nVersion: 3.03\n\n"
        "Package: libusb-1.0-0\nStatus: deinstall ok config-files\nVersion: 1.0.26\n"
    ),
    "python/numpy-2.1.0.dist-info/METADATA": "Metadata-Version: 2.1\nName: numpy\nVersion: 2.1.0\n",
}
LINKS = {
    "sys/class/drm/card0/device/driver": "../../bus/pci/drivers/nvidia",
    "etc/localtime": "/usr/share/zoneinfo/Europe/Vienna",
    "dev/serial/by-id/usb-FTDI_FT232R_A1-if00-port0": "../../ttyUSB0",
    "dev/serial/by-id/usb-FTDI_FT232R_B2-if00-port0": "../../ttyUSB1",
    "dev/serial/by-path/pci-0000:00:14.0-usb-0:1:1.0": "../../ttyUSB0",
    "dev/serial/by-path/pci-0000:00:14.0-usb-0:2:1.0": "../../ttyUSB1",
}


class Computer:
    """``machine`` reads it; the methods change what a person, an update or a fault changes."""

    def __init__(self, root: Path) -> None:
        self.root = root
        for name, text in FILES.items():
            self.write(name, text)
        for name, target in LINKS.items():
            self.link(name, target)
        self.plug("DP-1", "LEFT", 1)
        self.plug("DP-2", "RIGHT", 2)
        self.machine = Machine(root, python=[str(root / "python")])

    def write(self, name: str, text: str) -> None:
        (self.root / name).parent.mkdir(parents=True, exist_ok=True)
        (self.root / name).write_text(text)

    def replace(self, name: str, old: str, new: str) -> None:
        before = (self.root / name).read_text()
        assert old in before
        self.write(name, before.replace(old, new))

    def link(self, name: str, target: str) -> None:
        path = self.root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.unlink(missing_ok=True)
        path.symlink_to(target)

    def remove(self, name: str) -> None:
        (self.root / name).unlink()

    def plug(self, connector: str, serial: str, number: int) -> None:
        (self.root / f"sys/class/drm/card0-{connector}/edid").write_bytes(edid(serial, number))
