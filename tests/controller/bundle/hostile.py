"""Bundles made byte by byte, as someone could who wants to harm a kiosk."""

from __future__ import annotations

import hashlib
import struct
from pathlib import Path
from typing import Any

import pytest
import xxhash

from controller.bundle.reader import Bundle
from controller.core.errors import BundleError

Table = dict[str, Any]


def index_place(data: bytes) -> tuple[int, int]:
    offset, length = struct.unpack_from("<QQ", data, 16)
    return int(offset), int(length)


def refused(path: Path, data: bytes, **how: Any) -> BundleError:
    path.write_bytes(data)
    with pytest.raises(BundleError) as caught, Bundle.open(path, **how) as bundle:
        bundle.verify()
    return caught.value


def sealed(path: Path, index: bytes, blobs: bytes = bytes(4096), version: int = 3) -> Path:
    """An unsigned bundle with this index, hashes right: what someone with a text editor and time can make."""
    start = 4096 + len(blobs)
    head = struct.pack(
        "<8sIIQQQ32s56x", b"VELBUNDL", version, 0, start, len(index), start + len(index) + 128,
        hashlib.sha256(index).digest(),
    )  # fmt: skip
    path.write_bytes(head.ljust(4096, b"\0") + blobs + index + bytes(128))
    return path


def blob_of(data: bytes, offset: int = 4096) -> list[Any]:
    return [offset, len(data), f"{xxhash.xxh3_64_intdigest(data):016x}", hashlib.sha256(data).hexdigest()]


def small_index(blob: list[Any], **changes: Any) -> Table:
    output = {"name": "P1", "width_px": 4, "height_px": 3, "tile_width_px": 4, "tile_height_px": 3}
    appearance = {"name": "a", "bands": {"P1": [blob]}, "thumbnail": None, "metadata": {}}
    index = {"stage": "s", "calibration": "c", "created_unix_s": 0, "revision": 0}
    index |= {"codec": "zstd", "schedule": [["a", 1000, 0]], "live": None}
    return {**index, "outputs": [output], "appearances": [appearance], **changes}


def older_index(blob: list[Any], version: int) -> Table:
    """The same of a version without tiles."""
    index = small_index(blob)
    for key in ("codec",) if version == 2 else ("codec", "schedule", "live"):
        del index[key]
    index["outputs"] = [{"name": "P1", "width_px": 4, "height_px": 3, "stripe_rows": 3}]
    index["appearances"] = [{"name": "a", "stripes": {"P1": [blob]}, "thumbnail": None, "metadata": {}}]
    return index


def band_of(*tiles: bytes, lengths: list[int] | None = None, zero: int = 0) -> bytes:
    """A band of these compressed tiles, whose table says so or lies."""
    sizes = [len(tile) for tile in tiles] if lengths is None else lengths
    return b"".join(struct.pack("<IIQ", size, zero, 1) for size in sizes) + b"".join(tiles)
