"""One set of picture files by every way into the program, judged by Pillow, Little CMS, colour-science and tifffile."""

from __future__ import annotations

import io
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import colour
import cv2
import numpy as np
import numpy.typing as npt
import OpenEXR
import pytest
import tifffile
from PIL import Image, ImageCms, ImageOps

from controller.api import develop
from controller.core.arrays import FloatImage
from controller.core.colour import Unsuitable, linear_to_srgb
from controller.core.errors import UsageError, VelaturaError
from controller.core.pictures import decode
from controller.kiosk.store.targets import fitted
from controller.optics.capture.raw import read_jpeg_values, read_photograph
from controller.optics.solve.targets.files import load_target
from controller.panel import decoder
from controller.panel.uploads import UploadLimits, decode_picture
from controller.stage.live import FolderSource
from controller.stage.services.camera import read_grey
from tests.controller.optics.solve.targets.icc_files import (
    ADOBE_CURVE,
    ADOBE_D50,
    P3_D50,
    SRGB_CURVE,
    icc_profile,
    with_chunk,
    with_profile,
)

ROWS, COLUMNS = 8, 12
CODED = np.random.default_rng(5).integers(0, 256, (ROWS, COLUMNS, 3), dtype=np.uint8)
DEEP = np.random.default_rng(6).integers(0, 65536, (ROWS, COLUMNS, 3)).astype(np.uint16)
ADOBE = icc_profile(ADOBE_D50, ADOBE_CURVE)


def png(values: npt.NDArray[Any] = CODED) -> bytes:
    order = [2, 1, 0, 3][: values.shape[2]] if values.ndim == 3 else slice(None)
    return bytes(cv2.imencode(".png", values[..., order] if values.ndim == 3 else values)[1])


def saved(values: npt.NDArray[Any] = CODED, kind: str = "PNG", **options: Any) -> bytes:
    file = io.BytesIO()
    Image.fromarray(values).save(file, kind, **options)
    return file.getvalue()


def jpeg(**options: Any) -> bytes:
    smooth = np.asarray(Image.fromarray(CODED[:2, :3]).resize((COLUMNS, ROWS), Image.Resampling.BICUBIC))
    return saved(smooth, "JPEG", quality=98, subsampling=0, **options)


def turned(orientation: int, kind: str = "JPEG") -> bytes:
    exif = Image.Exif()
    exif[0x0112] = orientation
    return jpeg(exif=exif) if kind == "JPEG" else saved(CODED, kind, exif=exif, lossless=True)


def adobe_by_exif() -> bytes:
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA001] = 0xFFFF
    exif.get_ifd(0x8769)[0xA005] = {1: "R03", 2: b"0100"}
    return jpeg(exif=exif)


def tiff(values: npt.NDArray[Any] = DEEP, **options: Any) -> bytes:
    file = io.BytesIO()
    tifffile.imwrite(file, values, **({"photometric": "rgb", "metadata": None} | options))
    return file.getvalue()


def chrm(white: tuple[float, float], *corners: tuple[float, float]) -> bytes:
    return struct.pack(">8I", *(round(100_000 * value) for xy in (white, *corners) for value in xy))


def as_viewers_show(data: bytes) -> npt.NDArray[Any]:
    """sRGB in [0, 1] by Pillow and Little CMS, in 8 bits."""
    with Image.open(io.BytesIO(data)) as opened:
        upright: Image.Image | None = ImageOps.exif_transpose(opened)
        profile = opened.info.get("icc_profile")
        if profile is not None:
            embedded = ImageCms.ImageCmsProfile(io.BytesIO(profile))
            assert upright is not None
            upright = ImageCms.profileToProfile(
                upright, embedded, ImageCms.createProfile("sRGB"), ImageCms.Intent.RELATIVE_COLORIMETRIC
            )
        assert upright is not None
        return np.asarray(upright.convert("RGB"), np.float32) / 255


def coded(light: npt.NDArray[Any]) -> FloatImage:
    return linear_to_srgb(np.asarray(light, np.float32))


def of_adobe(values: npt.NDArray[Any]) -> FloatImage:
    space = colour.RGB_COLOURSPACES["Adobe RGB (1998)"]
    light = colour.RGB_to_RGB((values / 255.0) ** 2.2, space, colour.RGB_COLOURSPACES["sRGB"])
    return coded(light)


