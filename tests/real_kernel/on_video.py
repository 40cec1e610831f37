"""Runs on the machine with the real kernel: the driver ``v4l2`` on the kernel's own drivers.

``vivid`` is the kernel's test camera: it has every format and a known picture, and can be unplugged, but no exposure.
``uvcvideo`` is the driver of USB cameras; the camera on its bus is emulated (``uvc_camera``). What is slow to load is
left out here: ``test_on_kernel`` judges the files.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from controller.core.errors import VelaturaError
from hal.conformance import CameraConformance
from hal.deadline import in_seconds
from hal.errors import DeviceBusy, DeviceError, DeviceGone, DeviceRefused, DeviceTimeout, PluginError
from hal.finding import SearchScope
from hal.registry import OpenContext
from hal.values import ExposureSettings, FileKind
from plugins.finding import video
from plugins.raw_file import Levels, encoded
from plugins.v4l2.camera import VideoCamera, open_camera
from plugins.v4l2.formats import video_format
from plugins.v4l2.kernel import identify_path, paths
from plugins.v4l2.worker import VideoDevice
from tests.real_kernel.usb_ip import Cable
from tests.real_kernel.uvc_camera import BLACK, FULL, HEIGHT, INTERVAL_S, WIDTH, UvcCamera

if TYPE_CHECKING:
    from controller.stage.live import LivePicture, StreamSource

CONTEXT = OpenContext(Path())
OUT = Path("/tmp/out")
"""What is judged outside, by programs that would take long to load here."""
PATIENCE_S = 60.0
"""The machine's processor is emulated."""


def node(driver: str) -> Path:
    """The video device that takes pictures by this driver."""
    ends = in_seconds(PATIENCE_S)
    while True:
        for path in paths():
            found = identify_path(path)
            if found is not None and found.driver == driver:
                return path
        assert not ends.passed, f"no device of {driver}"
        time.sleep(0.1)


def v4l2_ctl(path: Path, *words: str) -> str:
    """Debian's program for video devices."""
    return subprocess.run(["v4l2-ctl", "-d", str(path), *words], check=True, capture_output=True, text=True).stdout


@pytest.fixture(scope="module")
def vivid() -> Path:
    path = node("vivid")
    v4l2_ctl(path, "--set-ctrl", "osd_text_mode=2")
    return path


@pytest.fixture(scope="module")
def webcam() -> UvcCamera:
    return UvcCamera()


@pytest.fixture(scope="module")
def cable(webcam: UvcCamera) -> Iterator[list[Cable]]:
    """The cable that is plugged in now."""
    cables = [Cable(webcam, 0)]
    node("uvcvideo")
    yield cables
    cables[-1].pull()


def opened(**settings: Any) -> VideoCamera:
    return open_camera(settings, CONTEXT, in_seconds(PATIENCE_S))


@pytest.fixture(scope="class")
def camera(cable: list[Cable]) -> Iterator[VideoCamera]:
    camera = opened(address=str(node("uvcvideo")))
    yield camera
    camera.close()


@pytest.fixture(scope="class")
def open_webcam(cable: list[Cable]) -> Iterator[VideoCamera]:
    camera = opened(address=str(node("uvcvideo")), format="Y16", bits=12)
    yield camera
    camera.close()


class TestUsbCamera(CameraConformance):
    """On a camera that is automatic and has a gamma of 2.2 when it is plugged in."""

    sees_fsync = False
    patience_s = PATIENCE_S
    prompt_s = 10.0


def grey(file: Path) -> np.ndarray[Any, Any]:
    """The samples of a TIFF of ours, which come last in it."""
    return np.frombuffer(file.read_bytes()[-2 * WIDTH * HEIGHT :], "<u2") / 65535


