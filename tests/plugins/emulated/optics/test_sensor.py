"""The emulated camera's files: right numbers of photons, and what other programs read from them."""

from __future__ import annotations

import dataclasses
import io
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest
import rawpy
import tifffile

from plugins.emulated.core.truth import Sensor
from plugins.emulated.optics.dng import PictureFacts, dng, with_exif
from plugins.emulated.optics.sensor import jpeg, mosaic, tone_curve

SENSOR = Sensor(
    electrons_per_light_s=150_000.0,
    electrons_per_step=9.0,
    full_well_e=44_000.0,
    read_noise_e=9.0,
    black_level=128,
    white_level=4095,
)
FACTS = PictureFacts(1 / 60, 200, 5.6, 48.0, "2024:05:06 07:08:09", "VE0000001")


def shot(level: float, *, exposure_s: float = 0.1, iso: int = 100, aperture_f: float = 8.0) -> npt.NDArray[np.uint16]:
    light = np.full((200, 300, 3), level, np.float32)
    return mosaic(light, SENSOR, np.random.default_rng(4), exposure_s=exposure_s, iso=iso, aperture_f=aperture_f)


def test_a_factor_of_the_noise_is_on_all_of_it_in_the_dark_as_in_the_light() -> None:
    noisy = dataclasses.replace(SENSOR, noise=4.0)
    for level in (0.0, 0.5):
        light = np.full((200, 300, 3), level, np.float32)
        plain, more = (
            float(mosaic(light, one, np.random.default_rng(4), exposure_s=0.1, iso=1600, aperture_f=8.0).std())
            for one in (dataclasses.replace(SENSOR, full_well_e=1e7, white_level=4095, electrons_per_step=90.0),
                        dataclasses.replace(noisy, full_well_e=1e7, white_level=4095, electrons_per_step=90.0))
        )  # fmt: skip
        assert more == pytest.approx(4 * plain, rel=0.03)


@pytest.mark.parametrize("level", [0.0, 0.05, 0.5, 2.0])
def test_noise_is_shot_noise_and_read_noise(level: float) -> None:
    raw = shot(level).astype(np.float64)
    electrons = level * 15_000.0
    assert raw.mean() == pytest.approx(128 + electrons / 9.0, abs=0.2)
    rounding = 1 / 12
    assert raw.var() == pytest.approx((electrons + 81.0) / 81.0 + rounding, rel=0.03)


def test_exposure_speed_and_aperture_count_as_they_do_in_photography() -> None:
    def signal(raw: npt.NDArray[np.uint16]) -> float:
        return float(raw.mean()) - 128.0

    base = signal(shot(0.2))
    assert signal(shot(0.2, exposure_s=0.2)) == pytest.approx(2 * base, rel=0.01)
    assert signal(shot(0.2, iso=400)) == pytest.approx(4 * base, rel=0.01)
    assert signal(shot(0.2, aperture_f=4.0)) == pytest.approx(4 * base, rel=0.01)


def test_too_much_light_saturates_at_the_white_level_and_never_wraps() -> None:
    assert shot(100.0).min() == 4095
    assert shot(100.0, iso=1600).min() == 4095


def test_every_shot_has_noise_of_its_own() -> None:
    rng = np.random.default_rng(0)
    light = np.full((8, 8, 3), 0.3, np.float32)
    first, second = (mosaic(light, SENSOR, rng, exposure_s=0.1, iso=100, aperture_f=8.0) for _ in range(2))
    assert (first != second).any()


def test_a_raw_converter_reads_the_very_mosaic_and_its_meaning(tmp_path: Path) -> None:
    raw = np.random.default_rng(1).integers(0, 4096, (52, 78), dtype=np.uint16)
    path = tmp_path / "shot.dng"
    path.write_bytes(dng(raw, black_level=128, white_level=4095, facts=FACTS))
    with rawpy.imread(str(path)) as picture:
        np.testing.assert_array_equal(picture.raw_image_visible, raw)
        assert list(picture.black_level_per_channel) == [128] * 4
        assert picture.white_level == 4095
        letters = picture.color_desc.decode()
        assert [[letters[i] for i in row] for row in np.asarray(picture.raw_pattern)] == [["R", "G"], ["G", "B"]]
        # The camera's own colours are linear sRGB, so the way from there to sRGB is to leave them alone.
        np.testing.assert_allclose(picture.color_matrix[:, :3], np.eye(3), atol=1e-4)
        assert list(picture.camera_whitebalance[:3]) == [1.0, 1.0, 1.0]


def test_a_tiff_reader_finds_exposure_speed_aperture_and_lens() -> None:
    data = dng(np.zeros((4, 6), np.uint16), black_level=128, white_level=4095, facts=FACTS)
    with tifffile.TiffFile(io.BytesIO(data)) as file:
        page = file.pages.first
        exif = page.tags["ExifTag"].value
        matrix = np.reshape(page.tags["ColorMatrix1"].value, (9, 2))
    assert exif["ExposureTime"] == (1, 60)
    assert exif["FNumber"] == (28, 5)
    assert exif["ISOSpeedRatings"] == 200
    assert exif["FocalLength"] == (48, 1)
    xyz_of_white = np.array([0.95047, 1.0, 1.08883])
    np.testing.assert_allclose((matrix[:, 0] / matrix[:, 1]).reshape(3, 3) @ xyz_of_white, 1.0, atol=1e-3)


def test_a_jpeg_shows_the_colours_where_they_are_and_follows_the_tone_curve() -> None:
    light = np.zeros((64, 96, 3), np.float32)
    light[:, :32, 0] = light[:, 32:64, 1] = light[:, 64:, 2] = 1.5
    raw = mosaic(light, SENSOR, np.random.default_rng(2), exposure_s=0.1, iso=100, aperture_f=8.0)
    picture = cv2.imdecode(np.frombuffer(with_exif(jpeg(raw, SENSOR), FACTS), np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None
    wanted = int(tone_curve(SENSOR)[128 + round(1.5 * 15_000 / 9)])
    for band, channel in enumerate((2, 1, 0)):
        middle = picture[16:48, 32 * band + 8 : 32 * band + 24].reshape(-1, 3).mean(axis=0)
        assert middle.argmax() == channel
        assert middle[channel] == pytest.approx(wanted, abs=6)
    assert (np.diff(tone_curve(SENSOR).astype(int)) >= 0).all()


def test_a_jpeg_tells_how_it_was_taken() -> None:
    from PIL import Image

    data = with_exif(jpeg(np.full((16, 16), 900, np.uint16), SENSOR), FACTS)
    exif = Image.open(io.BytesIO(data)).getexif().get_ifd(34665)
    assert float(exif[33434]) == pytest.approx(1 / 60)
    assert exif[34855] == 200