def in_lut_profile() -> bytes:
    """A profile whose matrix says sRGB, and whose table (A2B0, 2 x 2 x 2) exchanges red and blue."""
    to_lab = colour.XYZ_to_Lab(
        colour.RGB_to_XYZ(
            np.array([(r, g, b) for b in (0.0, 1.0) for g in (0.0, 1.0) for r in (0.0, 1.0)]),
            "sRGB", apply_cctf_decoding=False, illuminant=(0.3457, 0.3585), chromatic_adaptation_transform="Bradford",
        ),
        (0.3457, 0.3585),
    )  # fmt: skip
    scaled = (to_lab + np.array([0, 128, 128])) * (65280 / 100, 256, 256)
    table = struct.pack(">4sIBBBx9i", b"mft2", 0, 3, 3, 2, *(65536 * int(v) for v in np.eye(3).ravel()))
    table += struct.pack(">HH", 2, 2) + struct.pack(">6H", *(0, 65535) * 3)
    table += np.clip(np.rint(scaled), 0, 65535).astype(">u2").tobytes() + struct.pack(">6H", *(0, 65535) * 3)
    whole = bytearray(icc_profile(P3_D50, SRGB_CURVE))
    (count,) = struct.unpack_from(">I", whole, 128)
    entries, body = whole[132 : 132 + 12 * count], whole[132 + 12 * count :]
    moved = b"".join(
        name + struct.pack(">II", at + 12, size) for name, at, size in struct.iter_unpack(">4sII", bytes(entries))
    )
    at = len(whole) + 12
    whole[20:24] = b"Lab "
    new = whole[:128] + struct.pack(">I", count + 1) + b"A2B0" + struct.pack(">II", at, len(table)) + moved + body
    new += table
    new[0:4] = struct.pack(">I", len(new))
    return bytes(new)


