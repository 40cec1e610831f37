"""Image files as a camera writes them: raw as DNG (Adobe DNG 1.4 on TIFF 6.0), and Exif 2.31 for JPEG."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from fractions import Fraction
from typing import Final

import numpy as np
import numpy.typing as npt

from plugins.raw_file import (
    ASCII,
    BYTE,
    HEADER,
    LONG,
    RATIONAL,
    SHORT,
    SRATIONAL,
    UNDEFINED,
    Entry,
    tiff_directory,
    tiff_file,
)

MAKER: Final = "Velatura"
MODEL: Final = "Emulated Camera"
XYZ_TO_LINEAR_SRGB: Final = (
    (3.2404542, -1.5371385, -0.4985314),
    (-0.9692660, 1.8760108, 0.0415560),
    (0.0556434, -0.2040259, 1.0572252),
)
"""ColorMatrix1 of a camera whose own colours are those of linear sRGB (D65)."""


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
    entries: dict[int, Entry] = {
        262: (SHORT, [32803]),  # colour filter array
        **_names(facts),
        284: (SHORT, [1]),
        33421: (SHORT, [2, 2]),
        33422: (BYTE, bytes([0, 1, 1, 2])),
        50706: (BYTE, bytes([1, 4, 0, 0])),
        50707: (BYTE, bytes([1, 1, 0, 0])),
        50708: (ASCII, _text(f"{MAKER} {MODEL}")),
        50710: (BYTE, bytes([0, 1, 2])),
        50711: (SHORT, [1]),
        50714: (SHORT, [black_level]),
        50717: (SHORT, [white_level]),
        50721: (SRATIONAL, _rationals(*np.asarray(facts.xyz_to_camera).ravel())),
        50728: (RATIONAL, _rationals(1.0, 1.0, 1.0)),
        50778: (SHORT, [21]),  # D65
    }
    return tiff_file(entries, mosaic.astype("<u2").tobytes(), columns, rows, 1, exif=_exif(facts))


def with_exif(jpeg: bytes, facts: PictureFacts) -> bytes:
    """A JPEG file with an Exif segment put right after its start marker."""

    def entries(exif_at: int) -> dict[int, Entry]:
        return {274: (SHORT, [1]), 34665: (LONG, [exif_at]), **_names(facts)}

    exif_at = HEADER + len(tiff_directory(entries(0), HEADER))
    tiff = struct.pack("<2sHI", b"II", 42, HEADER) + tiff_directory(entries(exif_at), HEADER)
    payload = b"Exif\0\0" + tiff + tiff_directory(_exif(facts), exif_at)
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(payload) + 2) + payload + jpeg[2:]


def _names(facts: PictureFacts) -> dict[int, Entry]:
    return {271: (ASCII, _text(MAKER)), 272: (ASCII, _text(MODEL)), 306: (ASCII, _text(facts.taken))}


def _exif(facts: PictureFacts) -> dict[int, Entry]:
    return {
        33434: (RATIONAL, _rationals(facts.exposure_s)),
        33437: (RATIONAL, _rationals(facts.aperture_f)),
        34855: (SHORT, [facts.iso]),
        36864: (UNDEFINED, b"0231"),
        36867: (ASCII, _text(facts.taken)),
        37386: (RATIONAL, _rationals(facts.focal_length_mm)),
        42033: (ASCII, _text(facts.serial_number)),
    }


def _text(value: str) -> bytes:
    return value.encode("ascii", "replace") + b"\0"


def _rationals(*values: float) -> list[int]:
    """Numerator and denominator of each value."""
    fractions = [Fraction(float(value)).limit_denominator(10_000_000) for value in values]
    return [part for fraction in fractions for part in (fraction.numerator, fraction.denominator)]
