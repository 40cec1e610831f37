"""What bodies can do beyond one short picture: bulb, live view, status, changing their mind, falling asleep."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from hal.codecs.ptp.eos import exposure_of
from hal.codecs.ptp.values import Operation
from hal.deadline import Cancelled, in_seconds
from hal.errors import DeviceError, DeviceGone, DeviceRefused, DeviceTimeout
from hal.interfaces import LiveViewCamera, WatchedCamera
from hal.values import ExposureSettings
from lab.emulated.cameras.camera import EmulatedPtpCamera
from plugins.emulated.cameras.body import CameraFaults
from plugins.emulated.cameras.wire import GENERAL_ERROR
from plugins.ptp.ip import PtpIpAddress, PtpIpLink
from plugins.ptp.link import Reply
from plugins.ptp.shot import Timing
from plugins.ptp.still import PtpCamera
from tests.plugins.ptp.ptp_rig import FLAVOURS, HASTY, PATIENT, SHORT, Rig, Studio, connect, running, when
from tests.waiting import wait_for

BULB_S = 0.7


def short_shutter(emulator: EmulatedPtpCamera) -> None:
    """Make the body believe that a quarter of a second is its longest timed exposure."""
    body = emulator.body
    body.shutter_codes(tuple(code for code in body.shutter_codes() if (exposure_of(code) or 0.0) <= 0.25))  # type: ignore[attr-defined]


def test_bulb_exposes_for_the_asked_time_where_the_shutter_has_none_so_long(tmp_path: Path) -> None:
    with running("eos-new", time_scale=1.0) as rig:
        assert rig.driver.capabilities.bulb
        short_shutter(rig.emulator)
        confirmed = rig.driver.configure(ExposureSettings(BULB_S, 200, raw=False), deadline=in_seconds(20))
        assert confirmed.exposure_s == BULB_S
        began_s = time.monotonic()
        assert rig.capture(tmp_path) == rig.latest()
        # A loaded machine closes the shutter late, never early.
        assert BULB_S - 0.02 <= rig.studio.shots[-1].exposure_s <= time.monotonic() - began_s
        rig.driver.configure(ExposureSettings(0.125, 200, raw=False), deadline=in_seconds(20))
        assert rig.capture(tmp_path, "next") == rig.latest()
        assert rig.studio.shots[-1].exposure_s == pytest.approx(0.125)


def test_a_cancelled_bulb_exposure_closes_the_shutter(tmp_path: Path) -> None:
    with running("eos-new", time_scale=1.0) as rig:
        short_shutter(rig.emulator)
        rig.driver.configure(ExposureSettings(60.0, 200, raw=False), deadline=in_seconds(20))
        stop = threading.Event()
        when(lambda: rig.emulator.body.exposures == 1, stop.set)
        with pytest.raises(Cancelled):
            rig.driver.capture(tmp_path / "shot", deadline=in_seconds(200, stop))
        rig.driver.configure(ExposureSettings(0.125, 200, raw=False), deadline=in_seconds(20))
        assert rig.capture(tmp_path) == rig.latest()
        assert rig.studio.shots[0].exposure_s < 30.0


def test_a_bulb_exposure_whose_connection_is_lost_is_told_and_not_kept(tmp_path: Path) -> None:
    with running("eos-new", time_scale=1.0) as rig:
        short_shutter(rig.emulator)
        rig.driver.configure(ExposureSettings(BULB_S, 200, raw=False), deadline=in_seconds(20))
        when(lambda: rig.emulator.body.exposures == 1, rig.emulator.drop_connection)
        with pytest.raises(DeviceGone):
            rig.capture(tmp_path)
        assert rig.capture(tmp_path, "again") == rig.latest()
        assert rig.studio.shots[-1].exposure_s >= BULB_S - 0.02
        assert [path.name for path in tmp_path.iterdir()] == ["again.jpg"]


def test_a_stop_before_the_body_has_answered_that_its_shutter_is_open_closes_it(tmp_path: Path) -> None:
    stop = threading.Event()

    class Stopped(PtpIpLink):
        """Is cancelled when the request has gone, and nothing has come."""

        def transact(self, operation: int, *parameters: int, **options: Any) -> Reply:
            self.asked = operation
            return super().transact(operation, *parameters, **options)

        def _answer(self, *arguments: Any) -> Reply:
            if self.asked == Operation.EOS_BULB_START:
                stop.set()
            return super()._answer(*arguments)

    with EmulatedPtpCamera(Studio().expose, flavour="eos-new", time_scale=1.0) as emulator:
        address = PtpIpAddress.parse(emulator.address)
        driver = PtpCamera(
            lambda until: Stopped.connect(address, deadline=until), timing=PATIENT, deadline=in_seconds(20)
        )
        try:
            short_shutter(emulator)
            driver.configure(ExposureSettings(60.0, 200, raw=False), deadline=in_seconds(20))
            with pytest.raises(Cancelled):
                driver.capture(tmp_path / "shot", deadline=in_seconds(200, stop))
            wait_for(lambda: emulator.body.exposures == 1)
            assert emulator.body.close_shutter().code == GENERAL_ERROR  # it is closed
        finally:
            driver.close()


def test_a_shutter_that_a_killed_program_left_open_is_closed_by_the_next(tmp_path: Path) -> None:
    with running("eos-new", time_scale=1.0) as rig:
        short_shutter(rig.emulator)
        rig.driver.configure(ExposureSettings(60.0, 200, raw=False), deadline=in_seconds(20))
        stop = threading.Event()

        def kill() -> None:
            rig.emulator.drop_connection()
            stop.set()

        when(lambda: rig.emulator.body.exposures == 1, kill)
        with pytest.raises(DeviceError):
            rig.driver.capture(tmp_path / "shot", deadline=in_seconds(200, stop))
        rig.driver.close()
        another = connect(rig.emulator, timing=HASTY)
        try:
            another.configure(SHORT, deadline=in_seconds(20))
            assert len(another.capture(tmp_path / "next", deadline=in_seconds(30))) == 1
        finally:
            another.close()


@pytest.mark.parametrize("flavour", ["generic", "eos-old"])
def test_bodies_without_bulb_and_live_view_say_so(flavour: str) -> None:
    with running(flavour) as rig:  # type: ignore[arg-type]
        assert not rig.driver.capabilities.bulb
        assert not rig.driver.capabilities.live_view
        with pytest.raises(DeviceRefused) as caught:
            rig.driver.live_view(deadline=in_seconds(20))
        assert caught.value.code == "camera-no-live-view"
        rig.driver.end_live_view(deadline=in_seconds(20))


def test_live_view_gives_frames_and_is_off_for_a_picture(tmp_path: Path) -> None:
    with running("eos-new") as rig:
        assert isinstance(rig.driver, LiveViewCamera)
        assert rig.driver.capabilities.live_view
        for _ in range(3):
            frame = rig.driver.live_view(deadline=in_seconds(20))
            assert frame.startswith(b"\xff\xd8")
            assert frame.endswith(b"\xff\xd9")
        assert rig.emulator.body.exposures == 0
        assert rig.capture(tmp_path) == rig.latest()
        assert rig.driver.live_view(deadline=in_seconds(20)).startswith(b"\xff\xd8")
        rig.driver.end_live_view(deadline=in_seconds(20))
        assert rig.capture(tmp_path, "next") == rig.latest()


@pytest.mark.parametrize("flavour", FLAVOURS)
def test_the_status_tells_battery_card_and_what_to_look_after(flavour: str) -> None:
    with running(flavour) as rig:  # type: ignore[arg-type]
        assert isinstance(rig.driver, WatchedCamera)
        status = rig.driver.status(deadline=in_seconds(20))
        assert (status.battery_percent or 0) >= 75
        assert status.free_bytes == 4 << 30
        assert status.warnings == ()
        rig.emulator.body.battery_percent = 12
        rig.emulator.body.card.capacity = 1 << 20
        status = rig.driver.status(deadline=in_seconds(20))
        assert set(status.warnings) == {"battery-low", "card-nearly-full"}


@pytest.mark.parametrize("flavour", ["eos-new", "eos-old"])
def test_a_target_that_flips_silently_loses_no_picture_and_is_set_again(flavour: str, tmp_path: Path) -> None:
    with running(flavour) as rig:  # type: ignore[arg-type]
        rig.emulator.faults.target_flips = 1
        for number in range(3):
            assert rig.capture(tmp_path, f"shot{number}") == rig.latest()
            assert rig.emulator.body.exposures == number + 1
        assert rig.emulator.body.pictures_on_card == 0
        assert rig.driver.status(deadline=in_seconds(20)).warnings == ("target-changed",)
        assert "camera-target-changed" in [notice.code for notice in rig.driver.notices()]


@pytest.mark.parametrize("flavour", ["eos-new", "eos-old"])
def test_autofocus_that_fails_is_told_and_leaves_no_button_down(flavour: str, tmp_path: Path) -> None:
    with running(flavour) as rig:  # type: ignore[arg-type]
        rig.emulator.faults.autofocus_fails = 1
        with pytest.raises(DeviceRefused) as caught:
            rig.capture(tmp_path)
        assert caught.value.code == "camera-autofocus"
        assert rig.emulator.body.exposures == 0
        assert rig.capture(tmp_path) == rig.latest()


def test_a_camera_that_nobody_talks_to_is_kept_awake() -> None:
    timing = Timing(idle_s=0.05)
    with running("eos-new", timing=timing) as rig:
        before = rig.emulator.body.answered.get(0x911D, 0)
        ends_s = time.monotonic() + 30
        while rig.emulator.body.answered.get(0x911D, 0) - before < 3 and time.monotonic() < ends_s:
            time.sleep(0.02)
        assert rig.emulator.body.answered[0x911D] - before >= 3


def test_a_body_that_is_about_to_fall_asleep_is_told_to_stay_awake_at_once() -> None:
    with running("eos-new", timing=Timing()) as rig:
        before = rig.emulator.body.answered.get(0x911D, 0)
        rig.emulator.body.falls_asleep_soon()  # type: ignore[attr-defined]
        rig.driver.status(deadline=in_seconds(20))
        assert rig.emulator.body.answered[0x911D] == before + 1


def test_mended_faults_are_told_for_the_journal_once(tmp_path: Path) -> None:
    with running("generic") as rig:
        rig.emulator.faults.busy = 1
        rig.capture(tmp_path)
        rig.emulator.faults.drop_in_transfer = 1
        rig.capture(tmp_path)
        told = [notice.code for notice in rig.driver.notices()]
        assert told == ["camera-busy", "camera-disconnected"]
        assert rig.driver.notices() == []


def test_a_target_that_is_never_confirmed_costs_a_note_and_not_the_camera(tmp_path: Path) -> None:
    faults = CameraFaults(unconfirmed=frozenset({0xD11C}))
    with eos(faults) as rig:
        notes = [notice.code for notice in rig.driver.notices()]
        assert notes == ["camera-not-confirmed"]
        assert rig.capture(tmp_path, "shot") == rig.latest()


def test_an_exposure_that_is_never_confirmed_is_no_measurement() -> None:
    with eos(CameraFaults(unconfirmed=frozenset({0xD103}))) as rig, pytest.raises(DeviceTimeout) as caught:
        rig.driver.configure(replace(SHORT, iso=800), deadline=in_seconds(30))
    assert caught.value.code == "camera-not-confirmed"


def test_a_body_that_refuses_to_hear_of_the_computers_space_is_used_with_a_note(tmp_path: Path) -> None:
    with eos(CameraFaults(space_refused=True)) as rig:
        assert rig.capture(tmp_path, "one") == rig.latest()
        assert rig.capture(tmp_path, "two") == rig.latest()
        assert [notice.code for notice in rig.driver.notices()] == ["camera-space-refused"]


def test_a_body_that_is_not_ready_at_the_start_of_live_view_is_no_trouble() -> None:
    with running("eos-new") as rig:
        rig.driver.notices()
        assert rig.driver.live_view(deadline=in_seconds(20)).startswith(b"\xff\xd8")
        assert rig.emulator.body.answered[0x9153] > 1, "it was not ready at first"
        assert rig.driver.notices() == []


@contextlib.contextmanager
def eos(faults: CameraFaults) -> Iterator[Rig]:
    """A driver that is opened on a body with these habits, and waits little for its reports."""
    studio = Studio()
    with EmulatedPtpCamera(studio.expose, flavour="eos-new", time_scale=0.0, faults=faults) as emulator:
        driver = connect(emulator, timing=replace(PATIENT, confirm_s=0.3))
        try:
            yield Rig(emulator, studio, driver)
        finally:
            driver.close()
