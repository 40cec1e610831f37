"""Drivers on the real kernel's own drivers, in a small machine (``machine``)."""

from __future__ import annotations

import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from controller.optics.capture.linearity import RawExposure, black_offset, check_series
from controller.optics.capture.raw import read_mosaic, read_photograph
from tests.real_kernel.machine import obstacle, run
from tests.real_kernel.uvc_camera import BLACK, FULL, HEIGHT, WIDTH

ROOT = Path(__file__).parents[2]
pytestmark = [pytest.mark.long, pytest.mark.slow]


def on_the_machine(file: str, modules: dict[str, str], out: Path, *more: str, suite: str = "bookworm") -> list[str]:
    """Run a file of tests there; the names of those that passed. All must."""
    assert (why := obstacle()) is None, f"{why}: run `make test`, whose set-up installs it"
    # No plugins and no settings of ours: they take longer to load than the tests take.
    alone = ["-c", "/dev/null", f"--rootdir={ROOT}", "-p", "no:cacheprovider", "--noconftest", "--basetemp=/tmp/pytest"]
    pytest_ = ["PYTEST_DISABLE_PLUGIN_AUTOLOAD=1", sys.executable, "-u", "-m", "pytest", "-v", "--durations=12"]
    words = [*pytest_, *alone, "--junitxml=/tmp/out/junit.xml", f"tests/real_kernel/{file}", *more]
    done = run(words, modules, ROOT, out, suite)
    print(done.said, f"{done.took_s:.1f} s")
    assert done.code == 0, done.said[-6000:]
    cases = ET.parse(out / "shared" / "junit.xml").iter("testcase")
    return [case.get("name", "") for case in cases if len(case) == 0]


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What ``on_video`` kept, after its own tests passed."""
    out = tmp_path_factory.mktemp("video")
    vivid = "n_devs=1 node_types=0x1 num_inputs=1 input_types=0"
    modules = {"vhci_hcd": "", "uvcvideo": "nodrop=1", "videobuf2_vmalloc": "", "vivid": vivid}
    assert len(on_the_machine("on_video.py", modules, out)) > 42
    return out / "shared"


def test_a_mosaic_of_a_usb_camera_goes_through_the_measurement_of_black_level_and_linearity(pictures: Path) -> None:
    files = {tuple(map(float, file.stem.split("-"))): file for file in (pictures / "BA81").iterdir()}
    exposures = {(light, time_s): RawExposure(read_mosaic(file).samples, time_s)
                 for (light, time_s), file in files.items()}  # fmt: skip
    levels = read_mosaic(next(iter(files.values()))).levels
    offset = black_offset([one for (light, _), one in exposures.items() if light == 0], levels)
    np.testing.assert_allclose(offset, BLACK * 255 / FULL, atol=1.0)
    levels.black[:] += offset
    series = check_series([exposures[key] for key in sorted(exposures) if key[0] == 1], levels)
    assert series.worst < 0.05


def test_grey_samples_of_a_usb_camera_are_linear(pictures: Path) -> None:
    means = {tuple(map(float, file.stem.split("-"))): read_photograph(file).image[..., 0].mean() * FULL
             for file in (pictures / "Y16").iterdir()}  # fmt: skip
    dark = [mean for (light, _), mean in means.items() if light == 0]
    np.testing.assert_allclose(dark, BLACK, atol=1.0)
    rates = [(mean - BLACK) / time_s for (light, time_s), mean in means.items() if light == 1]
    np.testing.assert_allclose(rates, 22500, rtol=0.02)


@pytest.mark.parametrize("code", ["RGGB", "GRBG", "GBRG", "BA81", "RG12", "GB10", "BA10", "GR16", "BYR2"])
def test_the_mosaic_of_the_kernels_own_camera_has_its_red_where_the_file_says(pictures: Path, code: str) -> None:
    raw = read_mosaic(pictures / f"red-{code}.dng")
    rows, columns = raw.samples.shape
    cells = raw.samples.reshape(rows // 2, 2, columns // 2, 2).mean(axis=(0, 2))
    full = raw.levels.white.max()
    assert cells[raw.levels.colours == 0].min() > 0.9 * full
    assert cells[raw.levels.colours != 0].max() < 0.1 * full


@pytest.mark.parametrize("code", ["YUYV", "MJPG"])
def test_a_finished_picture_of_a_usb_camera_is_read_by_another_program(pictures: Path, code: str) -> None:
    counts = (2000 + BLACK) * 255 / FULL
    with Image.open(pictures / f"{code}.jpg") as picture:
        assert picture.size == (WIDTH, HEIGHT)
        wanted = counts if code == "MJPG" else (counts - 16) * 255 / 219
        assert np.asarray(picture.convert("RGB")).mean() == pytest.approx(wanted, abs=3)


def test_keys_on_lines_of_the_kernels_own_gpio_chips(tmp_path: Path) -> None:
    modules = {"vhci_hcd": "", "usbhid": "", "hid_cp2112": "", "hid_mcp2221": ""}
    # Linux 6.1 of bookworm takes the direction of an MCP2221's line for its level (kernel bug 216736).
    assert len(on_the_machine("on_gpio.py", modules, tmp_path, suite="trixie")) > 30
