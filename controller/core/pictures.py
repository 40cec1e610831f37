"""The one reader of picture files: PNG, JPEG, TIFF and WebP, with all that they say of their colours and their place.

Pillow opens PNG, JPEG and WebP, libpng (imagecodecs) decodes PNG in its full depth, tifffile reads TIFF. Anything that
can't be read right is refused by name. It runs in the panel's decoder, too, so it imports little.
"""

from __future__ import annotations

import io
import re
import struct
import warnings
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from PIL import Image, UnidentifiedImageError

from controller.core.arrays import ByteImage, FloatImage, Mask
from controller.core.colour import (
    ADOBE_RGB,
    D65,
    SPACES,
    SRGB,
    Colours,
    Primaries,
    Unsuitable,
    linear_light,
    linear_to_srgb,
)
from controller.core.files import MOST_PIXELS, UnfitFile, check_pixels, read_bytes

KINDS: Final = "PNG, JPEG, TIFF or WebP"
_FORMATS: Final = ("PNG", "JPEG", "WEBP")
_PNG: Final = b"\x89PNG\r\n\x1a\n"
_TIFF: Final = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
_ORIENTATION, _EXIF, _COLOUR_SPACE, _INTEROPERABILITY = 0x0112, 0x8769, 0xA001, 0xA005
_ICC: Final = 34675
TURNED: Final = 5
"""The first orientation at which width is height."""
HEIC: Final = "HEIC and AVIF are not read; set the phone to JPEG"
_HEIC: Final = (b"heic", b"heix", b"hevc", b"heim", b"heis", b"mif1", b"msf1", b"avif", b"avis")


