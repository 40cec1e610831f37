"""Writes images of cameras that send samples: a Bayer mosaic as DNG 1.4, grey and colour images as TIFF of 16 bits."""

from __future__ import annotations

import re
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from hal.errors import DeviceRefused, PluginError
from hal.registry import setting

BYTE, ASCII, SHORT, LONG, RATIONAL, UNDEFINED, SRATIONAL = 1, 2, 3, 4, 5, 7, 10
"""Types of TIFF 6.0."""
_CODES: Final = {SHORT: "H", LONG: "I", RATIONAL: "I", SRATIONAL: "i"}
HEADER: Final = 8
"""Bytes before the first directory."""
_D65: Final = 21
_PATTERNS: Final = {"RG": (0, 1, 1, 2), "GR": (1, 0, 2, 1), "GB": (1, 2, 0, 1), "BG": (2, 1, 1, 0)}
_NAMES: Final = re.compile(
    r"(?:Bayer(?P<bayer>RG|GR|GB|BG)|(?P<mono>Mono)|(?P<rgb>RGB))(?P<bits>8|10|12|14|16)", re.ASCII
)
Entry = tuple[int, bytes | Sequence[int]]
"""Type and values of a tag; numerator and denominator of each rational number."""


@dataclass(frozen=True, slots=True)
class PixelFormat:
    """A format of the standard PFNC without packing. ``bayer``: colours of the 2x2 sites, () for none."""

    name: str
    bits: int
    channels: int
    bayer: tuple[int, ...] = ()

    @property
    def suffix(self) -> str:
        return ".dng" if self.bayer else ".tif"


def pixel_format(name: str) -> PixelFormat | None:
    """The format of this name; None for packed and other ones, which are not read."""
    match = _NAMES.fullmatch(name)
    if match is None or (match["rgb"] and match["bits"] not in ("8", "16")):
        return None
    bayer = _PATTERNS.get(match["bayer"] or "", ())
    return PixelFormat(name, int(match["bits"]), 3 if match["rgb"] else 1, bayer)


def best_format(names: Sequence[str]) -> PixelFormat | None:
    """The one with colours and the most bits: a mosaic first, then colours, then grey."""
    known = [found for name in names if (found := pixel_format(name)) is not None]
    return max(known, default=None, key=lambda one: (bool(one.bayer), one.channels, one.bits))


@dataclass(frozen=True, slots=True)
class Levels:
    """What a ``[camera]`` table says of the samples.

    ``black_level``: raw steps without light; ``matrix``: XYZ (D65) to camera, nine numbers or none.
    """

    black_level: int
    matrix: tuple[float, ...]


LEVEL_SETTINGS: Final = {
    "black_level": "raw steps without light, as the maker states them (default 0; the calibration measures it)",
    "color_matrix": "nine numbers from XYZ (D65) to the camera's colours, row by row (default: unknown)",
}


def levels_of(settings: Mapping[str, Any]) -> Levels:
    """The settings ``LEVEL_SETTINGS``. Raises PluginError."""
    black_level = setting(settings, "black_level", int, 0)
    matrix = setting(settings, "color_matrix", list, [])
    numbers = [value for value in matrix if isinstance(value, int | float) and not isinstance(value, bool)]
    if len(matrix) not in (0, 9) or len(numbers) != len(matrix) or not 0 <= black_level < 65535:
        raise PluginError(
            "camera-setting",
            what="The camera's black_level or color_matrix is wrong.",
            remedy="Write a whole number of raw steps for black_level, and nine numbers for color_matrix.",
        )
    return Levels(black_level, tuple(float(value) for value in numbers))