class TestGreySamples:
    """A driver has the camera for itself while it is open, so these share one."""

    def test_the_camera_has_the_exposure_that_was_set_and_nothing_automatic(self, open_webcam: VideoCamera) -> None:
        has = open_webcam.configure(ExposureSettings(0.05, 100), deadline=in_seconds(PATIENCE_S))
        assert has.exposure_s == pytest.approx(0.05, rel=0.13)
        told = v4l2_ctl(node("uvcvideo"), "--get-ctrl", "exposure_time_absolute,auto_exposure,gamma")
        values = {name: value.split()[0] for name, value in (line.split(": ") for line in told.splitlines())}
        assert values == {"exposure_time_absolute": f"{1e4 * has.exposure_s:.0f}", "auto_exposure": "1", "gamma": "100"}

    def test_a_picture_never_shows_the_light_of_before(
        self, open_webcam: VideoCamera, webcam: UvcCamera, tmp_path: Path
    ) -> None:
        webcam.scene = np.full((HEIGHT, WIDTH), 20000.0)
        has = open_webcam.configure(ExposureSettings(0.02, 100), deadline=in_seconds(PATIENCE_S))
        seen = []
        for light in (1.0, 4.0, 1.0, 8.0):
            webcam.light = light
            file = open_webcam.capture(tmp_path / "shot", deadline=in_seconds(PATIENCE_S))[0]
            seen.append((grey(file.path).mean() * FULL - BLACK) / (20000 * has.exposure_s))
        webcam.light = 1.0
        np.testing.assert_allclose(seen, [1.0, 4.0, 1.0, 8.0], rtol=0.05)

    def test_frames_that_are_cut_or_faulty_are_passed_over(
        self, open_webcam: VideoCamera, webcam: UvcCamera, tmp_path: Path
    ) -> None:
        webcam.cut, webcam.bad = 3, 2
        file = open_webcam.capture(tmp_path / "shot", deadline=in_seconds(PATIENCE_S))[0]
        assert grey(file.path).min() > 0
        webcam.cut = 10_000
        with pytest.raises(DeviceBusy) as caught:
            open_webcam.capture(tmp_path / "none", deadline=in_seconds(60 * INTERVAL_S))
        webcam.cut = 0
        assert caught.value.code == "camera-frame-cut"

    def test_pulled_in_a_picture_it_is_gone_and_comes_back_with_its_exposure(
        self, cable: list[Cable], open_webcam: VideoCamera, webcam: UvcCamera, tmp_path: Path
    ) -> None:
        has = open_webcam.configure(ExposureSettings(0.05, 100), deadline=in_seconds(PATIENCE_S))
        webcam.cut = 10_000  # so that the picture never ends
        threading.Timer(2.0, cable[-1].pull).start()
        began_s = time.monotonic()
        with pytest.raises(DeviceGone):
            open_webcam.capture(tmp_path / "shot", deadline=in_seconds(PATIENCE_S))
        assert time.monotonic() - began_s < PATIENCE_S / 2
        assert list(tmp_path.iterdir()) == []
        with pytest.raises(DeviceGone):
            open_webcam.identity(deadline=in_seconds(PATIENCE_S))
        webcam.cut = 0
        cable.append(Cable(webcam, 0))
        path = node("uvcvideo")
        assert open_webcam.capture(tmp_path / "shot", deadline=in_seconds(PATIENCE_S))
        told = v4l2_ctl(path, "--get-ctrl", "exposure_time_absolute")
        assert told.strip() == f"exposure_time_absolute: {1e4 * has.exposure_s:.0f}"


@pytest.mark.parametrize(("code", "bits"), [("Y16", 12), ("BA81", 0)])
def test_series_of_exposures_are_kept_for_the_judge(
    cable: list[Cable], webcam: UvcCamera, code: str, bits: int
) -> None:
    webcam.scene = np.random.default_rng(5).uniform(5000, 40000, (HEIGHT, WIDTH))
    camera = opened(address=str(node("uvcvideo")), format=code, bits=bits)
    for light, exposure_s in ((0.0, 0.02), (0.0, 0.08), (1.0, 0.01), (1.0, 0.02), (1.0, 0.04), (1.0, 0.08)):
        webcam.light = light
        has = camera.configure(ExposureSettings(exposure_s, 100), deadline=in_seconds(PATIENCE_S))
        camera.capture(OUT / code / f"{light:g}-{has.exposure_s:g}", deadline=in_seconds(PATIENCE_S))
    webcam.light = 1.0
    camera.close()


