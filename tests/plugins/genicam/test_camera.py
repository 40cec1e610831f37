"""The driver on Aravis: the shared suite on Aravis' own fake camera, and its files in our development of RAW."""

from __future__ import annotations

import itertools
import os
import shutil
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from controller.optics.capture.linearity import RawExposure, black_offset, check_series
from controller.optics.capture.raw import read_mosaic, read_photograph
from hal.conformance import CameraConformance
from hal.deadline import in_seconds
from hal.errors import DeviceError, DeviceGone, DeviceRefused, PluginError
from hal.registry import OpenContext, check_device
from hal.values import ExposureSettings
from plugins.genicam.camera import DRIVER, GenicamCamera, open_camera
from plugins.raw_file import Levels, best_format, encoded, pixel_format

pytestmark = pytest.mark.slow
ADDRESS = "127.0.0.1"
SERIAL = "GV42"


@pytest.fixture(scope="module", autouse=True)
def fake() -> Iterator[None]:
    """Aravis' fake GigE Vision camera: another program on loopback. It has one port, so one at a time."""
    program = shutil.which("arv-fake-gv-camera-0.8")
    assert program, "aravis-tools is not installed: run `make test`, whose set-up installs it"
    with subprocess.Popen([program, "-i", ADDRESS, "-s", SERIAL], stdout=subprocess.DEVNULL) as process:
        try:
            ends = in_seconds(20)
            while not _opens():
                assert not ends.passed, "the fake camera does not answer"
            yield
        finally:
            process.terminate()


def _opens() -> bool:
    try:
        open_camera({"address": ADDRESS}, OpenContext(Path()), in_seconds(5)).close()
    except DeviceError:
        return False
    return True


@pytest.fixture
def camera() -> Iterator[GenicamCamera]:
    camera = open_camera({"address": ADDRESS, "format": "BayerRG8"}, OpenContext(Path()), in_seconds(20))
    yield camera
    camera.close()


class TestGenicam(CameraConformance):
    sees_fsync = False


def test_a_mosaic_is_a_dng_that_libraw_reads_with_its_levels_and_matrix(tmp_path: Path) -> None:
    matrix = [0.9, 0.1, 0.0, 0.1, 0.8, 0.1, 0.0, 0.1, 0.7]
    settings = {"address": ADDRESS, "format": "BayerGR8", "black_level": 3, "color_matrix": matrix}
    camera = open_camera(settings, OpenContext(Path()), in_seconds(20))
    camera.configure(ExposureSettings(0.02, 100), deadline=in_seconds(20))
    file = camera.capture(tmp_path / "shot", deadline=in_seconds(20))[0]
    camera.close()
    raw = read_mosaic(file.path)
    assert raw.samples.shape == (512, 512)
    np.testing.assert_array_equal(raw.levels.colours, [[1, 0], [2, 1]])
    assert (raw.levels.black == 3).all()
    assert (raw.levels.white == 255).all()
    assert raw.camera_to_xyz is not None
    found = np.linalg.inv(raw.camera_to_xyz)
    wanted = np.array(matrix).reshape(3, 3)
    np.testing.assert_allclose(found / found.sum(), wanted / wanted.sum(), atol=2e-3)


def test_a_grey_sensor_gives_a_tiff_of_16_bits(tmp_path: Path) -> None:
    camera = open_camera({"address": ADDRESS, "format": "Mono8"}, OpenContext(Path()), in_seconds(20))
    file = camera.capture(tmp_path / "shot", deadline=in_seconds(20))[0]
    camera.close()
    assert file.path.suffix == ".tif"
    image = read_photograph(file.path).image
    assert image.shape == (512, 512, 3)
    assert image.max() > 0
    np.testing.assert_array_equal(image[..., 0], image[..., 2])


