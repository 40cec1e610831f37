"""Colour spaces of target files, judged by Little CMS (in Pillow) and OpenColorIO (in OpenImageIO)."""

from __future__ import annotations

import io
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import OpenEXR
import OpenImageIO
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image, ImageCms

from controller.core.arrays import FloatImage
from controller.core.colour import SPACES, ColourSpace, Unsuitable, linear_light, linear_to_srgb
from controller.core.errors import UsageError
from controller.optics.solve.targets.files import load_target, read_picture
from controller.stage.live import FolderSource
from tests.controller.optics.solve.targets import icc_files

SIZE = (24, 16)
PROFILES = {
    "display p3": icc_files.icc_profile(icc_files.P3_D50, icc_files.SRGB_CURVE),
    "adobe": icc_files.icc_profile(icc_files.ADOBE_D50, icc_files.ADOBE_CURVE),
    "table": icc_files.icc_profile(icc_files.P3_D50, icc_files.TABLE_CURVE),
    "line below": icc_files.icc_profile(icc_files.ADOBE_D50, icc_files.POWER_WITH_LINE),
    "constant below": icc_files.icc_profile(icc_files.P3_D50, icc_files.CONSTANT_BELOW),
    "identity": icc_files.icc_profile(icc_files.P3_D50, icc_files.IDENTITY),
    "srgb of little cms": ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes(),
}
OCIO: dict[ColourSpace, str] = {
    "display-p3": "Linear P3-D65", "rec2020": "Linear Rec.2020", "acescg": "ACEScg", "aces2065-1": "ACES2065-1",
}  # fmt: skip


def patches(seed: int = 1) -> npt.NDArray[np.uint8]:
    return np.random.default_rng(seed).integers(40, 216, (SIZE[1], SIZE[0], 3), dtype=np.uint8)


def by_ocio(light: FloatImage, space: str) -> FloatImage:
    source = OpenImageIO.ImageBuf(np.ascontiguousarray(light))
    made = OpenImageIO.ImageBufAlgo.colorconvert(source, space, "Linear Rec.709 (sRGB)", colorconfig="ocio://default")
    assert not made.has_error, made.geterror()
    return np.asarray(made.get_pixels(OpenImageIO.FLOAT), np.float32)


def write_exr(path: Path, image: FloatImage, chromaticities: tuple[float, ...] | None = None) -> None:
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    if chromaticities is not None:
        header["chromaticities"] = chromaticities
    with OpenEXR.File(header, {"RGB": image}) as file:
        file.write(str(path))


@pytest.mark.parametrize("kind", ["PNG", "JPEG"])
@pytest.mark.parametrize("name", PROFILES)
def test_little_cms_makes_the_same_srgb_of_an_embedded_profile(tmp_path: Path, name: str, kind: str) -> None:
    path = tmp_path / f"t.{kind.lower()}"
    Image.fromarray(patches()).save(
        path, kind, icc_profile=PROFILES[name], **({"quality": 100} if kind == "JPEG" else {})
    )
    with Image.open(path) as opened:
        embedded = ImageCms.ImageCmsProfile(io.BytesIO(opened.info["icc_profile"]))
        converted = ImageCms.profileToProfile(
            opened, embedded, ImageCms.createProfile("sRGB"), ImageCms.Intent.RELATIVE_COLORIMETRIC
        )
    assert converted is not None
    theirs = np.asarray(converted, np.float64)
    ours = 255 * linear_to_srgb(read_picture(path)).astype(np.float64)
    # both clip colours outside sRGB; Little CMS rounds to whole numbers, and its decoder differs by one
    assert np.abs(ours - theirs).max() < (1.5 if kind == "PNG" else 4)
    assert np.abs(ours - theirs).mean() < (0.4 if kind == "PNG" else 0.8)


def test_sixteen_bits_keep_their_precision_under_a_profile(tmp_path: Path) -> None:
    fine = (patches().astype(np.uint16) << 8) + np.arange(3, dtype=np.uint16) * 80
    png = cv2.imencode(".png", fine[..., ::-1])[1].tobytes()
    (tmp_path / "t.png").write_bytes(icc_files.with_profile(png, PROFILES["display p3"]))
    encoded = np.where(fine / 65535 <= 0.04045, fine / 65535 / 12.92, ((fine / 65535 + 0.055) / 1.055) ** 2.4)
    theirs = by_ocio(encoded.astype(np.float32), "Linear P3-D65")
    # a profile's numbers have five digits
    np.testing.assert_allclose(read_picture(tmp_path / "t.png"), theirs, atol=2e-4)


