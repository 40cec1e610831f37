"""The PTP camera driver through real pyusb and libusb, on emulated cameras whose pipes misbehave."""

from __future__ import annotations

from pathlib import Path

import pytest

from hal.deadline import in_seconds
from hal.errors import DeviceBusy, DeviceGone, DeviceRefused
from hal.registry import OpenContext
from hal.values import ExposureSettings, FileKind
from lab.emulated.usb.process import UsbBusProcess
from plugins.ptp.body import PictureStorage
from plugins.ptp.camera import open_camera
from plugins.ptp.usb.bus import UsbAddress, UsbFinder, usb_cameras
from tests.plugins.on_usb_bus.camera_rig import SIZE, Rig, bus, lasting_bus, rig, running
from tests.plugins.ptp.ptp_rig import SHORT

__all__ = ["bus", "lasting_bus", "rig"]


def test_a_picture_has_the_bytes_of_the_camera(rig: Rig, tmp_path: Path) -> None:
    assert rig.capture(tmp_path) == rig.latest()
    assert rig.capture(tmp_path, "second") == rig.latest()
    assert rig.exposures() == 2


@pytest.mark.parametrize(
    ("knob", "value"),
    [
        ("pipe_faults.split_headers", True),
        ("pipe_faults.unknown_lengths", True),
        ("pipe_faults.zero_packets", False),
        ("pipe_faults.lost_interrupts", 2),
        ("camera_faults.lost_events", 1),
        ("camera_faults.busy", 3),
        ("camera_faults.slow_s", 0.05),
        ("faults.slow_s", 0.02),
    ],
)
def test_a_camera_with_odd_habits_still_gives_its_picture(rig: Rig, tmp_path: Path, knob: str, value: object) -> None:
    rig.fault(knob, value)
    assert rig.capture(tmp_path) == rig.latest()
    assert rig.exposures() == 1


@pytest.mark.parametrize("size", [512 - 12 - 4, 1024 - 12 - 4, 4096 - 12 - 4, 500, 1 << 20, (1 << 21) + 8])
@pytest.mark.parametrize("zero_packets", [True, False])
def test_pictures_of_whole_packets_end_where_they_should(
    bus: UsbBusProcess, tmp_path: Path, size: int, zero_packets: bool
) -> None:
    bus.add("camera", "camera", flavour="generic", size=size, time_scale=0.01)
    bus.set("camera", "pipe_faults.zero_packets", zero_packets)
    camera = open_camera({"address": "usb:"}, OpenContext(tmp_path), in_seconds(20))
    try:
        camera.configure(SHORT, deadline=in_seconds(20))
        for number in range(2):
            file = camera.capture(tmp_path / f"shot{number}", deadline=in_seconds(20))[0]
            assert file.size == size // 8 * 8 + 4
            assert file.path.read_bytes()[2:-2] == b"%08d" % (number + 1) * (size // 8)
    finally:
        camera.close()


@pytest.mark.parametrize("pipe", ["stall_in", "stall_out"])
def test_a_halted_pipe_is_cleared_and_the_transfer_repeated_once(rig: Rig, tmp_path: Path, pipe: str) -> None:
    for number in range(4):
        rig.fault(f"pipe_faults.{pipe}", 1)
        assert rig.capture(tmp_path, f"shot{number}") == rig.latest()
        assert rig.exposures() == number + 1


def test_cameras_are_found_by_serial_number_numbers_and_port(bus: UsbBusProcess) -> None:
    bus.add("relay", "relay")
    bus.add("a", "camera", flavour="eos-new")
    bus.add("b", "camera", flavour="eos-old")
    found = usb_cameras()
    assert [one.serial for one in found] == ["0320010001", "0320010002"]
    for address in ("usb:0320010002", "usb:320010002", "usb:04A9:3110", f"usb:{found[1].port}"):
        link = UsbFinder(UsbAddress.parse(address)).connect(in_seconds(20))
        link.close()
    with pytest.raises(DeviceRefused) as caught:
        UsbFinder(UsbAddress.parse("usb:")).connect(in_seconds(20))
    assert caught.value.code == "camera-which"
    with pytest.raises(DeviceGone) as gone:
        UsbFinder(UsbAddress.parse("usb:1-9")).connect(in_seconds(20))
    assert "0320010001" in gone.value.what


def test_a_camera_that_another_program_holds_is_busy(rig: Rig) -> None:
    with pytest.raises(DeviceBusy) as caught:
        UsbFinder(UsbAddress.parse("usb:")).connect(in_seconds(20))
    assert caught.value.code == "camera-in-use"
    assert "gvfs" in caught.value.remedy


def test_a_camera_that_another_program_left_unready_is_reset(bus: UsbBusProcess) -> None:
    bus.add("camera", "camera", flavour="eos-new")
    bus.set("camera", "pipe_faults.unready", True)
    UsbFinder(UsbAddress()).connect(in_seconds(20)).close()
    assert bus.call("camera", "asked", 0x66) == 1
    UsbFinder(UsbAddress()).connect(in_seconds(20)).close()
    assert bus.call("camera", "asked", 0x66) == 1


def test_raw_and_jpeg_of_one_shot_come_together(bus: UsbBusProcess, tmp_path: Path) -> None:
    with running(bus, "eos-new", storage=PictureStorage(both=True)) as rig:
        rig.driver.configure(ExposureSettings(0.125, 200, raw=True), deadline=in_seconds(20))
        rig.fault("camera_faults.lost_events", 1)
        for number in range(3):
            files = rig.driver.capture(tmp_path / f"shot{number}", deadline=in_seconds(20))
            assert {file.kind for file in files} == {FileKind.RAW, FileKind.JPEG}
            stamp = b"%08d" % (number + 1)
            assert all(stamp * (SIZE // 8) in file.path.read_bytes() for file in files)
        assert rig.exposures() == 3
