"""The driver on libgphoto2: the shared suite on libgphoto2's own virtual camera, and how its words are read."""

from __future__ import annotations

import builtins
import os
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from hal.conformance import CameraConformance
from hal.deadline import in_seconds
from hal.errors import DeviceError, DeviceRefused, PluginError
from hal.registry import OpenContext
from hal.values import CameraCapabilities, ExposureSettings
from plugins.gphoto2 import opened as gphoto2_opened
from plugins.gphoto2 import settings as words
from plugins.gphoto2.camera import DRIVER, Gphoto2Camera, open_camera
from plugins.gphoto2.opened import Opened
from tests.waiting import wait_for


@pytest.fixture(scope="module", autouse=True)
def virtual_camera(tmp_path_factory: pytest.TempPathFactory) -> None:
    """libgphoto2 looks at this before it is loaded, and the folder must hold a picture to take."""
    folder = tmp_path_factory.mktemp("vcamera")
    picture = np.random.default_rng(0).integers(0, 255, (480, 640, 3), dtype=np.uint8)
    assert cv2.imwrite(str(folder / "GPH_0001.JPG"), picture)
    assert "gphoto2" not in sys.modules
    os.environ["VCAMERADIR"] = str(folder)


@pytest.fixture
def camera() -> Iterator[Gphoto2Camera]:
    camera = open_camera({}, OpenContext(Path()), in_seconds(20))
    yield camera
    camera.close()


class TestGphoto2(CameraConformance):
    pass


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
    assert camera.troubles() == []


def test_a_camera_that_could_not_be_opened_leaves_no_thread_behind() -> None:
    before = threading.active_count()
    for _ in range(3):
        with pytest.raises(DeviceError):
            open_camera({"serial": "of another camera"}, OpenContext(Path()), in_seconds(20))
    wait_for(lambda: threading.active_count() <= before)


def test_a_camera_that_fails_once_it_is_open_is_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    closed: list[Opened] = []
    let_go = Gphoto2Camera.let_go

    def note(camera: Gphoto2Camera, opened: Opened) -> None:
        closed.append(opened)
        let_go(camera, opened)

    def refuse(opened: Opened) -> CameraCapabilities:
        raise DeviceRefused("camera-refused", what="It will not say.", remedy="Ask it again.")

    monkeypatch.setattr(Gphoto2Camera, "let_go", note)
    monkeypatch.setattr(gphoto2_opened, "capabilities", refuse)
    with pytest.raises(DeviceRefused):
        open_camera({}, OpenContext(Path()), in_seconds(20))
    wait_for(lambda: len(closed) == 1)


def test_without_the_wheel_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def missing(name: str, *rest: Any) -> Any:
        if name == "gphoto2":
            raise ImportError("No module named 'gphoto2'")
        return real(name, *rest)

    monkeypatch.setattr(builtins, "__import__", missing)
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
