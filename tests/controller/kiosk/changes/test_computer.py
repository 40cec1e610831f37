"""Everything about the computer that can change between two days is named, alone, with what to do."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from controller.kiosk.changes.inventory import Inventory
from controller.kiosk.changes.watch import KINDS, changes
from tests.controller.kiosk.changes.computer import Computer

X_SETTINGS = "etc/X11/xorg.conf.d/20-velatura-outputs.conf"
DPKG = "var/lib/dpkg/status"
ADAPTER = "dev/serial/by-id/usb-FTDI_FT232R_A1-if00-port0"


def swap(computer: Computer) -> None:
    computer.plug("DP-1", "RIGHT", 2)
    computer.plug("DP-2", "LEFT", 1)


def unplug(computer: Computer) -> None:
    computer.write("sys/class/drm/card0-DP-2/status", "disconnected")
    computer.remove("sys/class/drm/card0-DP-2/edid")


def exchange_adapters(computer: Computer) -> None:
    computer.link(ADAPTER, "../../ttyUSB1")
    computer.link("dev/serial/by-id/usb-FTDI_FT232R_B2-if00-port0", "../../ttyUSB0")


MUTATIONS: dict[str, tuple[Callable[[Computer], object], str, str]] = {
    "kernel": (
        lambda it: it.write("proc/sys/kernel/osrelease", "6.1.0-37-amd64\n"),
        "kernel", "The kernel was 6.1.0-28-amd64, and is now 6.1.0-37-amd64.",
    ),
    "driver's version": (
        lambda it: it.write("sys/module/nvidia/version", "550.54\n"),
        "gpu driver", "The driver of the graphics card card0 was nvidia 535.183.01, and is now nvidia 550.54.",
    ),
    "another driver": (
        lambda it: it.link("sys/class/drm/card0/device/driver", "../../bus/pci/drivers/nouveau"),
        "gpu driver", "and is now nouveau of kernel 6.1.0-28-amd64.",
    ),
    "another card": (lambda it: it.write("sys/class/drm/card0/device/device", "0x2204\n"), "gpu", "0x10de:0x2204"),
    "Debian's package": (
        lambda it: it.replace(DPKG, "22.3.6-1", "22.3.6-2"), "package", "libgl1-mesa-dri was 22.3.6-1",
    ),
    "a package is back": (
        lambda it: it.replace(DPKG, "deinstall ok config-files", "install ok installed"),
        "package", "libusb-1.0-0 is new: 1.0.26.",
    ),
    "Python's package": (
        lambda it: it.replace("python/numpy-2.1.0.dist-info/METADATA", "Version: 2.1.0", "Version: 2.2.0"),
        "package", "numpy (Python) was 2.1.0, and is now 2.2.0.",
    ),
    "another display": (lambda it: it.plug("DP-1", "SPARE", 9), "edid", "The display at output DP-1 was OTM-1 "),
    "unplugged": (unplug, "edid", "The display at output DP-2 is gone; it was OTM-2 "),
    "plugged in as well": (
        lambda it: it.plug("DP-3", "THIRD", 3), "edid", "The display at output DP-3 is new: OTM-3 ",
    ),
    "cables swapped": (swap, "output order", "The displays at outputs DP-1 and DP-2 have changed places."),
    "mode": (
        lambda it: it.replace(X_SETTINGS, '"DP-1"\n  Option "PreferredMode" "1400x1050_60.00"',
                              '"DP-1"\n  Option "PreferredMode" "1280x1024_60.02"'),
        "mode", "DP-1 (X settings) was 1400x1050_60.00, and is now 1280x1024_60.02.",
    ),
    "place": (lambda it: it.replace(X_SETTINGS, "1400 0", "1500 0"), "output order", "at 1500 0"),
    "adapter gone": (lambda it: it.remove(ADAPTER), "serial adapter", "usb-FTDI_FT232R_A1-if00-port0 is gone"),
    "adapters exchanged": (exchange_adapters, "serial adapter", "USB port pci-0000:00:14.0-usb-0:1:1.0 was usb-FTDI"),
    "time zone": (
        lambda it: it.link("etc/localtime", "/usr/share/zoneinfo/Etc/UTC"),
        "clock", "time zone was Europe/Vienna, and is now Etc/UTC.",
    ),
    "no time server": (
        lambda it: it.remove("run/systemd/timesync/synchronized"), "clock", "set by a time server was yes",
    ),
    "clock source": (
        lambda it: it.write("sys/devices/system/clocksource/clocksource0/current_clocksource", "hpet"),
        "clock", "source was tsc, and is now hpet.",
    ),
    "address": (
        lambda it: it.replace("proc/net/fib_trie", "192.168.0.10", "192.168.0.77"),
        "network", "addresses was 192.168.0.10, and is now 192.168.0.77.",
    ),
    "link": (lambda it: it.write("sys/class/net/eth0/operstate", "down"), "network", "its link was up"),
    "network card": (lambda it: it.write("sys/class/net/eth0/address", "02:00:00:00:00:99"), "network", "eth0"),
    "gateway": (
        lambda it: it.replace("proc/net/route", "0100A8C0", "FE00A8C0"),
        "network", "gateway was 192.168.0.1, and is now 192.168.0.254.",
    ),
    "name server": (lambda it: it.write("etc/resolv.conf", "nameserver 9.9.9.9\n"), "network", "9.9.9.9"),
    "name": (lambda it: it.write("proc/sys/kernel/hostname", "bust\n"), "network", "was vase, and is now bust."),
}  # fmt: skip


@pytest.mark.parametrize("which", MUTATIONS)
def test_what_changed_is_named_and_nothing_else(tmp_path: Path, which: str) -> None:
    mutate, kind, words = MUTATIONS[which]
    computer = Computer(tmp_path)
    good = Inventory(100.0, "a run", computer.machine.facts())
    assert changes(good, Inventory(200.0, "", computer.machine.facts())) == ()
    mutate(computer)
    found = changes(good, Inventory(200.0, "", computer.machine.facts()))
    assert {one.kind for one in found} == {kind}
    assert words in " ".join(one.sentence for one in found)
    assert all(one.remedy == KINDS[kind].if_changed for one in found)


def test_a_computer_without_these_files_has_few_facts_and_no_error(tmp_path: Path) -> None:
    from controller.kiosk.changes.machine import Machine

    assert {fact.value for fact in Machine(tmp_path, python=[]).facts()} <= {None, ""}


def test_the_first_night_with_it_says_since_when(tmp_path: Path) -> None:
    computer = Computer(tmp_path)
    good = Inventory(100.0, "a run", computer.machine.facts())
    quiet = Inventory(200.0, "", computer.machine.facts())
    computer.write("proc/sys/kernel/osrelease", "6.2\n")
    first, second = (Inventory(at, "", computer.machine.facts()) for at in (300.0, 400.0))
    (change,) = changes(good, Inventory(500.0, "", computer.machine.facts()), [quiet, first, second])
    assert change.since_unix_s == 300.0
