"""Bundles that are built to harm are refused, quickly and with little memory."""

from __future__ import annotations

import contextlib
import json
import struct
import time
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import lz4.block
import numpy as np
import pytest
import xxhash
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st

from controller.bundle.format import Blob, OutputLayout
from controller.bundle.index import parse_index
from controller.bundle.reader import Bundle
from controller.bundle.tiles import Inflater, TiledImage
from controller.core.errors import BundleError
from tests.controller.bundle.hostile import (
    Table,
    band_of,
    blob_of,
    older_index,
    refused,
    sealed,
    small_index,
)

FRAME = zstandard.ZstdCompressor().compress(bytes(36))
PIXELS = band_of(FRAME)
BOMB = zstandard.ZstdCompressor(level=19).compress(bytes(50_000_000))
SIZELESS = zstandard.ZstdCompressor(write_content_size=False).compress(bytes(36))
GOOD = blob_of(PIXELS)
GOOD_FRAME = blob_of(FRAME)


def output(**changes: Any) -> Table:
    return {
        "outputs": [{"name": "P1", "width_px": 4, "height_px": 3, "tile_width_px": 4, "tile_height_px": 3, **changes}]
    }


def live(**changes: Any) -> Table:
    return {"target_px": [4, 3], "arrays": {"gain": {"dtype": "u1", "shape": [36], "blob": GOOD_FRAME, **changes}}}


def many_arrays() -> Table:
    return {f"a{number}": live()["arrays"]["gain"] for number in range(129)}


HOSTILE: dict[str, Callable[[], bytes]] = {
    "an output of 4 Gpx": lambda: as_json(small_index(GOOD, **output(width_px=65536, height_px=65536))),
    "an output of 256 Mpx": lambda: as_json(small_index(GOOD, **output(width_px=16384, height_px=16384))),
    "2 million bands": lambda: as_json(small_index(GOOD, **output(height_px=16384, tile_height_px=1))),
    "no rows in a band": lambda: as_json(small_index(GOOD, **output(tile_height_px=0))),
    "no columns in a tile": lambda: as_json(small_index(GOOD, **output(tile_width_px=0))),
    "16384 tiles across": lambda: as_json(small_index(GOOD, **output(width_px=16384, tile_width_px=1))),
    "a tile of 48 MB": lambda: as_json(
        small_index(GOOD, **output(width_px=4096, height_px=4096, tile_width_px=4096, tile_height_px=4096))
    ),
    "a tile wider than its output": lambda: as_json(small_index(GOOD, **output(tile_width_px=5))),
    "an unknown codec": lambda: as_json(small_index(GOOD, codec="brotli")),
    "a codec that is a list": lambda: as_json(small_index(GOOD, codec=["zstd"])),
    "a negative size": lambda: as_json(small_index(GOOD, **output(width_px=-4))),
    "a size that is true": lambda: as_json(small_index(GOOD, **output(width_px=True))),
    "a fractional size": lambda: as_json(small_index(GOOD, **output(width_px=4.0))),
    "a name that climbs": lambda: as_json(small_index(GOOD, **output(name="../P1"))),
    "two outputs of one name": lambda: as_json(small_index(GOOD, outputs=output()["outputs"] * 2)),
    "no outputs": lambda: as_json(small_index(GOOD, outputs=[])),
    "a stripe behind the end": lambda: as_json(small_index([2**62, 9, GOOD[2], GOOD[3]])),
    "a stripe in the header": lambda: as_json(small_index([0, 9, GOOD[2], GOOD[3]])),
    "a stripe over the index": lambda: as_json(small_index([4096, 5000, GOOD[2], GOOD[3]])),
    "a stripe off its place": lambda: as_json(small_index([4097, 9, GOOD[2], GOOD[3]])),
    "a checksum of other length": lambda: as_json(small_index([4096, 9, GOOD[2] + "0", GOOD[3]])),
    "a schedule of strangers": lambda: as_json(small_index(GOOD, schedule=[["b", 1, 0]])),
    "a schedule that ends at once": lambda: as_json(small_index(GOOD, schedule=[["a", 0, 0]])),
    "a fade longer than its picture": lambda: as_json(small_index(GOOD, schedule=[["a", 5, 6]])),
    "a long schedule": lambda: as_json(small_index(GOOD, schedule=[["a", 1, 0]] * 5000)),
    "a live array of objects": lambda: as_json(small_index(GOOD, live=live(dtype="O8"))),
    "a live array of 4 TB": lambda: as_json(small_index(GOOD, live=live(shape=[16384, 16384, 16384]))),
    "a live array without sides": lambda: as_json(small_index(GOOD, live=live(shape=[]))),
    "a live array beyond the file": lambda: as_json(small_index(GOOD, live=live(blob=[2**40, 9, *GOOD_FRAME[2:]]))),
    "many live arrays": lambda: as_json(small_index(GOOD, live={"target_px": [4, 3], "arrays": many_arrays()})),
    "a live target of no size": lambda: as_json(small_index(GOOD, live=live() | {"target_px": [0, 3]})),
    "a missing key": lambda: as_json({**small_index(GOOD), "revision": None}).replace(b'"revision"', b'"extra"'),
    "true for a number": lambda: as_json(small_index(GOOD)).replace(b'"revision": 0', b'"revision": true'),
    "a key twice": lambda: as_json(small_index(GOOD)).replace(b'"stage"', b'"stage":"x","stage"'),
    "a number without end": lambda: as_json(small_index(GOOD)).replace(b'"revision": 0', b'"revision": ' + b"9" * 9999),
    "deep nesting": lambda: b"[" * 1_000_000 + b"]" * 1_000_000,
    "many small lists": lambda: b"[" + b"[]," * 690_000 + b"[]]",
    "not UTF-8": lambda: b'"\xff\xfe"',
    "not JSON": lambda: b"{'a': 1}",
    "a lone surrogate": lambda: as_json(small_index(GOOD)).replace(b'"stage": "s"', b'"stage": "\\ud800"'),
}


