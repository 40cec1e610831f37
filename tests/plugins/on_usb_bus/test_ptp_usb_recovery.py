"""The PTP camera driver through real pyusb and libusb, on emulated cameras that go, come back and fall silent."""

from __future__ import annotations

import contextlib
import threading
import time
from pathlib import Path

import pytest

from hal.deadline import Cancelled, in_seconds
from hal.errors import DeviceGone, DeviceTimeout
from hal.values import ExposureSettings
from lab.emulated.usb.process import UsbBusProcess
from plugins.ptp.still import PtpCamera
from plugins.ptp.usb.bus import UsbAddress, UsbFinder
from tests.plugins.on_usb_bus.camera_rig import Rig, bus, lasting_bus, rig, running
from tests.plugins.ptp.ptp_rig import FLAVOURS, HASTY, PATIENT, SHORT, when

__all__ = ["bus", "lasting_bus", "rig"]


@pytest.mark.parametrize("fault", ["drop_after_exposure", "drop_in_transfer", "wrong_lengths"])
def test_what_breaks_the_connection_after_the_exposure_loses_no_picture_and_takes_none_twice(
    rig: Rig, tmp_path: Path, fault: str
) -> None:
    rig.fault(f"camera_faults.{fault}", 1)
    assert rig.capture(tmp_path) == rig.latest()
    assert rig.exposures() == 1
    assert rig.driver.notices()
    assert rig.capture(tmp_path, "next") == rig.latest()


@pytest.mark.parametrize("flavour", FLAVOURS)
def test_a_drop_at_the_release_is_told_and_nothing_is_taken_twice(
    bus: UsbBusProcess, tmp_path: Path, flavour: str
) -> None:
    with running(bus, flavour, timing=HASTY) as rig:
        rig.fault("camera_faults.drop_before_exposure", 1)
        with pytest.raises(DeviceGone) as caught:
            rig.capture(tmp_path)
        assert caught.value.code == "camera-shot-lost"
        assert rig.exposures() == 0
        assert rig.capture(tmp_path) == rig.latest()


def test_after_an_unplug_it_is_found_at_another_address_with_its_settings(rig: Rig, tmp_path: Path) -> None:
    confirmed = rig.driver.configure(ExposureSettings(0.25, 400, 5.6, raw=False), deadline=in_seconds(20))
    before = rig.bus.bus("address_of", "camera")
    rig.bus.unplug("camera")
    with pytest.raises(DeviceGone):
        rig.driver.status(deadline=in_seconds(1))
    rig.bus.call("camera", "camera_off_and_on")
    rig.bus.plug("camera")
    assert rig.bus.bus("address_of", "camera") != before
    assert rig.capture(tmp_path) == rig.latest()
    assert rig.bus.call("camera", "last_exposure_s") == pytest.approx(confirmed.exposure_s, rel=0.01)


def test_a_cable_that_is_loose_when_the_camera_is_opened_does_not_matter(bus: UsbBusProcess, tmp_path: Path) -> None:
    with running(bus, "eos-new") as rig:
        rig.driver.close()
        bus.unplug("camera")
        soon = threading.Timer(0.5, bus.plug, ["camera"])
        soon.start()
        rig.driver = PtpCamera(UsbFinder(UsbAddress.parse("usb:")).connect, timing=PATIENT, deadline=in_seconds(20))
        soon.join()
        with contextlib.closing(rig.driver):
            assert rig.capture(tmp_path) == rig.latest()


def test_another_camera_that_came_meanwhile_is_not_taken_for_it(bus: UsbBusProcess, tmp_path: Path) -> None:
    with running(bus, "eos-new") as rig:
        bus.unplug("camera")
        bus.add("other", "camera", flavour="eos-new", serial="77", time_scale=0.01)
        with pytest.raises(DeviceGone, match="number 0320010001"):
            rig.driver.status(deadline=in_seconds(2))
        bus.plug("camera")
        assert rig.capture(tmp_path) == rig.latest()
        assert bus.get("other", "body.exposures") == 0


def test_a_body_without_a_usb_serial_number_is_found_again_too(bus: UsbBusProcess, tmp_path: Path) -> None:
    with running(bus, "eos-old", camera={"usb_serial": False}) as rig:
        bus.unplug("camera")
        bus.plug("camera")
        assert rig.capture(tmp_path) == rig.latest()


def test_a_silent_camera_ends_with_the_deadline_and_close_does_not_wait(rig: Rig) -> None:
    rig.fault("faults.silent", True)
    started = time.monotonic()
    with pytest.raises((DeviceTimeout, DeviceGone)):
        rig.driver.identity(deadline=in_seconds(0.5))
    assert time.monotonic() - started < 10.0
    started = time.monotonic()
    rig.driver.close()
    assert time.monotonic() - started < 10.0
    rig.fault("faults.silent", False)


def test_work_stops_when_cancelled_and_the_camera_is_usable_afterwards(rig: Rig, tmp_path: Path) -> None:
    rig.driver.configure(ExposureSettings(6.0, 200, raw=False), deadline=in_seconds(20))
    stop = threading.Event()
    when(lambda: rig.exposures() == 1, stop.set)
    started = time.monotonic()
    with pytest.raises(Cancelled):
        rig.driver.capture(tmp_path / "shot", deadline=in_seconds(60, stop))
    assert time.monotonic() - started < 10.0
    rig.driver.configure(SHORT, deadline=in_seconds(60))
    assert rig.capture(tmp_path) == rig.latest()
    assert rig.exposures() == 2


def test_what_is_left_in_the_middle_is_cancelled_at_the_camera(rig: Rig) -> None:
    rig.fault("camera_faults.silent", True)
    with pytest.raises((DeviceTimeout, DeviceGone)):
        rig.driver.identity(deadline=in_seconds(0.3))
    assert rig.bus.call("camera", "asked", 0x64) == 1
    rig.fault("camera_faults.silent", False)
    assert rig.driver.identity(deadline=in_seconds(20)).serial


def test_noise_from_the_camera_is_never_taken_for_an_answer(rig: Rig) -> None:
    rig.fault("camera_faults.garbage", 1)
    assert rig.driver.identity(deadline=in_seconds(20)).serial
    assert [notice.code for notice in rig.driver.notices()] == ["camera-protocol"]
