"""Bundles of versions 1 and 2, written from the page of their time: stripes of full width, Zstandard only."""

from __future__ import annotations

import hashlib
import json
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import xxhash
import zstandard

Frames = Mapping[str, npt.NDArray[np.uint8]]


def write_older(path: Path, version: int, appearances: Mapping[str, Frames], stripe_rows: int) -> Path:
    """An unsigned bundle of these appearances: name -> output -> (rows, columns, 3)."""
    data, align = bytearray(4096), {1: 4096, 2: 64}[version]
    parts: list[dict[str, Any]] = []
    for name, frames in appearances.items():
        stripes: dict[str, list[list[Any]]] = {output: [] for output in frames}
        for output, frame in frames.items():
            for top in range(0, len(frame), stripe_rows):
                rows = frame[top : top + stripe_rows].copy()
                rows[1:] = np.diff(rows, axis=0)
                packed = zstandard.compress(rows.tobytes())
                data += bytes(-len(data) % align)
                digest = hashlib.sha256(packed).hexdigest()
                stripes[output].append([len(data), len(packed), xxhash.xxh3_64_hexdigest(packed), digest])
                data += packed
        parts.append({"name": name, "stripes": stripes, "thumbnail": None, "metadata": {}})
    first = next(iter(appearances.values()))
    index: dict[str, Any] = {"stage": "s", "calibration": "c", "created_unix_s": 0, "revision": 0, "appearances": parts}
    index["outputs"] = [
        {"name": name, "width_px": frame.shape[1], "height_px": frame.shape[0], "stripe_rows": stripe_rows}
        for name, frame in first.items()
    ]
    if version > 1:
        index |= {"schedule": [], "live": None}
    data += bytes(-len(data) % align)
    text, start = json.dumps(index).encode(), len(data)
    size = start + len(text) + 128
    data[:72] = struct.pack("<8sIIQQQ32s", b"VELBUNDL", version, 0, start, len(text), size,
                            hashlib.sha256(text).digest())  # fmt: skip
    path.write_bytes(bytes(data) + text + bytes(128))
    return path
