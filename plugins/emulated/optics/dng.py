"""Image files as a camera writes them: raw as DNG (Adobe DNG 1.4 on TIFF 6.0), and Exif 2.31 for JPEG."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Final, TypeAlias

import numpy as np
import numpy.typing as npt

MAKER: Final = "Velatura"
MODEL: Final = "Emulated Camera"
XYZ_TO_LINEAR_SRGB: Final = (
    (3.2404542, -1.5371385, -0.4985314),
    (-0.9692660, 1.8760108, 0.0415560),
    (0.0556434, -0.2040259, 1.0572252),
)
"""ColorMatrix1 of a camera whose own colours are those of linear sRGB (D65)."""

_BYTE, _ASCII, _SHORT, _LONG, _RATIONAL, _UNDEFINED, _SRATIONAL = 1, 2, 3, 4, 5, 7, 10
_FORMAT: Final = {_BYTE: "B", _SHORT: "H", _LONG: "I", _RATIONAL: "II", _SRATIONAL: "ii"}
_HEADER: Final = 8
Entry: TypeAlias = tuple[int, Sequence[float] | bytes]
Entries: TypeAlias = Mapping[int, Entry]


@dataclass(frozen=True, slots=True)
class PictureFacts:
    """What a picture's file says of how it was taken. ``taken``: "YYYY:MM:DD HH:MM:SS".

    ``xyz_to_camera`` (3, 3): the camera's own colours, ColorMatrix1 for D65
    """

    exposure_s: float
    iso: int
    aperture_f: float
    focal_length_mm: float
    taken: str
    serial_number: str
    xyz_to_camera: npt.ArrayLike = XYZ_TO_LINEAR_SRGB


def dng(mosaic: npt.NDArray[np.uint16], *, black_level: int, white_level: int, facts: PictureFacts) -> bytes:
    """A DNG of a Bayer mosaic (rows, columns), red first (RGGB), uncompressed in 16 bits."""
    rows, columns = mosaic.shape
    matrix = [float(value) for value in np.asarray(facts.xyz_to_camera).ravel()]
    size = rows * columns * 2

    def entries(strip: int, exif: int) -> Entries:
        return {
            254: (_LONG, [0]),
            256: (_LONG, [columns]),
            257: (_LONG, [rows]),
            258: (_SHORT, [16]),
            259: (_SHORT, [1]),
            262: (_SHORT, [32803]),  # colour filter array
            271: (_ASCII, _text(MAKER)),
            272: (_ASCII, _text(MODEL)),
            273: (_LONG, [strip]),
            274: (_SHORT, [1]),
            277: (_SHORT, [1]),
            278: (_LONG, [rows]),
            279: (_LONG, [size]),
            284: (_SHORT, [1]),
            306: (_ASCII, _text(facts.taken)),
            33421: (_SHORT, [2, 2]),
            33422: (_BYTE, [0, 1, 1, 2]),
            34665: (_LONG, [exif]),
            50706: (_BYTE, [1, 4, 0, 0]),
            50707: (_BYTE, [1, 1, 0, 0]),
            50708: (_ASCII, _text(f"{MAKER} {MODEL}")),
            50710: (_BYTE, [0, 1, 2]),
            50711: (_SHORT, [1]),
            50714: (_SHORT, [black_level]),
            50717: (_SHORT, [white_level]),
            50721: (_SRATIONAL, matrix),
            50728: (_RATIONAL, [1.0, 1.0, 1.0]),
            50778: (_SHORT, [21]),  # D65
        }

    exif_at = _HEADER + len(_folder(entries(0, 0), _HEADER))
    exif = _folder(_exif(facts), exif_at)
    strip_at = -(-(exif_at + len(exif)) // 16) * 16
    first = _folder(entries(strip_at, exif_at), _HEADER)
    head = struct.pack("<2sHI", b"II", 42, _HEADER) + first + exif
    return head.ljust(strip_at, b"\0") + mosaic.astype("<u2").tobytes()


def with_exif(jpeg: bytes, facts: PictureFacts) -> bytes:
    """A JPEG file with an Exif segment put right after its start marker."""

    def entries(exif: int) -> Entries:
        return {
            271: (_ASCII, _text(MAKER)),
            272: (_ASCII, _text(MODEL)),
            274: (_SHORT, [1]),
            306: (_ASCII, _text(facts.taken)),
            34665: (_LONG, [exif]),
        }

    exif_at = _HEADER + len(_folder(entries(0), _HEADER))
    tiff = struct.pack("<2sHI", b"II", 42, _HEADER) + _folder(entries(exif_at), _HEADER)
    payload = b"Exif\0\0" + tiff + _folder(_exif(facts), exif_at)
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(payload) + 2) + payload + jpeg[2:]


def _exif(facts: PictureFacts) -> Entries:
    return {
        33434: (_RATIONAL, [facts.exposure_s]),
        33437: (_RATIONAL, [facts.aperture_f]),
        34855: (_SHORT, [facts.iso]),
        36864: (_UNDEFINED, b"0231"),
        36867: (_ASCII, _text(facts.taken)),
        37386: (_RATIONAL, [facts.focal_length_mm]),
        42033: (_ASCII, _text(facts.serial_number)),
    }


def _text(value: str) -> bytes:
    return value.encode("ascii", "replace") + b"\0"


def _folder(entries: Entries, at: int) -> bytes:
    """A TIFF image file directory that starts at offset ``at``, with its values right behind it."""
    values_at = at + 2 + 12 * len(entries) + 4
    fixed, values = struct.pack("<H", len(entries)), b""
    for tag in sorted(entries):
        kind, content = entries[tag]
        packed = _packed(kind, content)
        count = len(packed) if isinstance(content, bytes) else len(content)
        if len(packed) <= 4:
            field = packed.ljust(4, b"\0")
        else:
            field = struct.pack("<I", values_at + len(values))
            values += packed + b"\0" * (len(packed) % 2)
        fixed += struct.pack("<HHI", tag, kind, count) + field
    return fixed + struct.pack("<I", 0) + values


def _packed(kind: int, content: Sequence[float] | bytes) -> bytes:
    if isinstance(content, bytes):
        return content
    if kind not in (_RATIONAL, _SRATIONAL):
        return struct.pack(f"<{len(content)}{_FORMAT[kind]}", *(int(value) for value in content))
    fractions = [Fraction(value).limit_denominator(10_000_000) for value in content]
    return b"".join(struct.pack(f"<{_FORMAT[kind]}", f.numerator, f.denominator) for f in fractions)