@pytest.mark.parametrize("code", ["YUYV", "MJPG"])
def test_a_finished_picture_is_a_jpeg_and_the_camera_has_no_raw(
    cable: list[Cable], webcam: UvcCamera, code: str
) -> None:
    camera = opened(address=str(node("uvcvideo")), format=code)
    assert (camera.capabilities.raw, camera.capabilities.jpeg) == (False, True)
    with pytest.raises(DeviceRefused):
        camera.configure(ExposureSettings(0.1, 100, raw=True), deadline=in_seconds(PATIENCE_S))
    has = camera.configure(ExposureSettings(0.1, 100, raw=False), deadline=in_seconds(PATIENCE_S))
    webcam.scene = np.full((HEIGHT, WIDTH), 2000 / has.exposure_s)
    file = camera.capture(OUT / code, deadline=in_seconds(PATIENCE_S))[0]
    camera.close()
    assert (file.kind, file.path.suffix) == (FileKind.JPEG, ".jpg")


def test_the_finder_names_both_and_how_to_use_them(cable: list[Cable], vivid: Path) -> None:
    found = video.find(SearchScope(Path()), in_seconds(PATIENCE_S))
    tables = {one.driver: one for one in found}
    assert tables.keys() == {"v4l2"}
    assert {one.identity for one in found} >= {"UVC-7"}
    assert all(one.kind == "camera" and not one.problems for one in found)
    settings = next(one.settings for one in found if one.identity == "UVC-7")
    camera = opened(**settings)
    assert camera.identity(deadline=in_seconds(PATIENCE_S)).serial == "UVC-7"
    camera.close()


@pytest.mark.parametrize(("code", "levels"), [("GREY", 255), ("Y10", 1023), ("Y12", 4095), ("Y16", 65535)])
def test_grey_of_the_kernels_own_camera_is_full_where_it_is_white(vivid: Path, code: str, levels: int) -> None:
    v4l2_ctl(vivid, "--set-ctrl", "test_pattern=6")
    data, size_px = frame(vivid, code)
    words = np.frombuffer(data, np.uint8 if levels == 255 else "<u2").reshape(size_px[::-1])
    assert (words.min(), words.max()) == (words.max(), words.max())
    assert 0.9 * levels < words.max() <= levels
    v4l2_ctl(vivid, "--set-ctrl", "test_pattern=5")
    assert np.frombuffer(frame(vivid, code)[0], np.uint8).max() <= 16


@pytest.mark.parametrize("code", ["RGGB", "GRBG", "GBRG", "BA81", "RG12", "GB10", "BA10", "GR16", "BYR2"])
def test_mosaics_of_the_kernels_own_camera_are_kept_for_the_judge(vivid: Path, code: str) -> None:
    v4l2_ctl(vivid, "--set-ctrl", "test_pattern=7")
    data, size_px = frame(vivid, code)
    video_ = video_format(code)
    assert video_ is not None
    assert video_.samples is not None
    file = encoded(data, size_px, video_.samples, maker="", model="vivid", levels=Levels(0, ()))
    (OUT / f"red-{code}.dng").write_bytes(file)


def frame(path: Path, code: str) -> tuple[bytes, tuple[int, int]]:
    """A frame of a camera without exposure, by the device's own class."""
    found = video_format(code.ljust(4))
    assert found is not None
    device = VideoDevice(path)
    try:
        device.set_format(found, (320, 180))
        return device.frame(1, PATIENCE_S), device.size_px
    finally:
        device.close()


