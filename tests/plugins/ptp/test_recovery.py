"""The PTP camera driver on emulated cameras that misbehave like real ones."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from hal.deadline import Cancelled, in_seconds
from hal.errors import (
    DeviceBusy,
    DeviceError,
    DeviceGone,
    DeviceRefused,
    DeviceTimeout,
    ProtocolError,
)
from hal.registry import OpenContext
from hal.values import ExposureSettings
from lab.emulated.cameras.camera import EmulatedPtpCamera, Flavour
from plugins.emulated.cameras.body import CameraNames
from plugins.ptp.camera import open_camera
from tests.plugins.ptp.ptp_rig import (
    FLAVOURS,
    HASTY,
    SHORT,
    Rig,
    Studio,
    card_rig,
    connect,
    left_behind,
    rig,
    running,
    when,
)

__all__ = ["card_rig", "rig"]


@pytest.fixture(params=FLAVOURS)
def hasty_rig(request: pytest.FixtureRequest) -> Iterator[Rig]:
    with running(request.param, timing=HASTY) as rig:
        yield rig


def test_a_busy_camera_is_asked_again_until_it_is_ready_and_fires_once(rig: Rig, tmp_path: Path) -> None:
    rig.emulator.faults.busy = 4
    assert rig.capture(tmp_path) == rig.latest()
    assert rig.emulator.body.exposures == 1


def test_a_camera_that_stays_busy_is_given_up_in_time_and_works_again_later(hasty_rig: Rig, tmp_path: Path) -> None:
    hasty_rig.emulator.faults.busy = 10_000
    started = time.monotonic()
    with pytest.raises(DeviceBusy):
        hasty_rig.capture(tmp_path)
    assert time.monotonic() - started < 15
    assert left_behind(tmp_path) == []
    hasty_rig.emulator.faults.busy = 0
    assert hasty_rig.capture(tmp_path) == hasty_rig.latest()
    assert hasty_rig.emulator.body.exposures == 1


def test_settings_are_set_even_when_the_camera_is_busy_at_first(rig: Rig) -> None:
    rig.emulator.faults.busy = 3
    confirmed = rig.driver.configure(ExposureSettings(1.0, 800, raw=False), deadline=in_seconds(20))
    assert (confirmed.exposure_s, confirmed.iso) == (1.0, 800)


def test_a_connection_lost_after_the_exposure_loses_no_picture_and_takes_none_twice(rig: Rig, tmp_path: Path) -> None:
    rig.emulator.faults.drop_after_exposure = 1
    assert rig.capture(tmp_path) == rig.latest()
    assert rig.emulator.body.exposures == 1
    assert rig.capture(tmp_path, "next") == rig.latest()
    assert rig.emulator.body.exposures == 2


def test_a_connection_lost_at_the_release_is_told_and_nothing_is_taken_twice(hasty_rig: Rig, tmp_path: Path) -> None:
    hasty_rig.emulator.faults.drop_before_exposure = 1
    with pytest.raises(DeviceGone) as caught:
        hasty_rig.capture(tmp_path)
    assert caught.value.code == "camera-shot-lost"
    assert hasty_rig.emulator.body.exposures == 0
    assert left_behind(tmp_path) == []
    assert hasty_rig.capture(tmp_path) == hasty_rig.latest()
    assert hasty_rig.studio.shots[-1].iso == SHORT.iso


def test_a_connection_lost_in_the_download_is_made_good(rig: Rig, tmp_path: Path) -> None:
    rig.emulator.faults.drop_in_transfer = 1
    assert rig.capture(tmp_path) == rig.latest()
    assert rig.emulator.body.exposures == 1
    assert left_behind(tmp_path) == ["shot.jpg"]


def test_a_download_of_the_wrong_length_is_never_kept(rig: Rig, tmp_path: Path) -> None:
    rig.emulator.faults.wrong_lengths = 1
    assert rig.capture(tmp_path) == rig.latest()
    assert rig.emulator.body.exposures == 1
    rig.emulator.faults.wrong_lengths = 1000
    with pytest.raises(ProtocolError):
        rig.capture(tmp_path, "bad")
    assert left_behind(tmp_path) == ["shot.jpg"]


def test_a_picture_whose_event_was_lost_is_found(rig: Rig, tmp_path: Path) -> None:
    rig.emulator.faults.lost_events = 1
    assert rig.capture(tmp_path) == rig.latest()
    assert rig.capture(tmp_path, "next") == rig.latest()
    assert rig.emulator.body.exposures == 2


def test_a_lost_event_on_the_card_of_an_eos_is_made_good(card_rig: Rig, tmp_path: Path) -> None:
    card_rig.emulator.faults.lost_events = 1
    assert card_rig.capture(tmp_path) == card_rig.latest()


def test_noise_on_the_line_does_not_end_in_a_wrong_answer(rig: Rig) -> None:
    rig.emulator.faults.garbage = 1
    assert rig.driver.identity(deadline=in_seconds(20)).serial == connect_serial(rig)


def connect_serial(rig: Rig) -> str:
    rig.driver.close()
    other = connect(rig.emulator)
    try:
        return other.identity(deadline=in_seconds(20)).serial
    finally:
        other.close()


def test_a_silent_camera_ends_with_the_deadline(rig: Rig, tmp_path: Path) -> None:
    rig.emulator.faults.silent = True
    started = time.monotonic()
    with pytest.raises(DeviceError) as caught:
        rig.capture(tmp_path, seconds=0.8)
    assert isinstance(caught.value, DeviceTimeout | DeviceGone)
    assert time.monotonic() - started < 10
    rig.emulator.faults.silent = False
    assert rig.capture(tmp_path) == rig.latest()


def test_a_slow_camera_is_waited_for(rig: Rig, tmp_path: Path) -> None:
    rig.emulator.faults.slow_s = 0.03
    assert rig.capture(tmp_path) == rig.latest()


def test_work_stops_as_soon_as_it_is_cancelled_and_the_camera_is_usable_afterwards(rig: Rig, tmp_path: Path) -> None:
    rig.driver.configure(ExposureSettings(6.0, 200, raw=False), deadline=in_seconds(20))
    stop = threading.Event()
    when(lambda: rig.emulator.body.exposures == 1, stop.set)
    started = time.monotonic()
    with pytest.raises(Cancelled):
        rig.driver.capture(tmp_path / "shot", deadline=in_seconds(60, stop))
    assert time.monotonic() - started < 10
    assert left_behind(tmp_path) == []
    # the body is busy until the exposure is over
    rig.driver.configure(SHORT, deadline=in_seconds(60))
    assert rig.capture(tmp_path) == rig.latest()
    assert rig.emulator.body.exposures == 2


def test_an_exposure_that_cannot_fit_into_the_deadline_is_not_begun(rig: Rig, tmp_path: Path) -> None:
    rig.driver.configure(ExposureSettings(8.0, 200, raw=False), deadline=in_seconds(20))
    with pytest.raises(DeviceTimeout) as caught:
        rig.capture(tmp_path, seconds=5.0)
    assert caught.value.code == "camera-deadline-too-short"
    assert rig.emulator.body.exposures == 0


def test_a_full_card_is_named_and_nothing_is_exposed(rig: Rig, tmp_path: Path) -> None:
    rig.emulator.faults.card_full = True
    with pytest.raises(DeviceRefused) as caught:
        rig.capture(tmp_path)
    assert caught.value.code == "card-full"
    assert rig.emulator.body.exposures == 0
    rig.emulator.faults.card_full = False
    assert rig.capture(tmp_path) == rig.latest()


def test_a_camera_that_is_switched_off_is_named_and_found_again_with_its_settings(
    hasty_rig: Rig, tmp_path: Path
) -> None:
    hasty_rig.emulator.stop()
    with pytest.raises(DeviceGone) as caught:
        hasty_rig.capture(tmp_path)
    assert caught.value.code == "camera-off"
    hasty_rig.emulator.start()
    assert hasty_rig.capture(tmp_path) == hasty_rig.latest()
    assert hasty_rig.studio.shots[-1].iso == SHORT.iso


def test_a_camera_that_is_off_at_the_start_is_told_at_once() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    started = time.monotonic()
    with pytest.raises(DeviceGone) as caught:
        open_camera({"address": f"ptpip:127.0.0.1:{port}"}, OpenContext(Path()), in_seconds(60))
    assert caught.value.code == "camera-off"
    assert caught.value.remedy
    assert time.monotonic() - started < 10


def test_a_camera_that_another_computer_holds_is_busy(rig: Rig) -> None:
    with pytest.raises(DeviceBusy) as caught:
        connect(rig.emulator)
    assert caught.value.code == "camera-in-use"


def test_another_camera_at_the_same_address_does_not_go_unnoticed(tmp_path: Path) -> None:
    studio = Studio()
    with EmulatedPtpCamera(studio.expose) as first:
        driver = connect(first)
        ports = [int(port) for port in first.address.split(":")[2:]]
    other = CameraNames(serial="ANOTHER")
    with EmulatedPtpCamera(studio.expose, ports=(ports[0], ports[1]), names=other):
        with pytest.raises(DeviceRefused) as caught:
            driver.capture(tmp_path / "shot", deadline=in_seconds(20))
        assert caught.value.code == "camera-other"
    driver.close()


def test_one_port_for_both_connections_is_how_most_cameras_do_it(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    studio = Studio()
    with EmulatedPtpCamera(studio.expose, ports=(port, port), time_scale=0.0):
        driver = open_camera({"address": f"ptpip:127.0.0.1:{port}"}, OpenContext(tmp_path), in_seconds(20))
        driver.configure(SHORT, deadline=in_seconds(20))
        assert driver.capture(tmp_path / "shot", deadline=in_seconds(20))
        driver.close()


def test_a_port_in_use_is_named_by_the_emulated_camera() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(DeviceError) as caught:
            EmulatedPtpCamera(Studio().expose, ports=(port, 0)).start()
    assert caught.value.code == "port-in-use"
    assert str(port) in caught.value.what


def test_many_captures_with_faults_lose_and_double_nothing(tmp_path: Path) -> None:
    """A short form of the endurance run: every answer is the newest picture or an error that says so."""
    faults: tuple[Callable[[Rig], None], ...] = (
        lambda rig: None,
        lambda rig: setattr(rig.emulator.faults, "busy", 2),
        lambda rig: setattr(rig.emulator.faults, "drop_after_exposure", 1),
        lambda rig: setattr(rig.emulator.faults, "drop_in_transfer", 1),
        lambda rig: setattr(rig.emulator.faults, "wrong_lengths", 1),
        lambda rig: setattr(rig.emulator.faults, "lost_events", 1),
    )

    def endure(flavour: Flavour) -> int:
        with running(flavour, studio=Studio(20_000)) as rig:
            for number in range(24):
                faults[number * 7 % len(faults)](rig)
                assert rig.capture(tmp_path, f"{flavour}-{number}") == rig.latest()
                assert rig.emulator.body.exposures == number + 1
            return rig.emulator.body.exposures

    with ThreadPoolExecutor(len(FLAVOURS)) as side_by_side:
        assert list(side_by_side.map(endure, FLAVOURS)) == [24] * len(FLAVOURS)
