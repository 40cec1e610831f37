"""What the decoder makes of pictures that people have: the same light, in eight bits."""

from __future__ import annotations

import io
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pytest
from PIL import Image

from controller.core.colour import Unsuitable
from controller.core.files import UnfitFile
from controller.panel.decoder import decode

RAMP = np.linspace(0, 65535, 256).astype(np.uint16)[None].repeat(8, axis=0)
EIGHT = (RAMP >> 8).astype(np.uint8)


def pixels(data: bytes) -> npt.NDArray[np.uint8]:
    png = decode(data, 10_000)
    assert png.startswith(b"\x89PNG")
    with Image.open(io.BytesIO(png)) as picture:
        assert picture.mode == "RGB"
        return np.asarray(picture)


def encoded(kind: str, picture: npt.NDArray[Any]) -> bytes:
    return bytes(cv2.imencode(kind, picture)[1])


def saved(picture: Image.Image, kind: str, **options: Any) -> bytes:
    out = io.BytesIO()
    picture.save(out, kind, **options)
    return out.getvalue()


@pytest.mark.parametrize("kind", [".png", ".tiff"])
@pytest.mark.parametrize("layers", [1, 3])
def test_sixteen_bits_become_eight_and_not_white(kind: str, layers: int) -> None:
    found = pixels(encoded(kind, RAMP if layers == 1 else np.dstack([RAMP] * 3)))
    assert np.abs(found.astype(int) - EIGHT[..., None]).max() <= 1


def test_big_endian_sixteen_bits_too() -> None:
    big = Image.frombytes("I;16B", (256, 8), RAMP.astype(">u2").tobytes())
    assert np.array_equal(pixels(saved(big, "TIFF")), np.dstack([EIGHT] * 3))


def test_a_picture_that_says_nowhere_what_is_white_is_refused() -> None:
    for picture in (Image.fromarray((RAMP / 65535).astype(np.float32)), Image.fromarray(RAMP.astype(np.int32))):
        with pytest.raises(Unsuitable, match="numbers"):
            decode(saved(picture, "TIFF"), 10_000)


@pytest.mark.parametrize("mode", ["1", "L", "P", "RGB", "RGBA", "LA", "YCbCr"])
def test_every_mode_becomes_rgb_of_the_same_colours(mode: str) -> None:
    grey = Image.fromarray(EIGHT).point(lambda value: 255 * (value > 127))
    data = saved(grey.convert("RGB").convert(mode), "TIFF" if mode == "YCbCr" else "PNG")
    assert np.abs(pixels(data).astype(int) - np.asarray(grey)[..., None]).max() <= 2


def test_it_is_turned_as_the_camera_was_held() -> None:
    exif = Image.Exif()
    exif[0x0112] = 6
    found = pixels(saved(Image.fromarray(np.dstack([EIGHT] * 3)), "PNG", exif=exif))
    assert found.shape == (256, 8, 3)
    assert found[0].max() < found[-1].min()


def test_too_many_pixels_are_told_before_they_are_decoded() -> None:
    assert decode(saved(Image.new("RGB", (100, 100)), "PNG"), 10_000)
    with pytest.raises(UnfitFile):
        decode(saved(Image.new("RGB", (101, 100)), "PNG"), 10_000)


@pytest.mark.parametrize(("size", "least", "expected"), [
    ((2000, 1500), (400, 300), (400, 300)),  # an exact fifth: a quarter by the JPEG's blocks, which still covers it
    ((2000, 1500), (700, 300), (1000, 750)), ((2000, 1500), (2400, 1600), (2000, 1500)),
])  # fmt: skip
@pytest.mark.parametrize("kind", ["JPEG", "PNG"])
@pytest.mark.parametrize("turned", [False, True])
def test_a_large_picture_is_made_smaller_and_still_covers_what_is_asked(
    size: tuple[int, int], least: tuple[int, int], expected: tuple[int, int], kind: str, turned: bool
) -> None:
    ramp = np.linspace(0, 255, size[0])[None, :, None] * np.linspace(0, 1, size[1])[:, None, None]
    whole = Image.fromarray(np.repeat(ramp, 3, axis=2).astype(np.uint8))
    held = Image.Exif()
    if turned:
        # What is to be seen upright lies on its side in the file.
        held[0x0112] = 6
        whole = whole.transpose(Image.Transpose.ROTATE_90)
    with Image.open(io.BytesIO(decode(saved(whole, kind, exif=held), 10_000_000, least))) as found:
        assert found.width >= min(least[0], size[0])
        assert found.height >= min(least[1], size[1])
        assert found.size == expected or (kind == "JPEG" and expected == (400, 300) and found.size == (500, 375))
        seen = np.asarray(found, float)[..., 0]
    upright = np.asarray(Image.fromarray(ramp[..., 0].astype(np.uint8)).resize(found.size, Image.Resampling.BOX), float)
    assert np.abs(seen - upright).mean() < 1.5
