"""What an emulated Canon EOS writes into its records: codes of exposure, image formats, new objects."""

from __future__ import annotations

import struct
from typing import Final

from plugins.emulated.cameras.card import STORAGE, Stored

_JPEG_FINE: Final = (1, 0, 3)
_JPEG_COARSE: Final = (1, 0, 2)
_RAW: Final = (6, 0, 4)
FORMATS: Final = ((_JPEG_FINE,), (_JPEG_COARSE,), (_RAW,), (_RAW, _JPEG_FINE))


def _thirds(first: int, last: int) -> tuple[int, ...]:
    """Exposure codes in thirds of a stop."""
    return tuple(code for code in range(first, last + 1) if code % 8 in (0, 3, 5))


BULB: Final = 0x0C
SHUTTER: Final = _thirds(0x10, 0x98)
APERTURES: Final = _thirds(0x20, 0x50)
ISO_NAMES: Final = dict(
    zip(
        _thirds(0x48, 0x78),
        (100, 125, 160, 200, 250, 320, 400, 500, 640, 800, 1000, 1250, 1600, 2000, 2500, 3200, 4000, 5000, 6400),
        strict=True,
    )
)
OLD_ISOS: Final = (0x48, 0x50, 0x58, 0x60, 0x68)
_EIGHTHS: Final = {0: 0.0, 3: 1 / 3, 5: 2 / 3}


def seconds(code: int) -> float:
    return float(2.0 ** (7 - code // 8 - _EIGHTHS[code % 8]))


def f_number(code: int) -> float:
    return float(2.0 ** ((code // 8 - 1 + _EIGHTHS[code % 8]) / 2))


def record(code: int, body: bytes) -> bytes:
    padded = body + bytes(-len(body) % 4)
    return struct.pack("<II", 8 + len(padded), code) + padded


def new_object(stored: Stored, *, waiting: bool) -> bytes:
    name = stored.name.encode("ascii") + b"\0"
    size = len(stored.data)
    if waiting:
        return record(0xC186, struct.pack("<IIIII", stored.handle, stored.format, 0, size, 0) + name)
    head = struct.pack("<IIIII", stored.handle, STORAGE, stored.format, 0, 0)
    return record(0xC181, head + struct.pack("<III", size, stored.parent, 0) + name)


def format_bytes(parts: tuple[tuple[int, int, int], ...]) -> bytes:
    return struct.pack("<I", len(parts)) + b"".join(struct.pack("<IIII", 16, *part) for part in parts)


def read_format(data: bytes) -> tuple[tuple[int, int, int], ...]:
    parts = struct.unpack_from("<I", data)[0]
    if parts not in (1, 2) or len(data) != 4 + 16 * parts:
        return ()
    return tuple(struct.unpack_from("<III", data, 8 + 16 * index) for index in range(parts))
