"""The driver on libgphoto2: the shared suite on libgphoto2's own virtual camera, and how its words are read."""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from hal.conformance import CameraConformance
from hal.deadline import in_seconds
from hal.errors import DeviceError, DeviceGone, DeviceTimeout, PluginError
from hal.registry import OpenContext
from hal.values import ExposureSettings
from plugins.gphoto2 import library as words
from plugins.gphoto2.camera import DRIVER, Gphoto2Camera, open_camera
from tests.campaigns.camera_peers import FLAVOURS, Flavour, driver_captures
from tests.processes import children, command_of
from tests.waiting import wait_for


@pytest.fixture(scope="module", autouse=True)
def virtual_camera(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """libgphoto2 looks at this before it is loaded, and the folder must hold a picture to take.

    It is taken back: with it, later tests of the same process would find no network cameras.
    """
    folder = tmp_path_factory.mktemp("vcamera")
    picture = np.random.default_rng(0).integers(0, 255, (480, 640, 3), dtype=np.uint8)
    assert cv2.imwrite(str(folder / "GPH_0001.JPG"), picture)
    with pytest.MonkeyPatch.context() as environment:
        environment.setenv("VCAMERADIR", str(folder))
        yield


@pytest.fixture
def camera() -> Iterator[Gphoto2Camera]:
    camera = open_camera({}, OpenContext(Path()), in_seconds(20))
    yield camera
    camera.close()


class TestGphoto2(CameraConformance):
    sees_fsync = False


def test_the_picture_is_the_camera_s_own(camera: Gphoto2Camera, tmp_path: Path) -> None:
    camera.configure(ExposureSettings(0.02, 100, 5.6, raw=False), deadline=in_seconds(10))
    file = camera.capture(tmp_path / "shot", deadline=in_seconds(10))[0]
    original = next(Path(os.environ["VCAMERADIR"]).glob("*.JPG"))
    assert file.path.read_bytes() == original.read_bytes()
    assert [path.name for path in tmp_path.iterdir()] == ["shot.jpg"]


def test_the_status_tells_battery_and_card(camera: Gphoto2Camera) -> None:
    status = camera.status(deadline=in_seconds(10))
    assert status.battery_percent == 50
    assert (status.free_bytes or 0) > 1 << 28
    assert camera.notices() == []


def test_a_camera_that_could_not_be_opened_leaves_no_process_behind() -> None:
    with pytest.raises(DeviceError) as caught:
        open_camera({"serial": "of another camera"}, OpenContext(Path()), in_seconds(20))
    assert caught.value.code == "camera-other"
    assert not [child for child in children() if "plugins.gphoto2.worker" in command_of(child)]


def test_a_library_that_crashes_ends_its_process_and_the_call_is_done_again(camera: Gphoto2Camera) -> None:
    first = crash(camera)
    assert camera.identity(deadline=in_seconds(20)).model
    assert camera.process.pid not in (None, first)
    assert [notice.code for notice in camera.notices()] == ["camera-library-ended"]


def test_a_crash_during_a_picture_is_reported_and_nothing_is_taken_twice(camera: Gphoto2Camera, tmp_path: Path) -> None:
    crash(camera)
    with pytest.raises(DeviceGone) as caught:
        camera.capture(tmp_path / "shot", deadline=in_seconds(20))
    assert caught.value.code == "camera-shot-lost"
    assert "signal 11" in caught.value.what
    assert list(tmp_path.iterdir()) == []
    assert camera.capture(tmp_path / "shot", deadline=in_seconds(20))


def crash(camera: Gphoto2Camera) -> int:
    pid = camera.process.pid
    assert pid is not None
    os.kill(pid, signal.SIGSEGV)
    wait_for(lambda: "Z" in Path(f"/proc/{pid}/stat").read_text().split(")")[1])
    return pid


def test_a_library_that_hangs_is_ended_by_the_deadline_and_started_again(camera: Gphoto2Camera) -> None:
    pid = camera.process.pid
    assert pid is not None
    os.kill(pid, signal.SIGSTOP)
    began_s = time.monotonic()
    with pytest.raises(DeviceTimeout):
        camera.identity(deadline=in_seconds(0.5))
    assert time.monotonic() - began_s < 5
    assert not Path(f"/proc/{pid}").exists()
    assert camera.identity(deadline=in_seconds(20)).model


@pytest.mark.parametrize("flavour", FLAVOURS)
def test_network_cameras_are_opened_set_and_released(flavour: Flavour, monkeypatch: pytest.MonkeyPatch) -> None:
    """Twenty captures of each, and what the process between costs: tests/campaigns/camera_peers.py."""
    monkeypatch.delenv("VCAMERADIR")  # with it, the library knows the virtual camera's bus only
    driver_captures(flavour, 2)


def test_without_the_wheel_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gphoto2", None)
    with pytest.raises(PluginError) as caught:
        open_camera({}, OpenContext(Path()), in_seconds(5))
    assert caught.value.code == "gphoto2-missing"
    assert "velatura[gphoto2]" in caught.value.remedy


@pytest.mark.parametrize(
    ("choice", "expected"),
    [("1/60", 1 / 60), ("0.0200s", 0.02), ("30", 30.0), ("1.3", 1.3), ("bulb", None), ("1/0", None), ("Auto", None)],
)
def test_shutter_speeds_are_read(choice: str, expected: float | None) -> None:
    assert words.seconds(choice) == pytest.approx(expected) if expected else words.seconds(choice) is None


def test_other_words_are_read() -> None:
    assert (words.f_number("f/5.6"), words.f_number("5.6"), words.f_number("implicit auto")) == (5.6, 5.6, None)
    assert (words.iso("100"), words.iso("ISO 400"), words.iso("Auto")) == (100, 400, None)
    assert (words.percent("50%"), words.percent("Low")) == (50, None)


def test_formats_are_picked_by_what_their_names_say() -> None:
    canon = ["Large Fine JPEG", "Large Normal JPEG", "RAW", "RAW + Large Fine JPEG"]
    nikon = ["JPEG Basic", "JPEG Fine", "NEF (Raw)", "NEF+Basic"]
    assert words.pick_format(canon, raw=True) == "RAW"
    assert words.pick_format(canon, raw=False) == "Large Fine JPEG"
    assert words.pick_format(nikon, raw=True) == "NEF (Raw)"
    assert words.pick_format(["JPEG Fine"], raw=True) is None


def test_the_driver_explains_its_settings() -> None:
    assert (DRIVER.kind, DRIVER.name) == ("camera", "gphoto2")
    assert set(DRIVER.required) <= set(DRIVER.settings)