@dataclass(frozen=True, slots=True)
class Picture:
    """A picture file's own numbers.

    ``values`` (rows, columns, 1 or 3): grey, or red, green and blue; uint8 or uint16 over its whole range, or float32
    (linear light, of a TIFF alone); ``alpha`` (rows, columns) of the same type, None where all is opaque;
    ``colours``: what the file says of its colours, else sRGB
    """

    values: npt.NDArray[Any]
    alpha: npt.NDArray[Any] | None
    colours: Colours

    def mask(self) -> Mask | None:
        """(rows, columns): more than half opaque. The others are no part of the picture; None: all pixels are."""
        return None if self.alpha is None else np.asarray(self.alpha > _full(self.alpha) / 2)

    def opacity(self, by: int = 1) -> FloatImage | None:
        """(rows, columns) float32 in [0, 1], each the mean of ``by`` x ``by``; None: all is opaque."""
        return None if self.alpha is None else _means(self.alpha, by) / np.float32(_full(self.alpha))

    def linear(self, colours: Colours | None = None) -> FloatImage:
        """(rows, columns, 3) float32 linear sRGB light; ``colours`` go before the file's own. Raises Unsuitable."""
        if self.values.dtype.kind == "f":
            raise Unsuitable("its numbers are floats, and it does not say which of them is white")
        return linear_light(self.values, colours or self.colours)

    def averaged(self, colours: Colours | None, by: int) -> FloatImage:
        """``linear``, each pixel the mean of ``by`` x ``by``, in little memory. Raises Unsuitable."""
        if by == 1:
            return self.linear(colours)
        rows, columns = (side // by for side in self.values.shape[:2])
        light = np.empty((rows, columns, 3), np.float32)
        for row in range(0, rows, 64):
            part = replace(self, values=self.values[row * by : min(row + 64, rows) * by])
            light[row : row + 64] = _means(part.linear(colours), by)
        return light

    def srgb(self) -> npt.NDArray[Any]:
        """(rows, columns, 3) sRGB: the numbers, or uint16 where colours were converted. Raises Unsuitable."""
        if self.colours == SRGB and self.values.dtype.kind == "u":
            return np.broadcast_to(self.values, (*self.values.shape[:2], 3))
        out = np.empty((*self.values.shape[:2], 3), np.uint16)
        for start in range(0, len(out), 256):  # a picture of 40 million pixels, in a gigabyte of memory
            part = replace(self, values=self.values[start : start + 256]).linear()
            out[start : start + 256] = np.rint(65535 * linear_to_srgb(part))
        return out

    def with_alpha(self) -> npt.NDArray[Any]:
        """(rows, columns, 4) sRGB and alpha, uint8 or uint16; hidden colours are black. Raises Unsuitable."""
        values = self.srgb()
        full = _full(values)
        if self.alpha is None:
            return np.dstack([values, np.full(values.shape[:2], full)])
        alpha = (self.alpha.astype(np.uint32) * (full // _full(self.alpha))).astype(values.dtype)
        return np.dstack([np.where(alpha[..., None] > 0, values, 0), alpha])

    def bytes_shown(self) -> ByteImage:
        """(rows, columns, 3) uint8 sRGB, black where it is no part of the picture. Raises Unsuitable."""
        values = self.srgb()
        shown = values if values.dtype == np.uint8 else np.rint(values / np.float32(257)).astype(np.uint8)
        mask = self.mask()
        return np.ascontiguousarray(shown if mask is None else np.where(mask[..., None], shown, 0), np.uint8)


def prepare(data: bytes) -> None:
    """Load the libraries that decoding ``data`` needs, for a process that limits its memory then."""
    import imagecodecs
    from PIL import MpoImagePlugin, WebPImagePlugin  # noqa: F401 - the others are Pillow's first ones

    if data[:4] in _TIFF:
        import tifffile  # noqa: F401

    Image.preinit()
    imagecodecs.png_encode(imagecodecs.png_decode(imagecodecs.png_encode(np.zeros((1, 1), np.uint8))))


def read_picture_file(path: Path, *, upright: bool = True) -> Picture:
    """The picture in a file; see ``decode``. Raises Unsuitable."""
    try:
        return decode(read_bytes(path), upright=upright)
    except OSError as error:
        raise Unsuitable(f"it can't be read: {error.strerror}") from error


def decode(
    data: bytes, *, upright: bool = True, least_px: tuple[int, int] | None = None, most_pixels: int = MOST_PIXELS
) -> Picture:
    """The first picture of a file. Raises Unsuitable, and UnfitFile for more than ``most_pixels``.

    ``upright``: turned as its EXIF data says, as viewers show it; else as it lies on the sensor
    ``least_px`` (width, height): it may become smaller by a whole number, as long as it covers this size
    """
    read = _read_tiff if data[:4] in _TIFF else _read_with_pillow
    picture, orientation = read(data, least_px, most_pixels)
    if upright:
        picture = _turned(picture, orientation)
    height, width = picture.values.shape[:2]
    by = min(width // least_px[0], height // least_px[1]) if least_px else 1
    return _smaller(picture, by) if by > 1 else picture


def _read_with_pillow(data: bytes, least_px: tuple[int, int] | None, most_pixels: int) -> tuple[Picture, int]:
    """The picture, and its EXIF orientation. Raises as ``decode``."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the size is checked here
            with Image.open(io.BytesIO(data), formats=_FORMATS) as opened:
                check_pixels(Path(), opened.size, most_pixels)
                # A JPEG's further pictures (gain maps, previews) are none of its frames.
                is_jpeg = opened.format in ("JPEG", "MPO")
                if getattr(opened, "is_animated", False) and not is_jpeg:
                    raise Unsuitable("it moves (an animation), and a target is one still picture")
                # Pillow would decode the whole of a PNG to look for it.
                has_exif = opened.format != "PNG" or b"eXIf" in data or b"Raw profile type exif" in data
                exif = opened.getexif() if has_exif else Image.Exif()
                orientation = exif.get(_ORIENTATION, 1)
                drafted_px = least_px[::-1] if least_px and orientation >= TURNED else least_px
                whole_px = opened.size
                if is_jpeg and drafted_px is not None:
                    # A JPEG's blocks are decoded at a half, a quarter or an eighth in a fraction of the time.
                    opened.draft(None, drafted_px)
                progressive = "progressive" in opened.info
                values = _png_values(data) if opened.format == "PNG" else _pillow_values(opened)
                if is_jpeg:
                    # The last parts of a progressive picture show at full size alone.
                    at_px = whole_px if progressive else drafted_px or (1, 1)
                    if not _has_all_blocks(data, at_px, None if progressive or drafted_px is None else values):
                        raise Unsuitable("its end is missing")
                return _with_alpha(values, _colours(opened.info, exif, data)), orientation
    except UnfitFile:
        raise
    except UnidentifiedImageError as error:
        raise Unsuitable(_other_kind(data)) from error
    except Image.DecompressionBombError as error:
        raise UnfitFile(Path(), f"it has more than {most_pixels / 1e6:.0f} million pixels") from error
    except (
        OSError,
        SyntaxError,
        ValueError,
        struct.error,
        zlib.error,
        RuntimeError,
        EOFError,
        OverflowError,
        IndexError,
    ) as error:
        raise Unsuitable("it could not be decoded, or its end is missing") from error


def _other_kind(data: bytes) -> str:
    return HEIC if is_heic(data) else f"it is not a {KINDS} file"


def is_heic(data: bytes) -> bool:
    """Whether a file begins as HEIC or AVIF pictures do."""
    return data[4:8] == b"ftyp" and data[8:12] in _HEIC


_MARKER: Final = re.compile(rb"\xff[^\0\xd0-\xd7\xff]")
_OTHER_BLOCKS: Final = b"\x55\x33" * 512


def _has_all_blocks(jpeg: bytes, at_px: tuple[int, int], values: npt.NDArray[Any] | None) -> bool:
    """Whether a JPEG was written to its end. Decoders invent what is missing before the end marker, without a word.

    More data before the end marker changes the picture only where blocks are missing. It is decoded to cover ``at_px``
    (width, height); ``values``: the picture so decoded, if that was done already
    """

    def decoded(data: bytes) -> npt.NDArray[Any]:
        with Image.open(io.BytesIO(data), formats=("JPEG",)) as opened:
            opened.draft(None, at_px)
            return _pillow_values(opened)

    end = _end_marker(jpeg)
    other = decoded(jpeg[:end] + _OTHER_BLOCKS + jpeg[end : end + 2])
    return np.array_equal(decoded(jpeg[: end + 2]) if values is None else values, other)


def _end_marker(jpeg: bytes) -> int:
    """Where the first picture ends (ITU-T T.81, B.1). Raises ValueError, IndexError."""
    at = 2
    while jpeg[at + 1] != 0xD9:
        is_scan = jpeg[at + 1] == 0xDA
        at += 1 if jpeg[at + 1] == 0xFF else 2 + int.from_bytes(jpeg[at + 2 : at + 4], "big")
        if is_scan:
            following = _MARKER.search(jpeg, at)
            if following is None:
                raise ValueError("no end")
            at = following.start()
    return at


def _png_values(data: bytes) -> npt.NDArray[Any]:
    """(rows, columns, 1 to 4) uint8 or uint16, palettes and transparent colours applied."""
    import imagecodecs

    with Image.open(io.BytesIO(data), formats=("PNG",)) as whole:
        whole.verify()  # libpng takes a file without its end
    values = imagecodecs.png_decode(data)
    return values[..., None] if values.ndim == 2 else values


def _pillow_values(opened: Image.Image) -> npt.NDArray[Any]:
    if opened.mode == "CMYK":
        raise Unsuitable("its colours are those of ink (CMYK), and light needs red, green and blue")
    values = np.asarray(opened)
    return values[..., None] if values.ndim == 2 else values


def _with_alpha(values: npt.NDArray[Any], colours: Colours) -> Picture:
    if values.shape[2] % 2:
        return Picture(values, None, colours)
    alpha = values[..., -1]
    return Picture(values[..., :-1], None if (alpha == _full(alpha)).all() else alpha, colours)


def _colours(info: Mapping[str | tuple[int, int], Any], exif: Image.Exif, data: bytes) -> Colours:
    """By the precedence of PNG (third edition, 4.3); a camera's Adobe RGB by DCF."""
    if data.startswith(_PNG) and (at := data.find(b"\0\0\0\4cICP", 0, data.find(b"IDAT"))) > 0:
        return _coded(*data[at + 8 : at + 12])
    if profile := info.get("icc_profile"):
        return bytes(profile)
    if "srgb" not in info and ("gamma" in info or "chromaticity" in info):
        gamma = info.get("gamma")
        xy = info.get("chromaticity", (*D65, *SRGB.red, *SRGB.green, *SRGB.blue))
        white, red, green, blue = zip(xy[::2], xy[1::2], strict=True)
        return Primaries(red, green, blue, white, 1 / gamma if gamma else "srgb")
    uncalibrated = exif.get_ifd(_EXIF).get(_COLOUR_SPACE) == 0xFFFF
    return ADOBE_RGB if uncalibrated and exif.get_ifd(_INTEROPERABILITY).get(1) == "R03" else SRGB


def _coded(primaries: int, transfer: int, matrix: int, full_range: int) -> Primaries:
    """Code points of ITU-T H.273."""
    named = {1: SPACES["srgb"], 9: SPACES["rec2020"], 12: SPACES["display-p3"]}.get(primaries)
    curve = {4: 2.2, 8: "none", 13: "srgb"}.get(transfer)
    if named is None or curve is None or matrix != 0 or full_range != 1:
        raise Unsuitable(
            f"its colours have the code {primaries}/{transfer}/{matrix}/{full_range} (cICP), such as HDR pictures have:"
            " save it as sRGB, or as EXR"
        )
    return replace(named, curve=curve)  # type: ignore[arg-type]


_INK: Final = {5: "ink (CMYK)", 8: "CIE Lab", 9: "CIE Lab", 10: "CIE Lab", 32803: "a RAW mosaic", 34892: "RAW samples"}
_WHITE_IS_ZERO, _GREY, _RGB, _PALETTE, _YCBCR = 0, 1, 2, 3, 6


def _read_tiff(data: bytes, least_px: tuple[int, int] | None, most_pixels: int) -> tuple[Picture, int]:
    """The first page that is no thumbnail. Raises as ``decode``."""
    import logging

    import tifffile

    del least_px  # decoded whole
    logging.getLogger("tifffile").addHandler(logging.NullHandler())
    try:
        with tifffile.TiffFile(io.BytesIO(data)) as file:
            pages: list[Any] = list(file.pages)
            page = next((one for one in pages if not one.is_reduced), pages[0])
            check_pixels(Path(), (page.imagewidth, page.imagelength), most_pixels)
            values = _tiff_values(page)
            tags = {tag.code: tag.value for tag in page.tags if tag.code in (_ORIENTATION, _ICC)}
    except (UnfitFile, Unsuitable):
        raise
    # Its many codecs have errors of their own: for the reader of the message they are one.
    except Exception as error:
        raise Unsuitable("it could not be decoded, or its end is missing") from error
    picture = _with_alpha(values, bytes(tags[_ICC]) if _ICC in tags else SRGB)
    if picture.alpha is not None and page.extrasamples[0] == 1:  # premultiplied
        full, alpha = _full(values), np.maximum(picture.alpha[..., None], 1)
        plain = np.minimum(np.rint(picture.values * np.float64(full) / alpha), full)
        picture = replace(picture, values=plain.astype(values.dtype))
    return picture, int(tags.get(_ORIENTATION, 1))


def _tiff_values(page: Any) -> npt.NDArray[Any]:
    """(rows, columns, 1 to 4) uint8, uint16 or float32 of a page. Raises Unsuitable."""
    colour, bits, samples = int(page.photometric), page.bitspersample, page.samplesperpixel
    if colour not in (_WHITE_IS_ZERO, _GREY, _RGB, _PALETTE, _YCBCR):
        raise Unsuitable(f"its colours are those of {_INK.get(colour, 'another kind')}, not red, green and blue")
    own = 3 if colour in (_RGB, _YCBCR) else 1
    if samples not in (own, own + 1) or page.imagedepth != 1:
        raise Unsuitable(f"it has {samples} samples a pixel")
    kind = page.dtype.kind if page.dtype is not None else ""
    if kind not in ("b", "u", "f") or (kind == "u" and not 2 <= bits <= 16):
        raise Unsuitable(f"its numbers are not whole numbers of up to 16 bits, and not floats ({bits} bits)")
    values: npt.NDArray[Any] = page.asarray()
    if page.axes.startswith("S"):  # a plane for each colour
        values = np.moveaxis(values, 0, -1)
    values = values.reshape(page.imagelength, page.imagewidth, samples)
    if samples > own and page.extrasamples[:1] not in ((1,), (2,)):
        values = values[..., :own]  # of no stated meaning
    if colour == _PALETTE:
        return np.ascontiguousarray(np.moveaxis(page.colormap[:, values[..., 0]], 0, -1))
    if kind == "f":
        values = values.astype(np.float32)
    elif bits not in (8, 16):
        whole = np.uint8 if bits < 8 else np.uint16
        values = np.rint(values * (np.iinfo(whole).max / (2.0**bits - 1))).astype(whole)
    if colour == _WHITE_IS_ZERO:
        values = _full(values) - values
    if colour == _YCBCR and int(page.compression) not in (6, 7):
        values = np.asarray(Image.fromarray(values, "YCbCr").convert("RGB"))
    return values


def _full(values: npt.NDArray[Any]) -> Any:
    return values.dtype.type(1 if values.dtype.kind == "f" else np.iinfo(values.dtype).max)


def _turned(picture: Picture, orientation: int) -> Picture:
    """Upright, by EXIF's orientation 1 to 8."""

    def turn(plane: npt.NDArray[Any]) -> npt.NDArray[Any]:
        if orientation >= TURNED:
            plane = plane.swapaxes(0, 1)
        if orientation in (3, 4, 7, 8):
            plane = plane[::-1]
        return np.ascontiguousarray(plane[:, ::-1] if orientation in (2, 3, 6, 7) else plane)

    if orientation not in range(2, 9):
        return picture
    return replace(picture, values=turn(picture.values), alpha=None if picture.alpha is None else turn(picture.alpha))


def _means(plane: npt.NDArray[Any], by: int) -> FloatImage:
    """Of ``by`` x ``by`` pixels of (rows, columns[, channels])."""
    rows, columns = (side // by for side in plane.shape[:2])
    whole = plane[: rows * by, : columns * by].reshape(rows, by, columns, by, *plane.shape[2:])
    return np.asarray(whole.mean(axis=(1, 3), dtype=np.float32))


def _smaller(picture: Picture, by: int) -> Picture:
    """Means of ``by`` x ``by`` pixels; a transparent pixel's colour has no weight."""

    dtype = picture.values.dtype
    if picture.alpha is None:
        return replace(picture, values=np.rint(_means(picture.values, by)).astype(dtype))
    alpha = _means(picture.alpha[..., None], by)
    colour = _means(picture.values * picture.alpha[..., None].astype(np.float32), by) / np.maximum(alpha, 1e-6)
    return replace(picture, values=np.rint(colour).astype(dtype), alpha=np.rint(alpha[..., 0]).astype(dtype))
