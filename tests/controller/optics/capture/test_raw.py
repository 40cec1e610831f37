from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pytest
import scipy.ndimage

from controller.core.arrays import Float64
from controller.core.errors import UsageError, WorkError
from controller.optics.capture.raw import develop, read_photograph

tifffile = pytest.importorskip("tifffile")

BLACK, WHITE = 256, 4095
RGGB = np.array([[0, 1], [1, 2]])
LINEAR = np.tile(np.linspace(0, 1, 256), (3, 1))


def mosaic_of(image: Float64, colours: npt.NDArray[np.int64]) -> npt.NDArray[np.uint16]:
    rows, columns, _ = image.shape
    site = np.tile(colours, (rows // 2, columns // 2))
    value = np.take_along_axis(image, site[:, :, None], axis=2)[:, :, 0]
    return np.clip(np.round(BLACK + value * (WHITE - BLACK)), 0, 65535).astype(np.uint16)


def developed(mosaic: npt.NDArray[np.uint16], colours: npt.NDArray[np.int64] = RGGB) -> npt.NDArray[np.float32]:
    return develop(mosaic, colours, np.full((2, 2), float(BLACK)), np.full((2, 2), float(WHITE))).image


def write_dng(
    path: Path, mosaic: npt.NDArray[np.uint16], pattern: bytes = bytes([0, 1, 1, 2]), more: Sequence[Any] = ()
) -> None:
    """The smallest DNG that LibRaw takes (DNG specification 1.4)."""
    matrix = [(int(v * 10000), 10000) for v in (0.8, -0.2, -0.1, -0.4, 1.2, 0.2, -0.1, 0.2, 0.6)]
    tags = [
        (33421, "H", 2, (2, 2), True),
        (33422, "B", 4, pattern, True),
        (50706, "B", 4, bytes([1, 4, 0, 0]), True),
        (50708, "s", 0, "Test Camera", True),
        (50714, "H", 1, BLACK, True),
        (50717, "H", 1, WHITE, True),
        (50721, "2i", 9, tuple(n for pair in matrix for n in pair), True),
        (50778, "H", 1, 21, True),
        *more,
    ]
    tifffile.imwrite(path, mosaic, photometric=32803, extratags=tags, metadata=None)


@pytest.fixture
def scene() -> Float64:
    noise = np.random.default_rng(2).random((64, 96, 3))
    return np.asarray(0.1 + 0.6 * scipy.ndimage.gaussian_filter(noise, (6, 6, 0)) / 0.6)


@pytest.mark.parametrize("colours", [RGGB, RGGB[::-1, ::-1], RGGB[::-1], RGGB[:, ::-1]])
def test_every_bayer_order_gives_back_a_smooth_scene(scene: Float64, colours: npt.NDArray[np.int64]) -> None:
    assert np.max(np.abs(developed(mosaic_of(scene, colours), np.ascontiguousarray(colours)) - scene)) < 0.01


def test_demosaicing_equals_convolution_with_the_bilinear_kernels(scene: Float64) -> None:
    mosaic = mosaic_of(scene + np.random.default_rng(3).normal(0, 0.1, scene.shape), RGGB)
    value = (mosaic.astype(np.float64) - BLACK) / (WHITE - BLACK)
    site = np.tile(RGGB, (32, 48))
    cross = np.array([[0, 1, 0], [1, 4, 1], [0, 1, 0]]) / 4
    full = np.array([[1, 2, 1], [2, 4, 2], [1, 2, 1]]) / 4
    expected = np.stack(
        [scipy.ndimage.convolve(value * (site == c), cross if c == 1 else full) for c in range(3)], axis=-1
    )
    np.testing.assert_allclose(developed(mosaic)[1:-1, 1:-1], expected[1:-1, 1:-1], atol=1e-6)


def test_development_is_linear_and_noise_below_black_stays_negative(scene: Float64) -> None:
    one, other = mosaic_of(0.3 * scene, RGGB), mosaic_of(0.4 * scene[::-1], RGGB)
    together = (one.astype(int) + other - BLACK).astype(np.uint16)
    np.testing.assert_allclose(developed(together), developed(one) + developed(other), atol=1e-6)
    dark = np.full((8, 8), BLACK - 20, np.uint16)
    np.testing.assert_allclose(developed(dark), -20 / (WHITE - BLACK), rtol=1e-5)


def test_a_clipped_sample_marks_every_pixel_made_of_it(scene: Float64) -> None:
    mosaic = mosaic_of(0.5 * scene, RGGB)
    mosaic[20, 31] = WHITE
    photograph = develop(mosaic, RGGB, np.full((2, 2), float(BLACK)), np.full((2, 2), float(WHITE)))
    assert photograph.saturated[19:22, 30:33].all()
    assert np.count_nonzero(photograph.saturated) == 9
    assert np.isnan(photograph.measured()[20, 31]).all()


def test_a_dng_file_is_read_as_linear_light_with_its_colour_matrix(scene: Float64, tmp_path: Path) -> None:
    write_dng(tmp_path / "shot.dng", mosaic_of(scene, RGGB))
    photograph = read_photograph(tmp_path / "shot.dng")
    assert photograph.image.shape == scene.shape
    assert np.max(np.abs(photograph.image - scene)) < 0.01
    assert not photograph.saturated.any()
    assert photograph.camera_to_xyz is not None
    xyz_to_camera = np.array([[0.8, -0.2, -0.1], [-0.4, 1.2, 0.2], [-0.1, 0.2, 0.6]])
    np.testing.assert_allclose(photograph.camera_to_xyz @ xyz_to_camera, np.eye(3), atol=1e-3)


@pytest.mark.parametrize("content", [b"", b"II*\0 not a picture", None])
def test_a_damaged_or_missing_file_is_explained(content: bytes | None, tmp_path: Path) -> None:
    for name in ("shot.dng", "shot.jpg"):
        if content is not None:
            (tmp_path / name).write_bytes(content)
        with pytest.raises(WorkError) as caught:
            read_photograph(tmp_path / name, response=LINEAR)
        assert caught.value.code == "photograph-unreadable"


def test_the_reason_for_a_refusal_is_in_words(scene: Float64, tmp_path: Path) -> None:
    write_dng(tmp_path / "cut.dng", mosaic_of(scene, RGGB))
    whole = (tmp_path / "cut.dng").read_bytes()
    (tmp_path / "cut.dng").write_bytes(whole[: len(whole) * 6 // 10])
    (tmp_path / "phone.heic").write_bytes(b"\0\0\0\x18ftypheic\0\0\0\0mif1heic" + bytes(2000))
    for name, reason in (("cut.dng", r"\(Input/output error\)"), ("phone.heic", "HEIC.*not read")):
        with pytest.raises(WorkError, match=reason) as refused:
            read_photograph(tmp_path / name)
        assert "b'" not in str(refused.value)
    assert "JPEG" in refused.value.remedy


@pytest.mark.parametrize("axes", ["rows", "columns", "both"])
def test_a_black_level_by_row_and_column_is_taken_off(scene: Float64, tmp_path: Path, axes: str) -> None:
    down = np.where(np.arange(64) % 3, 40, -40) * (axes != "columns")
    across = np.linspace(-30, 30, 96).astype(int) * (axes != "rows")
    mosaic = mosaic_of(scene, RGGB)
    pairs = {code: [int(n) for step in steps for n in (step, 1)] for code, steps in ((50716, down), (50715, across))}
    more = [(code, "2i", len(values) // 2, tuple(values), True) for code, values in pairs.items() if any(values[::2])]
    write_dng(tmp_path / "plain.dng", mosaic)
    write_dng(tmp_path / "steps.dng", (mosaic + down[:, None] + across).astype(np.uint16), more=more)
    plain, stepped = (read_photograph(tmp_path / name).image for name in ("plain.dng", "steps.dng"))
    # The standard's full scale is the white level less the highest black.
    full = (WHITE - BLACK - (down[:, None] + across).max()) / (WHITE - BLACK)
    assert np.abs(plain - full * stepped).max() < 5e-4


def test_a_sensor_without_colours_is_refused(scene: Float64, tmp_path: Path) -> None:
    tags = [(50706, "B", 4, bytes([1, 4, 0, 0]), True), (50708, "s", 0, "Test Camera", True)]
    values = mosaic_of(scene, RGGB)
    tifffile.imwrite(tmp_path / "mono.dng", values, photometric="minisblack", extratags=tags, metadata=None)
    with tifffile.TiffFile(tmp_path / "mono.dng", mode="r+b") as file:
        file.pages[0].tags[262].overwrite(34892)
    with pytest.raises(UsageError) as refused:
        read_photograph(tmp_path / "mono.dng")
    assert refused.value.code == "raw-not-bayer"


def test_a_jpeg_is_read_through_its_response_and_refused_without(tmp_path: Path) -> None:
    grey = np.full((32, 32, 3), 128, np.uint8)
    grey[:8] = 255
    cv2.imwrite(str(tmp_path / "shot.jpg"), grey, [cv2.IMWRITE_JPEG_QUALITY, 100])
    response = np.stack([(np.arange(256) / 255) ** gamma for gamma in (2.0, 2.2, 2.4)])
    photograph = read_photograph(tmp_path / "shot.jpg", response=response)
    np.testing.assert_allclose(photograph.image[20, 20], response[:, 128], atol=0.01)
    assert photograph.saturated[2].all()
    assert not photograph.saturated[20].any()
    with pytest.raises(UsageError) as caught:
        read_photograph(tmp_path / "shot.jpg")
    assert caught.value.code == "jpeg-response-missing"
