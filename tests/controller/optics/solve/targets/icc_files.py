"""ICC profiles of curves and a matrix, written for tests; Little CMS reads them."""

from __future__ import annotations

import struct
import zlib

import numpy as np

P3_D50 = ((0.51512, 0.24120, -0.00105), (0.29198, 0.69225, 0.04189), (0.15710, 0.06657, 0.78407))
"""XYZ of red, green and blue under D50, as in Apple's published Display P3 profile."""
ADOBE_D50 = ((0.60974, 0.31111, 0.01947), (0.20528, 0.62567, 0.06087), (0.14919, 0.06322, 0.74457))
"""As in Adobe's published profile."""
SRGB_CURVE = struct.pack(
    ">4sIHH5i", b"para", 0, 3, 0, *(round(65536 * v) for v in (2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045))
)
ADOBE_CURVE = struct.pack(">4sIIH", b"curv", 0, 1, round(2.19921875 * 256)) + b"\0\0"
TABLE_CURVE = struct.pack(">4sII16H", b"curv", 0, 16, *np.rint(65535 * np.linspace(0, 1, 16) ** 1.8).astype(int))
POWER_WITH_LINE = struct.pack(
    ">4sIHH7i",
    b"para",
    0,
    4,
    0,
    *(round(65536 * v) for v in (1 / 0.45, 1 / 1.099, 0.099 / 1.099, 1 / 4.5, 0.081, 0, 0)),
)
CONSTANT_BELOW = struct.pack(">4sIHH4i", b"para", 0, 2, 0, *(round(65536 * v) for v in (2.0, 0.9, 0.05, 0.05)))
IDENTITY = struct.pack(">4sII", b"curv", 0, 0)


def icc_profile(columns: tuple[tuple[float, ...], ...], curve: bytes, *, kind: bytes = b"RGB ") -> bytes:
    """``columns``: XYZ of red, green, blue; ``curve``: a curve element for all three."""
    tags = {
        name: struct.pack(">4sI3i", b"XYZ ", 0, *(round(65536 * v) for v in xyz))
        for name, xyz in zip((b"rXYZ", b"gXYZ", b"bXYZ"), columns, strict=True)
    }
    tags |= dict.fromkeys((b"rTRC", b"gTRC", b"bTRC"), curve)
    tags[b"wtpt"] = struct.pack(">4sI3i", b"XYZ ", 0, 63190, 65536, 54061)
    text = "test".encode("utf-16-be")
    tags[b"desc"] = tags[b"cprt"] = struct.pack(">4sIII2s2sII", b"mluc", 0, 1, 12, b"en", b"US", len(text), 28) + text
    table, body, at = struct.pack(">I", len(tags)), b"", 132 + 12 * len(tags)
    for name, data in tags.items():
        table += struct.pack(">4sII", name, at + len(body), len(data))
        body += data + b"\0" * (-len(data) % 4)
    size = at + len(body)
    head = struct.pack(">I4sI4s4s4s", size, b"test", 0x04300000, b"mntr", kind, b"XYZ ")
    head += struct.pack(">6H4s", 2026, 1, 1, 0, 0, 0, b"acsp") + b"\0" * 28 + struct.pack(">3i", 63190, 65536, 54061)
    return head.ljust(128, b"\0") + table + body


def with_chunk(png: bytes, kind: bytes, body: bytes) -> bytes:
    """A PNG with one more chunk after its header."""
    chunk = struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
    return png[:33] + chunk + png[33:]


def with_profile(png: bytes, profile: bytes) -> bytes:
    """A PNG with an ICC profile, in any depth."""
    return with_chunk(png, b"iCCP", b"profile\0\0" + zlib.compress(profile))