def as_json(index: Table) -> bytes:
    return json.dumps(index).encode()


def test_the_small_index_itself_is_sound(tmp_path: Path) -> None:
    path = sealed(tmp_path / "good.vel", as_json(small_index(GOOD)), PIXELS)
    with Bundle.open(path, allow_unsigned=True) as bundle:
        bundle.verify()
        assert not bundle.decode("a", "P1").any()


def test_the_live_section_is_read_and_its_bombs_are_refused(tmp_path: Path) -> None:
    path = sealed(tmp_path / "live.vel", as_json(small_index(GOOD_FRAME, live=live())), FRAME)
    with Bundle.open(path, allow_unsigned=True) as bundle:
        bundle.verify()
        assert bundle.live_array("gain").shape == (36,)
        with pytest.raises(BundleError, match="live mode"):
            bundle.live_array("other")
    path = sealed(tmp_path / "bomb.vel", as_json(small_index(GOOD_FRAME, live=live(shape=[35]))), FRAME)
    with Bundle.open(path, allow_unsigned=True) as bundle, pytest.raises(BundleError, match="damaged"):
        bundle.live_array("gain")


@pytest.mark.parametrize("version", [1, 2])
def test_an_older_bundle_still_plays_and_keeps_its_own_rules(tmp_path: Path, version: int) -> None:
    index = as_json(older_index(GOOD_FRAME, version))
    with Bundle.open(sealed(tmp_path / "old.vel", index, FRAME, version), allow_unsigned=True) as bundle:
        bundle.verify()
        assert (bundle.version, bundle.index.schedule, bundle.index.live, bundle.index.codec)[2:] == (None, "zstd")
        assert not bundle.decode("a", "P1").any()
    others = {1, 2, 3} - {version}
    for other in others:
        refused(tmp_path / "b.vel", sealed(tmp_path / "a.vel", index, FRAME, other).read_bytes(), allow_unsigned=True)
    shifted = as_json(older_index([4096 + 64, *GOOD_FRAME[1:]], version))
    path = sealed(tmp_path / "a.vel", shifted, bytes(64) + FRAME, version)
    if version == 1:
        assert refused(tmp_path / "b.vel", path.read_bytes(), allow_unsigned=True).code == "bundle-damaged"
    else:
        with Bundle.open(path, allow_unsigned=True) as bundle:
            bundle.verify()


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_indexes_are_refused_fast_and_in_little_memory(tmp_path: Path, name: str) -> None:
    path = sealed(tmp_path / "hostile.vel", HOSTILE[name](), PIXELS)
    tracemalloc.start()
    try:
        with pytest.raises(BundleError):
            Bundle.open(path, allow_unsigned=True)
        assert tracemalloc.get_traced_memory()[1] < 64 * 2**20
    finally:
        tracemalloc.stop()
    assert min(seconds_to_refuse(path) for _ in range(3)) < 0.1


def test_a_gap_as_large_as_a_part_is_refused_also_if_it_is_empty(tmp_path: Path) -> None:
    for gap, fine in ((64, True), (4096 - 128, False)):
        index = as_json(small_index([4096 + gap, *GOOD[1:]]))
        path = sealed(tmp_path / f"{gap}.vel", index, bytes(gap) + PIXELS)
        with Bundle.open(path, allow_unsigned=True) as bundle:
            if fine:
                bundle.verify()
            else:
                with pytest.raises(BundleError, match="bytes between"):
                    bundle.verify()


def seconds_to_refuse(path: Path) -> float:
    began = time.process_time()
    with pytest.raises(BundleError):
        Bundle.open(path, allow_unsigned=True)
    return time.process_time() - began


