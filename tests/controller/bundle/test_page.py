"""docs/reference/bundle-format.md is complete: a bundle is rebuilt from it byte by byte, its reader refuses damage."""

from __future__ import annotations

import hashlib
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import xxhash
import zstandard
from nacl.exceptions import BadSignatureError
from nacl.signing import SigningKey

from controller.bundle.format import OutputLayout, PlaylistEntry
from controller.bundle.writer import NewAppearance, NewBundle, NewLive, Packing, write_bundle
from tests.controller.bundle.conftest import OUTPUTS, PNG
from tests.controller.bundle.test_round_trip import documented_reader

Document = dict[str, Any]


@pytest.fixture
def full(tmp_path: Path, appearances: list[NewAppearance], key: SigningKey) -> Path:
    """A signed bundle with everything that the format has."""
    random = np.random.default_rng(9)
    arrays = {"wide": random.integers(0, 65536, (7, 5, 2), dtype=np.uint16), "half": random.random((7, 5)).astype("f2"),
              "byte": np.arange(9, dtype=np.uint8), "plain": random.random((3, 4)).astype("f4")}  # fmt: skip
    new = NewBundle(
        "dämo",
        "run-1",
        1_700_000_000,
        OUTPUTS,
        revision=3,
        schedule=[PlaylistEntry("ramp", 9000, 250)],
        live=NewLive((5, 7), arrays),
    )
    tiles = Packing(tuple(OutputLayout(name, w, h, w // 2, h // 2) for name, w, h in OUTPUTS), "zstd")
    write_bundle(tmp_path / "full.vel", new, appearances, key=key, packing=tiles)
    return tmp_path / "full.vel"


def blobs_of(index: Document) -> dict[int, tuple[list[Any], Any]]:
    """By offset, every blob and the bytes that it must have, by the page: from what the documented reader decodes."""
    found: dict[int, tuple[list[Any], Any]] = {}
    sizes = {output["name"]: output for output in index["outputs"]}
    for appearance in index["appearances"]:
        for output, blobs in appearance["bands"].items():
            for number, blob in enumerate(blobs):
                found[blob[0]] = blob, ("band", appearance["name"], output, number * sizes[output]["tile_height_px"])
        if appearance["thumbnail"] is not None:
            found[appearance["thumbnail"][0]] = appearance["thumbnail"], ("thumbnail",)
    for name, array in index["live"]["arrays"].items():
        found[array["blob"][0]] = array["blob"], ("live", name)
    return dict(sorted(found.items()))


TILES = zstandard.ZstdCompressor(compression_params=zstandard.ZstdCompressionParameters(
    strategy=zstandard.STRATEGY_LAZY2, window_log=20, hash_log=18, chain_log=18, search_log=5, min_match=6,
    target_length=32, write_content_size=True, write_checksum=False,
))  # fmt: skip
ARRAYS = zstandard.ZstdCompressor(level=3, write_checksum=False, write_content_size=True)


def packed(values: Any, packer: zstandard.ZstdCompressor, *, differences: bool) -> bytes:
    rows = np.array(values)
    if differences:
        rows[1:] = np.diff(values, axis=0)
    return bytes(packer.compress(rows.tobytes()))


def band(rows: npt.NDArray[np.uint8], width: int) -> bytes:
    table, content = b"", b""
    for left in range(0, rows.shape[1], width):
        tile = np.ascontiguousarray(rows[:, left : left + width])
        content += (data := packed(tile, TILES, differences=True))
        table += struct.pack("<IIQ", len(data), 0, xxhash.xxh3_64_intdigest(tile.tobytes()))
    return table + content


def test_a_bundle_is_rebuilt_from_the_page_byte_by_byte(full: Path, key: SigningKey) -> None:
    reader, data = documented_reader(), full.read_bytes()
    index = reader["read_index"](data, [bytes(key.verify_key)])
    rebuilt = bytearray(4096)
    for offset, (blob, kind) in blobs_of(index).items():
        rebuilt += bytes(-len(rebuilt) % 64)
        assert offset == len(rebuilt), "blobs stand at the next multiple of 64"
        if kind[0] == "band":
            size = next(output for output in index["outputs"] if output["name"] == kind[2])
            rows = reader["read_image"](data, index, kind[1], kind[2])[kind[3] : kind[3] + size["tile_height_px"]]
            content = band(rows, size["tile_width_px"])
        elif kind[0] == "live":
            values = reader["read_live_array"](data, index, kind[1])
            content = packed(values, ARRAYS, differences=values.dtype.kind == "u")
        else:
            content = PNG
        assert blob[1:] == [len(content), xxhash.xxh3_64_hexdigest(content), hashlib.sha256(content).hexdigest()]
        rebuilt += content
    rebuilt += bytes(-len(rebuilt) % 64)
    start = len(rebuilt)
    document = json.dumps(index, sort_keys=True, separators=(",", ":"), ensure_ascii=False).encode()
    size, digest = start + len(document) + 128, hashlib.sha256(document).digest()
    header = struct.pack("<8sIIQQQ32s56x", b"VELBUNDL", 3, 0, start, len(document), size, digest)
    signature = key.sign(b"velatura bundle signature 1\0" + header + document).signature
    rebuilt += document + struct.pack("<8s32s64s24x", b"VELSIGN1", bytes(key.verify_key), signature)
    rebuilt[:128] = header
    assert bytes(rebuilt) == data


def test_the_documented_reader_refuses_every_flipped_byte_of_header_index_and_signature(
    full: Path, key: SigningKey
) -> None:
    reader, data, trusted = documented_reader(), full.read_bytes(), [bytes(key.verify_key)]
    (start,) = struct.unpack_from("<Q", data, 16)
    for place in [*range(128), *range(start, len(data))]:
        changed = bytearray(data)
        changed[place] ^= 1 << place % 8
        with pytest.raises((ValueError, BadSignatureError)):
            reader["read_index"](bytes(changed), trusted)


def test_the_documented_reader_refuses_what_is_wrong_in_a_band(full: Path, key: SigningKey) -> None:
    reader, data = documented_reader(), full.read_bytes()
    index = reader["read_index"](data, [bytes(key.verify_key)])
    offset, length, _, _ = index["appearances"][0]["bands"]["left"][0]
    for place in range(offset, offset + length):
        changed = bytearray(data)
        changed[place] ^= 1 << place % 8
        with pytest.raises(ValueError, match="damaged blob"):
            reader["read_image"](bytes(changed), index, index["appearances"][0]["name"], "left")


def test_the_page_and_the_index_name_the_same_keys(full: Path, key: SigningKey) -> None:
    page = (Path(__file__).parents[3] / "docs" / "reference" / "bundle-format.md").read_text()
    index = documented_reader()["read_index"](full.read_bytes(), [bytes(key.verify_key)])
    tables = [index, index["outputs"][0], index["appearances"][0], index["live"], index["live"]["arrays"]["wide"]]
    for key_name in {name for table in tables for name in table}:
        assert f"`{key_name}`" in page