def test_its_files_go_through_the_measurement_of_black_level_and_linearity(tmp_path: Path) -> None:
    """A linear sensor of 12 bits with a black level that its file does not state."""
    pixels = pixel_format("BayerRG12")
    assert pixels is not None
    random = np.random.default_rng(5)
    scene = random.uniform(200, 3000, (64, 64))

    def exposed(exposure_s: float, light: float = 1.0) -> RawExposure:
        signal_ = random.poisson(np.minimum(light * scene * exposure_s, 60_000)) + 64
        mosaic = np.minimum(signal_, 4095).astype("<u2")
        path = tmp_path / f"{exposure_s}-{light}.dng"
        path.write_bytes(encoded(mosaic.tobytes(), (64, 64), pixels, maker="", model="Test", levels=Levels(0, ())))
        return RawExposure(read_mosaic(path).samples, exposure_s)

    dark = [exposed(time_s, 0.0) for time_s in (0.1, 0.4)]
    levels = read_mosaic(next(tmp_path.glob("*.dng"))).levels
    offset = black_offset(dark, levels)
    np.testing.assert_allclose(offset, 64, atol=1.0)
    levels.black[:] += offset
    series = check_series([exposed(time_s) for time_s in (0.125, 0.25, 0.5, 1.0)], levels)
    assert series.worst < 0.02


def test_a_crash_of_the_library_costs_the_picture_and_not_the_controller(camera: GenicamCamera, tmp_path: Path) -> None:
    assert camera.process.pid is not None
    os.kill(camera.process.pid, signal.SIGSEGV)
    with pytest.raises(DeviceGone) as caught:
        camera.capture(tmp_path / "shot", deadline=in_seconds(20))
    assert caught.value.code == "camera-shot-lost"
    assert camera.capture(tmp_path / "shot", deadline=in_seconds(20))


def test_a_crash_between_two_pictures_does_not_change_the_exposure(camera: GenicamCamera, tmp_path: Path) -> None:
    """Also where the camera itself has another one by then, as after its power was off."""

    def brightness(camera: GenicamCamera) -> float:
        (file,) = camera.capture(tmp_path / "shot", deadline=in_seconds(20))
        return float(read_mosaic(file.path).samples.mean())

    camera.configure(ExposureSettings(0.002, 100), deadline=in_seconds(20))
    short = brightness(camera)
    assert camera.process.pid is not None
    os.kill(camera.process.pid, signal.SIGSEGV)
    other = open_camera({"address": ADDRESS, "format": "BayerRG8"}, OpenContext(Path()), in_seconds(20))
    other.configure(ExposureSettings(0.02, 100), deadline=in_seconds(20))
    long = brightness(other)
    other.close()
    assert camera.identity(deadline=in_seconds(20)).model
    assert camera.notices()
    assert brightness(camera) == pytest.approx(short, rel=0.02)
    assert long > 1.2 * short


def test_another_serial_number_and_a_format_it_lacks_are_named() -> None:
    with pytest.raises(DeviceRefused) as other:
        open_camera({"address": ADDRESS, "serial": "7"}, OpenContext(Path()), in_seconds(20))
    assert other.value.code == "camera-other"
    with pytest.raises(PluginError, match="BayerRG8"):
        open_camera({"address": ADDRESS, "format": "BayerRG10"}, OpenContext(Path()), in_seconds(20))


@pytest.mark.parametrize(
    "wrong", [{"format": "BayerRG12Packed"}, {"black_level": -1}, {"color_matrix": [1, 2]}, {"color_matrix": ["a"] * 9}]
)
def test_wrong_settings_are_refused_before_the_camera_is_used(wrong: dict[str, object]) -> None:
    with pytest.raises(PluginError):
        check_device(DRIVER, wrong, OpenContext(Path()))


def test_the_best_format_is_the_deepest_mosaic_without_packing() -> None:
    names = ["Mono8", "Mono16", "RGB8", "BayerRG8", "BayerRG12Packed", "BayerRG12"]
    picked = [getattr(best_format(names[: count + 1]), "name", None) for count in range(len(names))]
    assert picked == ["Mono8", "Mono16", "RGB8", "BayerRG8", "BayerRG8", "BayerRG12"]
    assert best_format(["BayerRG12p", "YUV422_8"]) is None


def test_too_few_bytes_are_refused_for_every_format() -> None:
    for colour, bits in itertools.product(("Mono", "BayerBG"), (8, 12)):
        pixels = pixel_format(f"{colour}{bits}")
        assert pixels is not None
        with pytest.raises(DeviceRefused):
            encoded(bytes(15), (4, 4), pixels, maker="", model="", levels=Levels(0, ()))
