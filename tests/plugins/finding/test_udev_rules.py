"""The shipped udev rules: sound, and for just the devices that our drivers claim, as the emulated bus shows them."""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from importlib import resources
from pathlib import Path

import pytest
from StreamDeck.ProductIDs import USBVendorIDs

from hal.codecs import hid as hid_reports
from hal.codecs.ptp.usb import STILL_IMAGE_CLASS
from lab.emulated.usb.bus import UsbBus
from lab.emulated.usb.camera import numbered_camera
from lab.emulated.usb.device import EmulatedUsbDevice, UsbNames
from lab.emulated.usb.hid_devices import EmulatedKeyPanel, EmulatedLightSensor, EmulatedRelayBoard
from plugins.finding import hid, serial_ports, usb_cameras
from tests.plugins.finding.udev_rules import Given, Part, given, parse

FOLDER = Path(str(resources.files("firmware_configs"))) / "udev"
FILES = sorted(path.name for path in FOLDER.glob("*.rules"))
SEATS = "73-seat-late.rules"
"""Of systemd: what reads the tag uaccess."""


def rules(name: str) -> list[list[Part]]:
    return parse((FOLDER / name).read_text(encoding="utf-8"))


EVERY = [rule for name in FILES for rule in rules(name)]
OPEN = Given("0660", "plugdev", {"uaccess"})


def access(device: Path) -> tuple[str, str, set[str]]:
    found = given(EVERY, device)
    return found.mode, found.group, found.tags


@pytest.fixture
def folder() -> Iterator[Path]:
    with tempfile.TemporaryDirectory(prefix="usb", dir="/tmp") as name:  # a unix socket's path is short
        yield Path(name)


def nodes(folder: Path) -> dict[str, Path]:
    """Everything with a device node, by its name."""
    return {file.parent.name: file.parent for file in (folder / "sys" / "devices").rglob("dev")}


@pytest.mark.parametrize("name", FILES)
def test_every_rule_is_sound_and_read_before_access_is_given_to_seats(name: str) -> None:
    assert rules(name)
    assert name < SEATS
    assert name in {hid.RULES, serial_ports.RULES, usb_cameras.RULES}, "nobody would be told to install it"


def test_udevadm_takes_them_where_it_can_verify() -> None:
    """systemd 254 and later; Debian 12 has 252, and there only the rules' reader above speaks."""
    tool = shutil.which("udevadm")
    if tool is None or subprocess.run([tool, "verify", "--help"], capture_output=True, check=False).returncode:
        return
    files = [str(FOLDER / name) for name in FILES]
    done = subprocess.run([tool, "verify", "--no-summary", *files], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def test_every_device_with_a_driver_may_be_opened_and_no_other(folder: Path) -> None:
    class Other(EmulatedUsbDevice):
        interface_class = (0xFF, 0, 0)

    with UsbBus(folder) as bus:
        for device in (EmulatedRelayBoard(), EmulatedLightSensor(), EmulatedKeyPanel(), numbered_camera()):
            bus.plug(device)
        found = nodes(folder)
        assert len(found) == 4 + 3, "four devices on USB, three of them with a hidraw device as well"
        assert [access(path) for path in found.values()] == [(OPEN.mode, OPEN.group, OPEN.tags)] * len(found)
        bus.plug(Other(UsbNames(0x16C0, 0x05DC, "maker", "another device of the same maker's numbers")))
        (other,) = set(nodes(folder)) - set(found)
        assert access(nodes(folder)[other]) == ("", "", set())


def test_the_numbers_in_the_rules_are_those_that_drivers_claim() -> None:
    claimed = {
        (f"{hid_reports.RELAY_VENDOR:04x}", f"{hid_reports.RELAY_PRODUCT:04x}"),
        (f"{hid_reports.LIGHT_SENSOR_VENDOR:04x}", f"{hid_reports.LIGHT_SENSOR_PRODUCT:04x}"),
        (f"{USBVendorIDs.USB_VID_ELGATO:04x}", ""),
    }
    ways = {"SUBSYSTEM": set[tuple[str, str]](), "KERNEL": set[tuple[str, str]]()}
    for rule in rules(hid.RULES):
        numbers = {part.name: part.value for part in rule if part.key in ("ATTR", "ATTRS")}
        ways[rule[0].key].add((numbers["idVendor"], numbers.get("idProduct", "")))
    assert ways == {"SUBSYSTEM": claimed, "KERNEL": claimed}, "on USB for libusb, and as hidraw"
    (camera,) = rules(usb_cameras.RULES)
    patterns = [part.value for part in camera if part.name == "ID_USB_INTERFACES"]
    assert patterns == ["*:" + "".join(f"{number:02x}" for number in STILL_IMAGE_CLASS) + ":*"]


def test_serial_adapters_on_usb_are_for_dialout_and_not_for_modemmanager(folder: Path) -> None:
    for bus, tty in (("usb", "ttyUSB0"), ("platform", "ttyS0")):
        adapter, port = folder / "devices" / bus, folder / "devices" / bus / tty
        port.mkdir(parents=True)
        for device, subsystem in ((adapter, bus), (port, "tty")):
            (device / "uevent").write_text("")
            (device / "subsystem").symlink_to(Path("/sys/bus") / subsystem)
    usb, own = (given(EVERY, folder / "devices" / place) for place in ("usb/ttyUSB0", "platform/ttyS0"))
    assert (usb.mode, usb.group, usb.tags) == ("0660", "dialout", {"uaccess"})
    assert usb.properties["ID_MM_PORT_IGNORE"] == "1"
    assert (own.mode, own.group, own.tags, own.properties) == ("", "", set(), {})


@pytest.mark.parametrize(
    ("right", "wrong"),
    [
        ("SUBSYSTEM==", "SUBSYTEM=="),
        ("SUBSYSTEM==", "SUBSYSTEM="),
        ('"0660"', '"0690"'),
        ('"plugdev",', '"plugdev"'),
        ("TAG+=", "TAG="),
        ('"uaccess"', '"uaccess'),
        ("ATTR{idVendor}", "ATTR"),
    ],
)
def test_a_damaged_rule_is_named_by_its_line(right: str, wrong: str) -> None:
    text = (FOLDER / hid.RULES).read_text(encoding="utf-8")
    number = next(n for n, line in enumerate(text.splitlines(), 1) if right in line and not line.startswith("#"))
    damaged = "\n".join(
        line.replace(right, wrong, 1) if n == number else line for n, line in enumerate(text.splitlines(), 1)
    )
    with pytest.raises(ValueError, match=f"line {number}:"):
        parse(damaged)