IN_ADOBE = saved(icc_profile=ADOBE)
GAMMA_22 = struct.pack(">I", 45_455)
ADOBE_CORNERS = chrm((0.3127, 0.329), (0.64, 0.33), (0.21, 0.71), (0.15, 0.06))
FILES: Mapping[str, tuple[bytes, npt.NDArray[Any]]] = {
    "plain.png": (png(), CODED / np.float32(255)),
    "deep.png": (png(DEEP), DEEP / np.float32(65535)),
    "grey.png": (png(CODED[..., 0]), np.dstack([CODED[..., 0]] * 3) / np.float32(255)),
    "palette.png": (data := saved(CODED[..., 0] // 16 * 16), as_viewers_show(data)),
    **{f"turned{n}.jpg": (turned(n), as_viewers_show(turned(n))) for n in range(1, 9)},
    **{f"turned{n}.png": (turned(n, "PNG"), as_viewers_show(turned(n, "PNG"))) for n in (3, 6)},
    "turned.webp": (turned(6, "WEBP"), np.rot90(CODED, -1) / np.float32(255)),
    "adobe.png": (IN_ADOBE, as_viewers_show(IN_ADOBE)),
    "adobe.jpg": (jpeg(icc_profile=ADOBE), as_viewers_show(jpeg(icc_profile=ADOBE))),
    "adobe-deep.png": (with_profile(png(CODED.astype(np.uint16) * 257), ADOBE), as_viewers_show(IN_ADOBE)),
    "table.png": (saved(icc_profile=in_lut_profile()), as_viewers_show(saved(icc_profile=in_lut_profile()))),
    "linear.png": (with_chunk(png(DEEP), b"gAMA", struct.pack(">I", 100_000)), coded(DEEP / 65535)),
    "adobe-by-gama.png": (with_chunk(with_chunk(png(), b"gAMA", GAMMA_22), b"cHRM", ADOBE_CORNERS), of_adobe(CODED)),
    "srgb-goes-before-gama.png": (
        with_chunk(with_chunk(png(), b"gAMA", struct.pack(">I", 100_000)), b"sRGB", b"\0"), CODED / np.float32(255)
    ),
    "profile-goes-before-gama.png": (
        with_chunk(IN_ADOBE, b"gAMA", struct.pack(">I", 100_000)), as_viewers_show(IN_ADOBE)
    ),
    "code-goes-before-profile.png": (with_chunk(IN_ADOBE, b"cICP", bytes((1, 13, 0, 1))), CODED / np.float32(255)),
    "p3-by-code.png": (
        with_chunk(png(), b"cICP", bytes((12, 13, 0, 1))),
        coded(colour.RGB_to_RGB(colour.cctf_decoding(CODED / 255), "Display P3", "sRGB")),
    ),
    "adobe-by-exif.jpg": (adobe_by_exif(), of_adobe(255 * as_viewers_show(jpeg()))),
    "motion.jpg": (jpeg() + b"\0\0\0\x18ftypmp42" + bytes(20_000), as_viewers_show(jpeg())),
    "deep.tif": (tiff(), DEEP / np.float32(65535)),
    "planar.tif": (tiff(np.moveaxis(DEEP, -1, 0).copy(), planarconfig="separate"), DEEP / np.float32(65535)),
    "white-is-zero.tif": (
        tiff(DEEP[..., 0], photometric="miniswhite"), np.dstack([65535 - DEEP[..., 0]] * 3) / np.float32(65535)
    ),
    "packed.tif": (tiff(compression="lzw", predictor=True), DEEP / np.float32(65535)),
    "turned.tif": (tiff(CODED, extratags=[(274, 3, 1, 3, True)]), CODED[::-1, ::-1] / np.float32(255)),
    "adobe.tif": (tiff(CODED, iccprofile=ADOBE), as_viewers_show(IN_ADOBE)),
}  # fmt: skip


def by_stage(path: Path) -> FloatImage:
    with Image.open(path) as opened:
        size = ImageOps.exif_transpose(opened).size if path.suffix != ".tif" else opened.size
    return linear_to_srgb(load_target(path, size).image)


def by_upload(path: Path) -> FloatImage:
    (uploaded := path.with_name("uploaded.png")).write_bytes(decoder.decode(path.read_bytes(), 1_000_000))
    return by_stage(uploaded)


def by_live_folder(path: Path) -> npt.NDArray[Any]:
    shown = FolderSource(path.parent, loop=True, rate_hz=10).next(0.0)
    assert shown is not None
    return shown.pixels / np.float32(255)


@pytest.mark.parametrize("name", FILES)
def test_every_way_shows_what_other_programs_show(tmp_path: Path, name: str) -> None:
    data, expected = FILES[name]
    path = tmp_path / name
    path.write_bytes(data)
    # A profile's numbers have five digits, and Little CMS in Pillow rounds to eight bits.
    within = 2.1 / 255 if name.startswith(("adobe", "table", "profile")) else 1.5e-3
    live = by_live_folder(path)
    stage = by_stage(path)
    np.testing.assert_allclose(stage, expected, atol=within)
    np.testing.assert_allclose(by_upload(path), stage, atol=2e-4)
    np.testing.assert_allclose(live, stage, atol=0.51 / 255)


TRANSPARENT = np.dstack([CODED, np.tile(np.array([255, 0, 100, 200], np.uint8), (ROWS, COLUMNS // 4))])


@pytest.mark.parametrize("name", ["rgba.png", "rgba.webp", "deep.png", "key.png", "grey-key.png", "alpha.tif"])
def test_what_is_transparent_is_no_part_of_the_picture_by_any_way(tmp_path: Path, name: str) -> None:
    key = tuple(int(value) for value in CODED[2, 3])
    data = {
        "rgba.png": png(TRANSPARENT), "rgba.webp": saved(TRANSPARENT, "WEBP", lossless=True, exact=True),
        "deep.png": png(TRANSPARENT.astype(np.uint16) * 257), "key.png": saved(transparency=key),
        "grey-key.png": saved(CODED[..., 0], transparency=int(CODED[2, 3, 0])),
        "alpha.tif": tiff(TRANSPARENT, extrasamples=["unassalpha"]),
    }[name]  # fmt: skip
    mask = TRANSPARENT[..., 3] > 127
    if "key" in name:
        plane = CODED[..., :1] if "grey" in name else CODED
        mask = (plane != plane[2, 3]).any(axis=2)
    shown = np.dstack([CODED[..., 0]] * 3) if "grey" in name else CODED
    path = tmp_path / name
    path.write_bytes(data)
    expected = np.where(mask[..., None], shown / np.float32(255), 0)
    live = by_live_folder(path)
    np.testing.assert_array_equal(load_target(path, (COLUMNS, ROWS)).mask, mask)
    for seen in (live, by_stage(path), by_upload(path)):
        np.testing.assert_allclose(seen, expected, atol=1e-3)
    with Image.open(path.with_name("uploaded.png")) as uploaded:
        pixels = np.asarray(uploaded.convert("RGBA"))
    assert not pixels[pixels[..., 3] == 0].any()


def test_a_premultiplied_tiff_has_its_own_colours(tmp_path: Path) -> None:
    alpha = TRANSPARENT[..., 3:].astype(np.float64) / 255
    multiplied = np.dstack([np.rint(CODED * alpha).astype(np.uint8), TRANSPARENT[..., 3]])
    (tmp_path / "t.tif").write_bytes(tiff(multiplied, extrasamples=["assocalpha"]))
    target = load_target(tmp_path / "t.tif", (COLUMNS, ROWS))
    assert np.abs(linear_to_srgb(target.image) * 255 - CODED)[target.mask].max() < 1.01


def pages(*names: str) -> bytes:
    file = io.BytesIO()
    first, *others = (Image.fromarray(CODED) for _ in names)
    first.save(file, "MPO", quality=98, save_all=True, append_images=others)
    return file.getvalue()


def test_the_first_of_a_jpegs_pictures_counts() -> None:
    with Image.open(io.BytesIO(pages("picture", "gain map"))) as opened:
        np.testing.assert_array_equal(decode(pages("picture", "gain map")).values, np.asarray(opened))


def test_a_picture_that_can_not_be_read_right_is_refused_by_every_way_with_its_reason(tmp_path: Path) -> None:
    thumbnail = Image.Exif()
    thumbnail[0x0112] = 1
    whole = saved(cv2.resize(CODED, (480, 320)), "JPEG", exif=thumbnail.tobytes() + jpeg())
    refused = {
        "cut.jpg": (whole[: len(whole) // 2], "end is missing"),
        "cut-and-closed.jpg": (whole[:-60] + b"\xff\xd9", "end is missing"),
        "progressive.jpg": (jpeg(progressive=True)[:-40] + b"\xff\xd9", "end is missing"),
        "cut.png": (png(DEEP)[:-200], "end is missing"),
        "no-end.png": (png()[:-12], "end is missing"), "cut.tif": (tiff()[:-150], "end is missing"),
        "ink.jpg": (jpeg_of_ink(), "CMYK"),
        "pq.png": (with_chunk(png(DEEP), b"cICP", bytes((9, 16, 0, 1))), "cICP"),
        "narrow.png": (with_chunk(png(), b"cICP", bytes((1, 13, 0, 0))), "cICP"),
        "phone.jpg": (b"\0\0\0\x18ftypheic\0\0\0\0mif1", "HEIC"),
        "ink.tif": (tiff(np.dstack([CODED, CODED[..., 0]]), photometric="separated"), "CMYK"),
        "lab.tif": (tiff(CODED, photometric="cielab"), "Lab"), "float.tif": (tiff(CODED / np.float32(255)), "white"),
        "wrong-profile.png": (saved(icc_profile=icc_profile(P3_D50, SRGB_CURVE, kind=b"CMYK")), "profile"),
    }  # fmt: skip
    for name, (data, reason) in refused.items():
        folder = tmp_path / name.replace(".", "-")
        folder.mkdir()
        (folder / name).write_bytes(data)
        for way in (by_live_folder, lambda path: load_target(path, (COLUMNS, ROWS)), by_upload):
            with pytest.raises((UsageError, Unsuitable), match=reason):
                way(folder / name)
    with pytest.raises(UsageError, match="CMYK") as refusal:
        decode_picture(tmp_path / "ink-jpg" / "ink.jpg", UploadLimits())
    assert refusal.value.code == "picture-refused"


def jpeg_of_ink() -> bytes:
    file = io.BytesIO()
    Image.fromarray(CODED).convert("CMYK").save(file, "JPEG")
    return file.getvalue()


PHOTOGRAPHS: Mapping[str, tuple[bytes, npt.NDArray[Any]]] = {
    "planar": (tiff(np.moveaxis(DEEP, -1, 0).copy(), planarconfig="separate"), DEEP / 65535),
    "white is zero": (
        tiff(DEEP[..., 0], photometric="miniswhite"), np.dstack([65535 - DEEP[..., 0]] * 3) / 65535
    ),
    "turned": (tiff(extratags=[(274, 3, 1, 6, True)]), DEEP / 65535),
    "floats": (tiff((DEEP / 65535).astype(np.float32)), DEEP / 65535),
    "half floats": (tiff((DEEP / 65535).astype(np.float16)), (DEEP / 65535).astype(np.float16)),
    "twelve bits": (tiff(DEEP >> 4, bitspersample=12), (DEEP >> 4) / 4095),
    "packed": (tiff(compression="deflate", predictor=True), DEEP / 65535),
    "big-endian": (tiff(byteorder=">"), DEEP / 65535),
    "tiled": (tiff(np.tile(DEEP, (4, 4, 1)), tile=(16, 16)), np.tile(DEEP, (4, 4, 1)) / 65535),
    "after a thumbnail": (b"", DEEP / 65535),
    "with infrared": (tiff(np.dstack([DEEP, DEEP[..., 0]]), extrasamples=["unspecified"]), DEEP / 65535),
}  # fmt: skip


@pytest.mark.parametrize("name", PHOTOGRAPHS)
def test_a_tiff_photograph_has_the_light_that_its_tags_say(tmp_path: Path, name: str) -> None:
    data, light = PHOTOGRAPHS[name]
    path = tmp_path / "p.tif"
    path.write_bytes(data)
    if name == "after a thumbnail":
        with tifffile.TiffWriter(path) as file:
            file.write(CODED[:4, :4], photometric="rgb", subfiletype=1)
            file.write(DEEP, photometric="rgb")
    np.testing.assert_allclose(read_photograph(path).image, light, atol=1e-5)
    developed = develop(path)
    np.testing.assert_allclose(developed.image[~developed.saturated], light[~developed.saturated], atol=1e-5)


@pytest.mark.parametrize(("photometric", "reason"), [("separated", "CMYK"), ("cielab", "Lab"), ("cfa", "mosaic")])
def test_a_tiff_photograph_of_other_colours_is_refused_by_name(tmp_path: Path, photometric: str, reason: str) -> None:
    values = {"separated": np.dstack([DEEP, DEEP[..., 0]]), "cielab": DEEP, "cfa": DEEP[..., 0]}[photometric]
    (tmp_path / "p.tif").write_bytes(tiff(values, photometric=photometric))
    with pytest.raises(VelaturaError, match=reason) as refused:
        read_photograph(tmp_path / "p.tif")
    assert refused.value.code == "photograph-unreadable"


@pytest.mark.parametrize("name", ["t.tif", "t.jpg", "t.png"])
def test_a_photograph_of_the_board_lies_as_on_the_sensor(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(
        tiff(CODED, extratags=[(274, 3, 1, 6, True)])
        if name == "t.tif"
        else turned(6, name[2:].upper().replace("JPG", "JPEG"))
    )
    assert read_grey(tmp_path / name).shape == (ROWS, COLUMNS)
    if name == "t.jpg":
        assert read_jpeg_values(tmp_path / name).shape == (ROWS, COLUMNS, 3)


def test_a_jpeg_photograph_that_is_cut_off_is_refused(tmp_path: Path) -> None:
    (tmp_path / "p.jpg").write_bytes(jpeg()[:-30])
    with pytest.raises(VelaturaError, match="end is missing"):
        read_jpeg_values(tmp_path / "p.jpg")


LIGHT = np.random.default_rng(8).random((ROWS, COLUMNS, 3)).astype(np.float32)
SPLIT = {name: LIGHT[..., n].copy() for n, name in enumerate("RGB")}


def exr(path: Path, channels: Mapping[str, npt.NDArray[Any]], **header: Any) -> Path:
    whole = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage} | header
    OpenEXR.File(whole, dict(channels)).write(str(path))
    return path


def window(left: int, top: int, right: int, bottom: int) -> tuple[npt.NDArray[np.int32], ...]:
    return np.array([left, top], np.int32), np.array([right, bottom], np.int32)


def test_an_exr_is_seen_in_its_display_window(tmp_path: Path) -> None:
    shown = np.zeros((ROWS + 4, COLUMNS + 5, 3), np.float32)
    shown[3 : 3 + ROWS, 2 : 2 + COLUMNS] = LIGHT
    small = exr(tmp_path / "a.exr", SPLIT, dataWindow=window(2, 3, 13, 10), displayWindow=window(0, 0, 16, 11))
    np.testing.assert_array_equal(load_target(small, (17, 12)).image, shown)
    wide = exr(tmp_path / "b.exr", SPLIT, dataWindow=window(-2, -1, 9, 6), displayWindow=window(0, 0, 7, 5))
    np.testing.assert_array_equal(load_target(wide, (8, 6)).image, LIGHT[1:7, 2:10])
    beside = exr(tmp_path / "c.exr", SPLIT, dataWindow=window(20, 20, 31, 27), displayWindow=window(0, 0, 7, 5))
    assert not load_target(beside, (8, 6)).image.any()


def test_an_exrs_layers_and_parts_are_found_or_named(tmp_path: Path) -> None:
    def layer(name: str, factor: float = 1.0) -> dict[str, npt.NDArray[np.float32]]:
        return {f"{name}.{channel}": plane * np.float32(factor) for channel, plane in SPLIT.items()}

    depth = {"Z": SPLIT["R"]}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    parts = [
        OpenEXR.Part(dict(header), depth, "depth"), OpenEXR.Part(dict(header), dict(SPLIT), "beauty"),
    ]  # fmt: skip
    OpenEXR.File(parts).write(str(tmp_path / "parts.exr"))
    for path in (
        exr(
            tmp_path / "blender.exr", layer("View.Combined") | layer("View.Diffuse", 0.5) | {"View.Depth.Z": SPLIT["R"]}
        ),
        exr(tmp_path / "one.exr", layer("beauty") | depth),
        exr(tmp_path / "own.exr", SPLIT | layer("albedo", 0.5)),
        tmp_path / "parts.exr",
    ):
        np.testing.assert_array_equal(load_target(path, (COLUMNS, ROWS)).image, LIGHT)
    several = exr(tmp_path / "several.exr", layer("left") | layer("right", 0.5))
    with pytest.raises(UsageError, match="left, right"):
        load_target(several, (COLUMNS, ROWS))
    chroma = exr(tmp_path / "yc.exr", {"Y": SPLIT["R"], "RY": SPLIT["G"], "BY": SPLIT["B"]})
    with pytest.raises(UsageError, match="BY, RY, Y"):
        load_target(chroma, (COLUMNS, ROWS))
    places = exr(tmp_path / "xyz.exr", {"X": SPLIT["R"], "Y": SPLIT["G"], "Z": SPLIT["B"]})
    with pytest.raises(UsageError, match="X, Y, Z"):
        load_target(places, (COLUMNS, ROWS))


def test_an_exr_of_xyz_is_converted_as_the_published_samples(tmp_path: Path) -> None:
    """In OpenEXR's own sample, XYZ is that of Rec. 709 with its white of D65, whatever white the header gives."""
    xyz = colour.RGB_to_XYZ(LIGHT, "sRGB", apply_cctf_decoding=False).astype(np.float32)
    third = 1 / 3
    path = exr(
        tmp_path / "xyz.exr", {name: xyz[..., n].copy() for n, name in enumerate("RGB")},
        chromaticities=(1.0, 0.0, 0.0, 1.0, 0.0, 0.0, third, third),
    )  # fmt: skip
    np.testing.assert_allclose(load_target(path, (COLUMNS, ROWS)).image, LIGHT, atol=2e-4)


def test_an_exrs_soft_edges_have_their_own_colour(tmp_path: Path) -> None:
    alpha = np.tile(np.array([1, 0.75, 0.6, 0.2, 0, 1], np.float32), (ROWS, 2))
    channels = {name: plane * alpha for name, plane in SPLIT.items()} | {"A": alpha}
    target = load_target(exr(tmp_path / "a.exr", channels), (COLUMNS, ROWS))
    np.testing.assert_array_equal(target.mask, alpha > 0.5)
    np.testing.assert_allclose(target.image, np.where(target.mask[..., None], LIGHT, 0), atol=1e-6)


def test_a_large_picture_with_a_profile_is_decoded_within_the_uploads_memory(tmp_path: Path) -> None:
    noise = np.random.default_rng(1).integers(0, 256, (100, 150, 3), dtype=np.uint8)
    (tmp_path / "t.jpg").write_bytes(saved(np.tile(noise, (15, 20, 1)), "JPEG", icc_profile=ADOBE))
    png_16 = decode_picture(tmp_path / "t.jpg", UploadLimits(), (1000, 700))
    assert decode(fitted(png_16, (1000, 700))).values.shape == (700, 1000, 3)


def test_no_bytes_end_in_another_error() -> None:
    for name, (data, _) in FILES.items():
        for cut in (4, 20, 60, len(data) // 2, len(data) - 3):
            try:
                decode(data[:cut])
            except Unsuitable:
                continue
            assert name == "motion.jpg" or cut > len(data) // 2, (name, cut)
