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

_SHORT, _LONG, _SRATIONAL, _ASCII, _BYTE = 3, 4, 10, 2, 1
_CODES: Final = {_SHORT: "H", _LONG: "I", _SRATIONAL: "i"}
_HEADER: Final = 8
_D65: Final = 21
_PATTERNS: Final = {"RG": (0, 1, 1, 2), "GR": (1, 0, 2, 1), "GB": (1, 2, 0, 1), "BG": (2, 1, 1, 0)}
_NAMES: Final = re.compile(
    r"(?:Bayer(?P<bayer>RG|GR|GB|BG)|(?P<mono>Mono)|(?P<rgb>RGB))(?P<bits>8|10|12|14|16)", re.ASCII
)
Entry = tuple[int, bytes | Sequence[int]]


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
    data: bytes | memoryview,
    size_px: tuple[int, int],
    pixels: PixelFormat,
    *,
    maker: str,
    model: str,
    levels: Levels,
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
        entries = {262: (_SHORT, [2 if pixels.channels == 3 else 1])}
    return _file(entries, samples.tobytes(), columns, rows, pixels.channels)


def _mosaic(pixels: PixelFormat, names: tuple[str, str], levels: Levels) -> dict[int, Entry]:
    maker, name = (text.encode("ascii", "replace") + b"\0" for text in names)
    entries: dict[int, Entry] = {
        262: (_SHORT, [32803]),  # colour filter array
        271: (_ASCII, maker),
        272: (_ASCII, name),
        33421: (_SHORT, [2, 2]),
        33422: (_BYTE, bytes(pixels.bayer)),
        50706: (_BYTE, bytes((1, 4, 0, 0))),
        50708: (_ASCII, name),
        50714: (_LONG, [levels.black_level]),
        50717: (_LONG, [(1 << pixels.bits) - 1]),
    }
    if levels.matrix:
        entries[50721] = (
            _SRATIONAL,
            [part for value in levels.matrix for part in (round(value * 1_000_000), 1_000_000)],
        )
        entries[50778] = (_SHORT, [_D65])
    return entries


def _file(special: Mapping[int, Entry], strip: bytes, columns: int, rows: int, channels: int) -> bytes:
    def entries(strip_at: int) -> dict[int, Entry]:
        return {
            254: (_LONG, [0]),
            256: (_LONG, [columns]),
            257: (_LONG, [rows]),
            258: (_SHORT, [16] * channels),
            259: (_SHORT, [1]),
            273: (_LONG, [strip_at]),
            274: (_SHORT, [1]),
            277: (_SHORT, [channels]),
            278: (_LONG, [rows]),
            279: (_LONG, [len(strip)]),
            **special,
        }

    strip_at = (_HEADER + len(_folder(entries(0))) + 15) // 16 * 16
    head = struct.pack("<2sHI", b"II", 42, _HEADER) + _folder(entries(strip_at))
    return head.ljust(strip_at, b"\0") + strip


def _folder(entries: Mapping[int, Entry]) -> bytes:
    """A TIFF directory, with its longer values behind it."""
    values_at = _HEADER + 2 + 12 * len(entries) + 4
    fixed, values = struct.pack("<H", len(entries)), b""
    for tag in sorted(entries):
        kind, content = entries[tag]
        packed = content if isinstance(content, bytes) else struct.pack(f"<{len(content)}{_CODES[kind]}", *content)
        count = len(content) // (2 if kind == _SRATIONAL else 1)
        field = packed.ljust(4, b"\0")
        if len(packed) > 4:
            field = struct.pack("<I", values_at + len(values))
            values += packed + b"\0" * (len(packed) % 2)
        fixed += struct.pack("<HHI", tag, kind, count) + field
    return fixed + struct.pack("<I", 0) + values
