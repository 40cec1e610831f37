"""The PTP camera driver through real pyusb and libusb, on emulated cameras whose pipes misbehave."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from hal.deadline import Cancelled, in_seconds
from hal.errors import DeviceBusy, DeviceGone, DeviceRefused, DeviceTimeout
from hal.registry import OpenContext
from hal.values import ExposureSettings, FileKind
from plugins.emulated.usb_bus_process import UsbBusProcess
from plugins.ptp_camera import open_camera
from plugins.ptp_usb_bus import UsbAddress, UsbFinder, usb_cameras
from tests.plugins.on_usb_bus.camera_rig import SHORT, SIZE, Rig, bus, lasting_bus, running

__all__ = ["bus", "lasting_bus"]

FLAVOURS = ("generic", "eos-new", "eos-old")


@pytest.fixture(params=FLAVOURS)
def rig(request: pytest.FixtureRequest, bus: UsbBusProcess) -> Iterator[Rig]:
    with running(bus, request.param) as rig:
        yield rig


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
    camera = open_camera({"address": "usb:"}, OpenContext(tmp_path), in_seconds(5))
    try:
        camera.configure(SHORT, deadline=in_seconds(5))
        for number in range(2):
            file = camera.capture(tmp_path / f"shot{number}", deadline=in_seconds(5))[0]
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


@pytest.mark.parametrize("fault", ["drop_after_exposure", "drop_in_transfer", "wrong_lengths"])
def test_what_breaks_the_connection_after_the_exposure_loses_no_picture_and_takes_none_twice(
    rig: Rig, tmp_path: Path, fault: str
) -> None:
    rig.fault(f"camera_faults.{fault}", 1)
    assert rig.capture(tmp_path) == rig.latest()
    assert rig.exposures() == 1
    assert rig.driver.troubles()
    assert rig.capture(tmp_path, "next") == rig.latest()


def test_a_drop_at_the_release_is_told_and_nothing_is_taken_twice(rig: Rig, tmp_path: Path) -> None:
    rig.fault("camera_faults.drop_before_exposure", 1)
    with pytest.raises(DeviceGone) as caught:
        rig.capture(tmp_path)
    assert caught.value.code == "camera-shot-lost"
    assert rig.exposures() == 0
    assert rig.capture(tmp_path) == rig.latest()


def test_after_an_unplug_it_is_found_at_another_address_with_its_settings(rig: Rig, tmp_path: Path) -> None:
    confirmed = rig.driver.configure(ExposureSettings(0.25, 400, 5.6, raw=False), deadline=in_seconds(5))
    before = rig.bus.bus("address_of", "camera")
    rig.bus.unplug("camera")
    with pytest.raises(DeviceGone):
        rig.driver.status(deadline=in_seconds(1))
    rig.bus.call("camera", "camera_off_and_on")
    rig.bus.plug("camera")
    assert rig.bus.bus("address_of", "camera") != before
    assert rig.capture(tmp_path) == rig.latest()
    assert rig.bus.call("camera", "last_exposure_s") == pytest.approx(confirmed.exposure_s, rel=0.01)


def test_another_camera_that_came_meanwhile_is_not_taken_for_it(bus: UsbBusProcess, tmp_path: Path) -> None:
    with running(bus, "eos-new") as rig:
        bus.unplug("camera")
        bus.add("other", "camera", flavour="eos-new", serial="77", time_scale=0.01)
        with pytest.raises(DeviceGone, match="number 0320010001"):
            rig.driver.status(deadline=in_seconds(2))
        bus.plug("camera")
        assert rig.capture(tmp_path) == rig.latest()
        assert bus.get("other", "exposures") == 0


def test_a_body_without_a_usb_serial_number_is_found_again_too(bus: UsbBusProcess, tmp_path: Path) -> None:
    with running(bus, "eos-old", camera={"usb_serial": False}) as rig:
        bus.unplug("camera")
        bus.plug("camera")
        assert rig.capture(tmp_path) == rig.latest()


def test_cameras_are_found_by_serial_number_numbers_and_port(bus: UsbBusProcess) -> None:
    bus.add("relay", "relay")
    bus.add("a", "camera", flavour="eos-new")
    bus.add("b", "camera", flavour="eos-old")
    found = usb_cameras()
    assert [one.serial for one in found] == ["0320010001", "0320010002"]
    for address in ("usb:0320010002", "usb:320010002", "usb:04A9:3110", f"usb:{found[1].port}"):
        link = UsbFinder(UsbAddress.parse(address)).connect(in_seconds(5))
        link.close()
    with pytest.raises(DeviceRefused) as caught:
        UsbFinder(UsbAddress.parse("usb:")).connect(in_seconds(5))
    assert caught.value.code == "camera-which"
    with pytest.raises(DeviceGone) as gone:
        UsbFinder(UsbAddress.parse("usb:1-9")).connect(in_seconds(5))
    assert "0320010001" in gone.value.what


def test_a_camera_that_another_program_holds_is_busy(rig: Rig) -> None:
    with pytest.raises(DeviceBusy) as caught:
        UsbFinder(UsbAddress.parse("usb:")).connect(in_seconds(5))
    assert caught.value.code == "camera-in-use"
    assert "gvfs" in caught.value.remedy


def test_a_silent_camera_ends_with_the_deadline_and_close_does_not_wait(rig: Rig) -> None:
    rig.fault("faults.silent", True)
    started = time.monotonic()
    with pytest.raises((DeviceTimeout, DeviceGone)):
        rig.driver.identity(deadline=in_seconds(0.5))
    assert time.monotonic() - started < 2.0
    started = time.monotonic()
    rig.driver.close()
    assert time.monotonic() - started < 1.5
    rig.fault("faults.silent", False)


def test_work_stops_when_cancelled_and_the_camera_is_usable_afterwards(rig: Rig, tmp_path: Path) -> None:
    rig.driver.configure(ExposureSettings(4.0, 200, raw=False), deadline=in_seconds(5))
    stop = threading.Event()
    threading.Timer(0.2, stop.set).start()
    started = time.monotonic()
    with pytest.raises(Cancelled):
        rig.driver.capture(tmp_path / "shot", deadline=in_seconds(30, stop))
    assert time.monotonic() - started < 1.5
    rig.driver.configure(SHORT, deadline=in_seconds(15))
    assert rig.capture(tmp_path) == rig.latest()
    assert rig.exposures() == 2


def test_what_is_left_in_the_middle_is_cancelled_at_the_camera(rig: Rig) -> None:
    rig.fault("camera_faults.silent", True)
    with pytest.raises((DeviceTimeout, DeviceGone)):
        rig.driver.identity(deadline=in_seconds(0.3))
    assert rig.bus.call("camera", "asked", 0x64) == 1
    rig.fault("camera_faults.silent", False)
    assert rig.driver.identity(deadline=in_seconds(5)).serial


def test_a_camera_that_another_program_left_unready_is_reset(bus: UsbBusProcess) -> None:
    bus.add("camera", "camera", flavour="eos-new")
    bus.set("camera", "pipe_faults.unready", True)
    UsbFinder(UsbAddress()).connect(in_seconds(5)).close()
    assert bus.call("camera", "asked", 0x66) == 1
    UsbFinder(UsbAddress()).connect(in_seconds(5)).close()
    assert bus.call("camera", "asked", 0x66) == 1


def test_raw_and_jpeg_of_one_shot_come_together(bus: UsbBusProcess, tmp_path: Path) -> None:
    with running(bus, "eos-new", both=True) as rig:
        rig.driver.configure(ExposureSettings(0.125, 200, raw=True), deadline=in_seconds(5))
        rig.fault("camera_faults.lost_events", 1)
        for number in range(3):
            files = rig.driver.capture(tmp_path / f"shot{number}", deadline=in_seconds(5))
            assert {file.kind for file in files} == {FileKind.RAW, FileKind.JPEG}
            stamp = b"%08d" % (number + 1)
            assert all(stamp * (SIZE // 8) in file.path.read_bytes() for file in files)
        assert rig.exposures() == 3


def test_noise_from_the_camera_is_never_taken_for_an_answer(rig: Rig) -> None:
    rig.fault("camera_faults.garbage", 1)
    assert rig.driver.identity(deadline=in_seconds(5)).serial
    assert [code for code, _ in rig.driver.troubles()] == ["camera-protocol"]