def test_the_same_frame_comes_to_debians_program(vivid: Path, tmp_path: Path) -> None:
    v4l2_ctl(vivid, "--set-ctrl", "test_pattern=1")
    ours, _ = frame(vivid, "YUYV")
    theirs = tmp_path / "theirs"
    words = ("--set-fmt-video", "width=320,height=180,pixelformat=YUYV", "--stream-mmap", "--stream-count=1")
    v4l2_ctl(vivid, *words, f"--stream-to={theirs}")
    assert theirs.read_bytes() == ours


def test_a_camera_without_exposure_says_so(vivid: Path) -> None:
    with pytest.raises(PluginError) as caught:
        opened(address=str(vivid))
    assert caught.value.code == "camera-no-exposure"


def test_a_camera_that_another_program_uses_is_named(vivid: Path) -> None:
    other = subprocess.Popen(["v4l2-ctl", "-d", str(vivid), "--stream-mmap"], stdout=subprocess.DEVNULL,
                             stderr=subprocess.PIPE)  # fmt: skip
    try:
        assert other.stderr is not None
        os.read(other.stderr.fileno(), 1)  # it tells its frames
        with pytest.raises(DeviceRefused) as caught:
            frame(vivid, "GREY")
    finally:
        other.kill()
        other.communicate()
    assert caught.value.code == "camera-taken"


def test_the_kernels_own_camera_is_a_live_stream_with_its_colours(vivid: Path) -> None:
    with contextlib.closing(live(vivid)) as source:
        for pattern, colour in ((7, (255, 0, 0)), (6, (255, 255, 255)), (8, (0, 255, 0))):
            v4l2_ctl(vivid, "--set-ctrl", f"test_pattern={pattern}")
            shows(source, partial(is_even, colour))
        first = shows(source, lambda _: True)
        later = shows(source, lambda _: True)
        assert later.number > first.number


def test_a_live_camera_that_is_pulled_is_lost_once_and_comes_back(cable: list[Cable], webcam: UvcCamera) -> None:
    webcam.light = 1.0
    path = node("uvcvideo")
    with contextlib.closing(live(path)) as source:
        shows(source, lambda picture: picture.shape == (HEIGHT, WIDTH, 3))
        cable[-1].pull()
        told = []
        for _ in range(30):
            try:
                source.next(0.0)
            except VelaturaError as error:
                told.append(error.code)
            time.sleep(0.1)
        assert told == ["live-source-gone"]
        cable.append(Cable(webcam, 0))
        assert node("uvcvideo") == path
        shows(source, lambda picture: picture.shape == (HEIGHT, WIDTH, 3))


def is_even(colour: tuple[int, int, int], picture: Any) -> bool:
    return bool(np.abs(picture.mean(axis=(0, 1)) - colour).max() < 12)


def live(path: Path) -> StreamSource:
    """The device as a live target, with its first picture."""
    from controller.stage.live import open_stream

    source = open_stream(str(path), silent_s=20.0, retry_s=0.2)
    source.wait_for_picture(PATIENCE_S)
    return source


def shows(source: StreamSource, so: Callable[[Any], Any]) -> LivePicture:
    """The next picture of which something is true."""
    ends = in_seconds(PATIENCE_S)
    while True:
        with contextlib.suppress(VelaturaError):
            found = source.next(0.0)
            if found is not None and so(found.pixels):
                return found
        assert not ends.passed, found
        time.sleep(0.05)


def test_a_device_that_is_unplugged_by_its_driver_is_gone(vivid: Path) -> None:
    device = VideoDevice(vivid)
    found = video_format("GREY")
    assert found is not None
    device.set_format(found, (320, 180))
    v4l2_ctl(vivid, "--set-ctrl", "disconnect=1")
    with pytest.raises(DeviceGone):
        device.frame(1, PATIENCE_S)
    device.close()


def test_a_device_that_is_not_there_is_gone() -> None:
    with pytest.raises(DeviceError) as caught:
        opened(address="/dev/video99")
    assert isinstance(caught.value, DeviceGone | DeviceTimeout)