PACKED = lz4.block.compress(bytes(36), store_size=False)
SHORT = zstandard.compress(bytes(35))
BAD_BANDS: dict[str, tuple[str, bytes]] = {
    "a bomb": ("zstd", band_of(BOMB)),
    "a frame without its size": ("zstd", band_of(SIZELESS)),
    "no frame": ("zstd", band_of(b"not a frame")),
    "a frame cut off": ("zstd", band_of(FRAME[:-3])),
    "too few pixels": ("zstd", band_of(SHORT)),
    "LZ4, a bomb": ("lz4", band_of(lz4.block.compress(bytes(50_000_000), store_size=False))),
    "LZ4, cut off": ("lz4", band_of(PACKED[:-3])),
    "LZ4, no block": ("lz4", band_of(b"\xff" * 40)),
    "LZ4, nothing": ("lz4", band_of(b"")),
    "LZ4, too few pixels": ("lz4", band_of(lz4.block.compress(bytes(35), store_size=False))),
    "LZ4, a size that lies": ("lz4", band_of(struct.pack("<i", 2**31 - 1) + PACKED)),
    "Zstandard said to be LZ4": ("lz4", band_of(FRAME)),
    "a tile beyond its band": ("zstd", band_of(FRAME, lengths=[len(FRAME) + 1])),
    "bytes after the tiles": ("zstd", band_of(FRAME) + b"\0"),
    "lengths that wrap around": ("zstd", band_of(FRAME, lengths=[2**32 - 1])),
    "bits that stand for nothing": ("zstd", band_of(FRAME, zero=1)),
    "half a table": ("zstd", band_of(FRAME)[:9]),
}


@pytest.mark.parametrize("name", BAD_BANDS)
def test_bands_that_do_not_hold_their_pixels_are_refused_in_little_memory(tmp_path: Path, name: str) -> None:
    codec, band = BAD_BANDS[name]
    bomb = "bomb" in name
    size = {"width_px": 500, "height_px": 400, "tile_width_px": 500, "tile_height_px": 400} if bomb else {}
    path = sealed(tmp_path / "b.vel", as_json(small_index(blob_of(band), codec=codec, **output(**size))), band)
    tracemalloc.start()
    try:
        with Bundle.open(path, allow_unsigned=True) as bundle, pytest.raises(BundleError):
            bundle.decode("a", "P1")
        assert tracemalloc.get_traced_memory()[1] < 2**20
    finally:
        tracemalloc.stop()


@settings(max_examples=300, deadline=None)
@given(st.sampled_from(["zstd", "lz4"]), st.binary(max_size=120) | st.builds(band_of, st.binary(max_size=80)))
def test_no_bytes_of_a_band_make_the_decoder_fail_in_another_way(codec: str, band: bytes) -> None:
    blob = Blob(4096, len(band), xxhash.xxh3_64_intdigest(band), b"")
    around = np.full((5, 4, 3), 7, np.uint8)
    image = TiledImage([(blob, memoryview(band))], OutputLayout("P1", 4, 3, 4, 3), codec, around[1:4], None, Inflater())
    with contextlib.suppress(BundleError):
        for task in image.tasks():
            task()
    assert (around[[0, 4]] == 7).all()


@settings(max_examples=300, deadline=None)
@given(st.binary(max_size=200))
def test_no_bytes_make_the_index_parser_fail_in_another_way(data: bytes) -> None:
    with pytest.raises(BundleError):
        parse_index(data, data_end=10_000)


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=4),
    max_leaves=8,
)
PLACES = [
    ["stage"],
    ["created_unix_s"],
    ["outputs"],
    ["outputs", 0],
    ["outputs", 0, "name"],
    ["outputs", 0, "width_px"],
    ["outputs", 0, "tile_width_px"],
    ["outputs", 0, "tile_height_px"],
    ["codec"],
    ["appearances"],
    ["appearances", 0],
    ["appearances", 0, "thumbnail"],
    ["appearances", 0, "bands"],
    ["appearances", 0, "bands", "P1"],
    ["appearances", 0, "bands", "P1", 0],
    ["appearances", 0, "bands", "P1", 0, 0],
    ["appearances", 0, "bands", "P1", 0, 1],
    ["appearances", 0, "bands", "P1", 0, 2],
    ["schedule"],
    ["schedule", 0],
    ["schedule", 0, 1],
    ["live"],
    ["live", "target_px"],
    ["live", "arrays"],
    ["live", "arrays", "gain"],
    ["live", "arrays", "gain", "dtype"],
    ["live", "arrays", "gain", "shape"],
    ["live", "arrays", "gain", "shape", 0],
    ["live", "arrays", "gain", "blob"],
]


@settings(max_examples=400, deadline=None)
@given(st.sampled_from(PLACES), JSON)
def test_any_value_at_any_place_is_either_in_bounds_or_refused(place: list[str | int], value: Any) -> None:
    index: Any = small_index(GOOD, live=live())
    inner = index
    for step in place[:-1]:
        inner = inner[step]
    inner[place[-1]] = value
    try:
        parsed = parse_index(json.dumps(index).encode(), data_end=8192)
    except BundleError:
        return
    for appearance in parsed.appearances:
        for blobs in appearance.bands.values():
            assert all(blob.offset >= 4096 and blob.offset + blob.length <= 8192 for blob in blobs)
    if parsed.live is not None:
        assert all(array.raw_bytes <= 2**28 for array in parsed.live.arrays.values())
    assert all(o.width_px * o.height_px <= 2**24 for o in parsed.outputs)
    assert all(3 * o.tile_width_px * o.tile_height_px <= 2**22 for o in parsed.outputs)