def encoded(
    data: bytes | memoryview, size_px: tuple[int, int], pixels: PixelFormat, *, maker: str, model: str, levels: Levels
) -> bytes:
    """The file. ``data``: rows of little-endian samples.

    Raises DeviceRefused("camera-image-size") for another number of bytes than the size says.
    """
    columns, rows = size_px
    kind = np.dtype("u1") if pixels.bits == 8 else np.dtype("<u2")
    count = rows * columns * pixels.channels
    if count <= 0 or len(data) < count * kind.itemsize:
        raise DeviceRefused(
            "camera-image-size",
            what=f"The camera sent {len(data)} bytes for an image of {columns} x {rows} in {pixels.name}.",
            remedy="Choose another format for this camera in stage.toml.",
        )
    samples = np.frombuffer(data, kind, count).astype("<u2")
    if pixels.bayer:
        entries = _mosaic(pixels, (maker, model), levels)
    else:
        # A TIFF has no black level and no white level: zero is black, and the largest number is full scale.
        full = (1 << pixels.bits) - 1
        scaled = np.clip(samples.astype(np.float64) - levels.black_level, 0, None) * (
            65535 / max(1, full - levels.black_level)
        )
        samples = np.minimum(np.rint(scaled), 65535).astype("<u2")
        entries = {262: (SHORT, [2 if pixels.channels == 3 else 1])}
    return tiff_file(entries, samples.tobytes(), columns, rows, pixels.channels)


def _mosaic(pixels: PixelFormat, names: tuple[str, str], levels: Levels) -> dict[int, Entry]:
    maker, name = (text.encode("ascii", "replace") + b"\0" for text in names)
    entries: dict[int, Entry] = {
        262: (SHORT, [32803]),  # colour filter array
        271: (ASCII, maker),
        272: (ASCII, name),
        33421: (SHORT, [2, 2]),
        33422: (BYTE, bytes(pixels.bayer)),
        50706: (BYTE, bytes((1, 4, 0, 0))),
        50708: (ASCII, name),
        50714: (LONG, [levels.black_level]),
        50717: (LONG, [(1 << pixels.bits) - 1]),
    }
    if levels.matrix:
        entries[50721] = (
            SRATIONAL,
            [part for value in levels.matrix for part in (round(value * 1_000_000), 1_000_000)],
        )
        entries[50778] = (SHORT, [_D65])
    return entries


def tiff_file(
    special: Mapping[int, Entry],
    strip: bytes,
    columns: int,
    rows: int,
    channels: int,
    exif: Mapping[int, Entry] | None = None,
) -> bytes:
    """A TIFF with one strip of samples of 16 bits; ``special``: tags beyond those of its layout; ``exif``: Exif's."""

    def entries(strip_at: int, exif_at: int) -> dict[int, Entry]:
        return {
            254: (LONG, [0]),
            256: (LONG, [columns]),
            257: (LONG, [rows]),
            258: (SHORT, [16] * channels),
            259: (SHORT, [1]),
            273: (LONG, [strip_at]),
            274: (SHORT, [1]),
            277: (SHORT, [channels]),
            278: (LONG, [rows]),
            279: (LONG, [len(strip)]),
            **({} if exif is None else {34665: (LONG, [exif_at])}),
            **special,
        }

    exif_at = HEADER + len(tiff_directory(entries(0, 0), HEADER))
    behind = b"" if exif is None else tiff_directory(exif, exif_at)
    strip_at = (exif_at + len(behind) + 15) // 16 * 16
    head = struct.pack("<2sHI", b"II", 42, HEADER) + tiff_directory(entries(strip_at, exif_at), HEADER) + behind
    return head.ljust(strip_at, b"\0") + strip


def tiff_directory(entries: Mapping[int, Entry], at: int) -> bytes:
    """A TIFF directory that begins at offset ``at``, with its longer values behind it."""
    values_at = at + 2 + 12 * len(entries) + 4
    fixed, values = struct.pack("<H", len(entries)), b""
    for tag in sorted(entries):
        kind, content = entries[tag]
        packed = content if isinstance(content, bytes) else struct.pack(f"<{len(content)}{_CODES[kind]}", *content)
        count = len(content) // (2 if kind in (RATIONAL, SRATIONAL) else 1)
        field = packed.ljust(4, b"\0")
        if len(packed) > 4:
            field = struct.pack("<I", values_at + len(values))
            values += packed + b"\0" * (len(packed) % 2)
        fixed += struct.pack("<HHI", tag, kind, count) + field
    return fixed + struct.pack("<I", 0) + values
