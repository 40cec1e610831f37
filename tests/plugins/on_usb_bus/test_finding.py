"""Finding cameras and HID devices with real libusb and hidapi on the emulated bus."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from hal.deadline import in_seconds
from hal.finding import Found, SearchScope
from lab.emulated.usb.process import UsbBusProcess
from plugins.finding import access, hid, usb_cameras


def looked(finder: object, folder: Path) -> list[Found]:
    find = {"hid": hid.find, "usb": usb_cameras.find}[str(finder)]
    return list(find(SearchScope(folder), in_seconds(20)))


def test_every_hid_device_that_has_a_driver_is_found_and_no_relay_moves(bus: UsbBusProcess, tmp_path: Path) -> None:
    bus.add("relay", "relay", channels=4, serial="BOARD")
    bus.add("light", "light", lux=0.5)
    bus.add("keys", "keys")
    found = {one.driver: one for one in looked("hid", tmp_path)}
    assert set(found) == {"usb-relay", "colorhug-als", "stream-deck"}
    assert found["usb-relay"].settings == {"serial": "BOARD"}
    assert "4 relays" in found["usb-relay"].what
    assert all(one.problems == () for one in found.values())
    assert bus.get("relay", "switched") == [0, 0, 0, 0]


def test_two_boards_with_the_same_numbers_are_told_apart(bus: UsbBusProcess, tmp_path: Path) -> None:
    bus.add("a", "relay", channels=1, serial="ONE11")
    bus.add("b", "relay", channels=2, serial="TWO22")
    assert sorted(one.identity for one in looked("hid", tmp_path)) == ["ONE11", "TWO22"]


def test_a_camera_is_found_by_its_serial_number_and_nothing_is_sent_to_it(bus: UsbBusProcess, tmp_path: Path) -> None:
    bus.add("camera", "camera")
    (found,) = looked("usb", tmp_path)
    assert (found.kind, found.driver) == ("camera", "ptp")
    # This machine's desktop may run a program that takes cameras.
    assert {problem.code for problem in found.problems} <= {"camera-may-be-taken"}
    assert found.settings["address"].startswith("usb:")
    assert bus.get("camera", "body.exposures") == 0


def test_a_camera_with_commands_of_its_maker_is_proposed_with_libgphoto2(bus: UsbBusProcess, tmp_path: Path) -> None:
    bus.add("camera", "camera", flavour="nikon")
    (found,) = looked("usb", tmp_path)
    assert (found.driver, found.settings) == ("gphoto2", {})
    bus.add("other", "camera", flavour="sony")
    bus.add("third", "camera", flavour="eos-new")
    addresses = {one.driver: str(one.settings["address"]) for one in looked("usb", tmp_path)}
    assert set(addresses) == {"gphoto2", "ptp"}
    assert re.fullmatch(r"usb:[0-9]{3},[0-9]{3}", addresses["gphoto2"])


def test_a_program_that_takes_cameras_is_named(bus: UsbBusProcess, tmp_path: Path) -> None:
    bus.add("camera", "camera")
    # A program of that name, as the desktop starts it; it holds nothing yet.
    taker = tmp_path / "gvfs-gphoto2-volume-monitor"
    taker.symlink_to(sys.executable)
    environment = {key: value for key, value in os.environ.items() if key != "LD_PRELOAD"}
    process = subprocess.Popen(
        [str(taker), "-c", "import sys; print(flush=True); sys.stdin.read()"],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment,
    )  # fmt: skip
    assert process.stdout is not None
    process.stdout.readline()
    try:
        (found,) = looked("usb", tmp_path)
    finally:
        process.communicate()
    assert [problem.code for problem in found.problems] == ["camera-may-be-taken"]
    assert f"({process.pid})" in found.problems[0].what
    assert "systemctl --user mask" in found.problems[0].remedy


def test_the_rule_for_each_device_is_the_shipped_one() -> None:
    for rules, needle in ((hid.RULES, "16c0"), (hid.RULES, "273f"), (hid.RULES, "0fd9"), (usb_cameras.RULES, "usb")):
        assert 'GROUP="plugdev"' in access.rule_text(rules, needle)
        assert "#" not in access.rule_text(rules, needle)


def test_a_stalled_board_does_not_keep_the_others_from_being_found(bus: UsbBusProcess, tmp_path: Path) -> None:
    bus.add("relay", "relay", channels=2, serial="QUIET")
    bus.add("light", "light", lux=0.5)
    bus.set("relay", "faults.stalls", 100)
    found = {one.driver: one for one in looked("hid", tmp_path)}
    assert set(found) == {"usb-relay", "colorhug-als"}
    assert [problem.code for problem in found["usb-relay"].problems] == ["hid-not-opened"]


@pytest.mark.parametrize("fault", ["stuck", "silent"])
def test_a_silent_board_takes_only_its_own_share_of_the_time(bus: UsbBusProcess, tmp_path: Path, fault: str) -> None:
    """Stuck: the call into the kernel does not come back; silent: it comes back with an error."""
    bus.add("a", "relay", channels=1, serial="FIRST")
    bus.add("quiet", "relay", channels=2, serial="QUIET")
    bus.add("b", "relay", channels=4, serial="THIRD")
    bus.add("light", "light", lux=0.5)
    bus.set("quiet", f"faults.{fault}", True)
    found = looked("hid", tmp_path)
    assert sorted((one.driver, one.settings.get("serial", "")) for one in found) == [
        ("colorhug-als", ""), ("usb-relay", ""), ("usb-relay", "FIRST"), ("usb-relay", "THIRD"),
    ]  # fmt: skip
    codes = {one.what: [problem.code for problem in one.problems] for one in found}
    assert codes.pop("relay board with 2 relays") == ["hid-no-answer" if fault == "stuck" else "hid-not-opened"]
    assert not any(codes.values())
    bus.set("quiet", f"faults.{fault}", False)