@pytest.mark.parametrize("space", OCIO)
@pytest.mark.parametrize("said", ["by the stage", "by the file"])
def test_opencolorio_makes_the_same_light_of_an_exr(tmp_path: Path, space: ColourSpace, said: str) -> None:
    light = np.random.default_rng(3).random((SIZE[1], SIZE[0], 3), np.float32) * 2
    own = SPACES[space]
    chromaticities = (*own.red, *own.green, *own.blue, *own.white) if said == "by the file" else None
    write_exr(tmp_path / "t.exr", light, chromaticities)
    found = read_picture(tmp_path / "t.exr", None if said == "by the file" else space)
    np.testing.assert_allclose(found, by_ocio(light, OCIO[space]), atol=2e-4)
    assert (load_target(tmp_path / "t.exr", SIZE, space).image >= 0).all()


def test_a_named_space_of_whole_numbers_has_its_curve(tmp_path: Path) -> None:
    Image.fromarray(patches()).save(tmp_path / "t.png", icc_profile=PROFILES["adobe"])
    unit = np.asarray(patches() / 255, np.float32)
    p3 = by_ocio(unit, "sRGB Encoded P3-D65")
    np.testing.assert_allclose(read_picture(tmp_path / "t.png", "display-p3"), p3, atol=2e-4)
    wide = by_ocio(np.asarray(unit**2.4, np.float32), "Linear Rec.2020")
    np.testing.assert_allclose(read_picture(tmp_path / "t.png", "rec2020"), wide, atol=2e-4)


def test_a_picture_without_colours_has_the_curve_of_its_profile(tmp_path: Path) -> None:
    grey = icc_files.icc_profile(icc_files.P3_D50, icc_files.ADOBE_CURVE, kind=b"GRAY").replace(b"rTRC", b"kTRC")
    Image.fromarray(patches()[..., 0]).save(tmp_path / "t.png", icc_profile=grey)
    expected = (patches()[..., :1] / 255) ** (round(2.19921875 * 256) / 256)
    np.testing.assert_allclose(read_picture(tmp_path / "t.png"), np.repeat(expected, 3, axis=2), atol=1e-4)


def test_pictures_of_ink_and_moving_ones_are_refused_with_the_reason(tmp_path: Path) -> None:
    Image.fromarray(patches()).convert("CMYK").save(tmp_path / "ink.jpg")
    frames = [Image.fromarray(patches(seed)) for seed in (1, 2)]
    frames[0].save(tmp_path / "moves.png", save_all=True, append_images=frames[1:])
    frames[0].save(tmp_path / "moves.gif", save_all=True, append_images=frames[1:])
    table = icc_files.icc_profile(icc_files.P3_D50, icc_files.ADOBE_CURVE).replace(b"rTRC", b"A2B0")
    frames[0].save(tmp_path / "table.png", icc_profile=table)
    frames[0].save(tmp_path / "damaged.png", icc_profile=PROFILES["adobe"][:150])
    for name, reason in (
        ("ink.jpg", "CMYK"), ("moves.png", "animation"), ("moves.gif", "not a PNG"), ("table.png", "damaged"),
        ("damaged.png", "damaged"),
    ):  # fmt: skip
        with pytest.raises(UsageError, match=reason) as refused:
            load_target(tmp_path / name, SIZE)
        assert refused.value.code == "target-unreadable"


def test_a_space_of_linear_light_is_refused_for_whole_numbers(tmp_path: Path) -> None:
    Image.fromarray(patches()).save(tmp_path / "t.png")
    with pytest.raises(UsageError, match="only an EXR"):
        load_target(tmp_path / "t.png", SIZE, "acescg")


def test_chromaticities_that_are_no_colours_are_refused(tmp_path: Path) -> None:
    write_exr(tmp_path / "t.exr", np.ones((SIZE[1], SIZE[0], 3), np.float32), (0.3, 0.3, 0.3, 0.3, 0.3, 0.3, 0.3, 0.0))
    with pytest.raises(UsageError) as refused:
        load_target(tmp_path / "t.exr", SIZE)
    assert refused.value.code == "target-unreadable"


@settings(max_examples=200, deadline=None)
@given(at=st.integers(0, len(PROFILES["line below"]) - 1), data=st.binary(max_size=12), cut=st.integers(0, 600))
def test_a_damaged_profile_is_refused_or_has_finite_light(at: int, data: bytes, cut: int) -> None:
    whole = PROFILES["line below"]
    damaged = (whole[:at] + data + whole[at + len(data) :])[: len(whole) - cut]
    try:
        light = linear_light(patches(), damaged)
    except Unsuitable:
        return
    assert np.isfinite(light).all()


def test_a_live_folder_honours_the_profile(tmp_path: Path) -> None:
    Image.fromarray(patches()).save(tmp_path / "a.png", icc_profile=PROFILES["display p3"])
    shown = FolderSource(tmp_path, loop=True, rate_hz=10.0).next(0.0)
    assert shown is not None
    expected = np.round(255 * linear_to_srgb(read_picture(tmp_path / "a.png"))).astype(np.uint8)
    np.testing.assert_array_equal(shown.pixels, expected)
    assert (shown.pixels != patches()).any()
