"""What is written is read back, byte for byte, by our reader and by the one in the documentation."""

from __future__ import annotations

import json
import re
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from nacl.signing import SigningKey

from controller.bundle import format as fmt
from controller.bundle.format import PlaylistEntry
from controller.bundle.reader import Bundle
from controller.bundle.writer import NewAppearance, NewBundle, NewLive, Packing, choose_packing, write_bundle
from controller.core.errors import BundleError
from tests.controller.bundle.older import write_older

Pictures = dict[str, dict[str, npt.NDArray[np.uint8]]]
DOCUMENT = Path(__file__).parents[3] / "docs" / "reference" / "bundle-format.md"


def test_the_same_input_gives_the_same_bytes(
    tmp_path: Path, signed: Path, appearances: list[NewAppearance], key: SigningKey
) -> None:
    again = tmp_path / "again.vel"
    write_bundle(
        again,
        NewBundle(
            stage="demo",
            calibration="run-1",
            created_unix_s=1_700_000_000,
            outputs=[("left", 13, 10), ("right", 8, 6)],
            revision=3,
        ),
        appearances=iter(appearances),
        key=key,
    )
    assert again.read_bytes() == signed.read_bytes()


def test_everything_written_is_read_back(signed: Path, pictures: Pictures, key: SigningKey) -> None:
    with Bundle.open(signed, trusted=[bytes(key.verify_key)]) as bundle:
        bundle.verify()
        assert bundle.signed_by == bytes(key.verify_key)
        index = bundle.index
        assert (index.stage, index.calibration, index.created_unix_s, index.revision) == (
            "demo",
            "run-1",
            1_700_000_000,
            3,
        )
        assert [(o.name, o.width_px, o.height_px) for o in index.outputs] == [("left", 13, 10), ("right", 8, 6)]
        assert dict(index.appearance("noise").metadata) == {"de": 2.5, "ist schön": True}
        assert bundle.thumbnail("noise") is None
        assert (bundle.thumbnail("ramp") or b"").startswith(b"\x89PNG")
        for name, frames in pictures.items():
            for output, frame in frames.items():
                np.testing.assert_array_equal(bundle.decode(name, output), frame)


def test_bands_are_aligned_and_pixels_of_a_ramp_shrink(tmp_path: Path) -> None:
    ramp = np.tile(np.arange(2100, dtype=np.uint16).astype(np.uint8)[:, None, None], (1, 700, 3))
    path = tmp_path / "ramp.vel"
    index = write_bundle(
        path,
        NewBundle(stage="s", calibration="c", created_unix_s=0, outputs=[("P1", 700, 2100)]),
        appearances=[NewAppearance("ramp", {"P1": ramp})],
    )
    blobs = index.appearances[0].bands["P1"]
    assert len(blobs) == 6
    assert all(rows * 700 * 3 <= 768 * 1024 for rows in index.outputs[0].band_heights)
    assert all(blob.offset % 64 == 0 for blob in blobs)
    assert sum(blob.length for blob in blobs) * 100 < ramp.nbytes


@settings(max_examples=40, deadline=None)
@given(st.integers(1, 40), st.integers(1, 21), st.integers(0, 2**32 - 1), st.booleans())
def test_any_size_is_decoded_exactly_on_one_thread_and_on_two(rows: int, columns: int, seed: int, smooth: bool) -> None:
    frame = np.random.default_rng(seed).integers(0, 256, (rows, columns, 3), dtype=np.uint8)
    frame = np.sort(frame, axis=0) if smooth else frame
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(2) as pool:
        path = Path(folder) / "b.vel"
        write_bundle(
            path,
            NewBundle(stage="s", calibration="c", created_unix_s=0, outputs=[("P1", columns, rows)]),
            appearances=[NewAppearance("a", {"P1": frame})],
        )
        with Bundle.open(path, allow_unsigned=True) as bundle:
            np.testing.assert_array_equal(bundle.decode("a", "P1"), frame)
            buffer = np.full_like(frame, 99)
            bundle.decode_into("a", {"P1": buffer}, pool)
            np.testing.assert_array_equal(buffer, frame)


Grid = tuple[int, int]


def tiled_bundle(path: Path, codec: str, grid: Grid, frames: list[npt.NDArray[np.uint8]]) -> Path:
    """A bundle of appearances "0", "1", ... with tiles of this (width, height), compressed this way."""
    rows, columns, _ = frames[0].shape
    layout = fmt.OutputLayout("P1", columns, rows, min(grid[0], columns), min(grid[1], rows))
    write_bundle(
        path,
        NewBundle(stage="s", calibration="c", created_unix_s=0, outputs=[("P1", columns, rows)]),
        appearances=[NewAppearance(str(number), {"P1": frame}) for number, frame in enumerate(frames)],
        packing=Packing((layout,), codec),
    )
    return path


@settings(max_examples=60, deadline=None)
@given(
    st.integers(1, 40), st.integers(1, 21), st.tuples(st.integers(1, 21), st.integers(1, 40)),
    st.sampled_from(fmt.CODECS), st.lists(st.integers(0, 3), min_size=2, max_size=6), st.integers(0, 2**32 - 1),
)  # fmt: skip
def test_decoding_only_what_changes_gives_the_same_pixels_as_decoding_all(
    rows: int, columns: int, grid: Grid, codec: str, order: list[int], seed: int
) -> None:
    random = np.random.default_rng(seed)
    first = random.integers(0, 256, (rows, columns, 3), dtype=np.uint8)
    frames = [first]
    for _ in range(3):
        changed = frames[-1].copy()
        y, x = random.integers(0, rows), random.integers(0, columns)
        changed[y : y + 5, x : x + 5] += 1
        frames.append(changed)
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(2) as pool:
        path = tiled_bundle(Path(folder) / "b.vel", codec, grid, frames)
        with Bundle.open(path, allow_unsigned=True) as bundle:
            bundle.verify()
            buffer = np.full_like(first, 99)
            known = None
            for number in order:
                known = bundle.decode_into(str(number), {"P1": buffer}, pool, known)
                np.testing.assert_array_equal(buffer, frames[number])
        data = path.read_bytes()
        index = json.loads(data[-128 - index_length(data) : -128])
        for number, frame in enumerate(frames):
            np.testing.assert_array_equal(documented_reader()["read_image"](data, index, str(number), "P1"), frame)


def test_tiles_that_are_there_are_not_read_again(tmp_path: Path) -> None:
    frames = [np.random.default_rng(3).integers(0, 256, (20, 30, 3), dtype=np.uint8) for _ in range(2)]
    frames[1][:10, :15] += 1
    path = tiled_bundle(tmp_path / "b.vel", "lz4", (15, 10), frames)
    with Bundle.open(path, allow_unsigned=True) as bundle:
        buffer = np.zeros_like(frames[0])
        known = bundle.decode_into("0", {"P1": buffer})
        buffer[:, 15:] = 7  # what no one may touch, for it is known to be there
        buffer[10:] = 7
        bundle.decode_into("1", {"P1": buffer}, known=known)
    np.testing.assert_array_equal(buffer[:10, :15], frames[1][:10, :15])
    assert (buffer[:, 15:] == 7).all()
    assert (buffer[10:] == 7).all()


@pytest.mark.parametrize("version", [1, 2])
def test_older_bundles_are_decoded_exactly_by_both_readers(tmp_path: Path, pictures: Pictures, version: int) -> None:
    path = write_older(tmp_path / "old.vel", version, pictures, 4)
    data, reader = path.read_bytes(), documented_reader()
    index = json.loads(data[-128 - index_length(data) : -128])
    with Bundle.open(path, allow_unsigned=True) as bundle:
        bundle.verify()
        assert bundle.version == version
        for name, frames in pictures.items():
            for output, frame in frames.items():
                np.testing.assert_array_equal(bundle.decode(name, output), frame)
                np.testing.assert_array_equal(reader["read_image"](data, index, name, output), frame)


def test_images_that_need_no_tiles_are_written_for_a_reader_that_knows_none(unsigned: Path, pictures: Pictures) -> None:
    data, reader = unsigned.read_bytes(), documented_reader()
    assert data[8:12] == bytes((2, 0, 0, 0))
    index = json.loads(data[-128 - index_length(data) : -128])
    for name, frames in pictures.items():
        for output, frame in frames.items():
            np.testing.assert_array_equal(reader["read_image"](data, index, name, output), frame)


def test_the_codec_and_the_tiles_are_chosen_by_what_the_pictures_are() -> None:
    random = np.random.default_rng(8)
    size = ("P1", 4096, 2800)
    steps = np.cumsum(random.integers(-1, 2, (2800, 1, 3)), axis=0).astype(np.uint8)
    flat = np.broadcast_to(steps, (2800, 4096, 3))
    grain = random.integers(100, 102, (2800, 4096, 3), dtype=np.uint8)

    def chosen(size: tuple[str, int, int], *pictures: npt.NDArray[np.uint8]) -> tuple[int, str]:
        found = choose_packing([size], [{"P1": picture} for picture in pictures])
        return found.layouts[0].tile_width_px, found.codec

    assert chosen(size, flat) == (4096, "lz4")
    assert chosen(size, flat, flat) == (316, "lz4")
    assert chosen(size, flat, grain) == (4096, "lz4")
    assert chosen(size, grain) == (4096, "zstd")
    assert chosen(("P1", 400, 300), flat[:300, :400]) == (400, "zstd")
    assert chosen(size) == (4096, "zstd")


def test_equal_bands_are_kept_once(tmp_path: Path) -> None:
    frame = np.random.default_rng(3).integers(0, 256, (20, 30, 3), dtype=np.uint8)
    one = tiled_bundle(tmp_path / "one.vel", "zstd", (30, 10), [frame])
    three = tiled_bundle(tmp_path / "three.vel", "zstd", (30, 10), [frame] * 3)
    assert three.stat().st_size - one.stat().st_size < frame.nbytes


def test_schedule_and_live_arrays_are_read_back_exactly(tmp_path: Path) -> None:
    random = np.random.default_rng(4)
    arrays: dict[str, npt.NDArray[Any]] = {
        "small": random.random((3, 256)).astype(np.float32),
        "half": random.random((7, 5, 3)).astype(np.float16),
        "wide": random.integers(0, 65536, (7, 5, 2), dtype=np.uint16),
        "byte": np.arange(9, dtype=np.uint8),
    }
    frame = np.zeros((4, 5, 3), np.uint8)
    path = tmp_path / "live.vel"
    index = write_bundle(
        path,
        NewBundle(
            stage="s",
            calibration="c",
            created_unix_s=0,
            outputs=[("P1", 5, 4)],
            schedule=[PlaylistEntry("b", 5000, 250), PlaylistEntry("a", 1, 0)],
            live=NewLive((11, 13), arrays),
        ),
        appearances=[NewAppearance("a", {"P1": frame}), NewAppearance("b", {"P1": frame})],
    )
    with Bundle.open(path, allow_unsigned=True) as bundle:
        bundle.verify()
        assert bundle.index == index
        assert bundle.index.schedule == (PlaylistEntry("b", 5000, 250), PlaylistEntry("a", 1, 0))
        assert bundle.index.live is not None
        assert bundle.index.live.target_px == (11, 13)
        for name, values in arrays.items():
            found = bundle.live_array(name)
            assert found.dtype == values.dtype
            np.testing.assert_array_equal(found, values)
    reader = documented_reader()
    data = path.read_bytes()
    found = reader["read_live_array"](data, json.loads(data[-128 - index_length(data) : -128]), "wide")
    np.testing.assert_array_equal(found, arrays["wide"])
    found = reader["read_live_array"](data, json.loads(data[-128 - index_length(data) : -128]), "half")
    np.testing.assert_array_equal(found, arrays["half"])


def index_length(data: bytes) -> int:
    return int.from_bytes(data[24:32], "little")


def documented_reader() -> dict[str, Any]:
    found = re.search(r"## A second reader.*?```python\n(.*?)```", DOCUMENT.read_text(), re.DOTALL)
    assert found is not None
    assert len(found[1].splitlines()) <= 100
    assert "controller" not in found[1]
    reader: dict[str, Any] = {}
    exec(compile(found[1], str(DOCUMENT), "exec"), reader)
    return reader


def test_the_reader_in_the_documentation_sees_the_same_pixels(
    signed: Path, pictures: Pictures, key: SigningKey
) -> None:
    reader = documented_reader()
    data, trusted = signed.read_bytes(), [bytes(key.verify_key)]
    index = reader["read_index"](data, trusted)
    assert index["stage"] == "demo"
    for name, frames in pictures.items():
        for output, frame in frames.items():
            np.testing.assert_array_equal(reader["read_image"](data, index, name, output), frame)
    with pytest.raises(ValueError, match="not signed by us"):
        reader["read_index"](data, [bytes(32)])


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"frames": {}}, "not have exactly one frame"),
        ({"frames": {"P1": np.zeros((4, 5, 3), np.uint8)}}, "shape"),
        ({"frames": {"P1": np.zeros((6, 5, 3), np.float32)}}, "float32"),
        ({"name": "../up"}, "name"),
        ({"name": "two\nlines"}, "name"),
        ({"metadata": {"a": float("nan")}}, "metadata"),
        ({"metadata": {"a": object()}}, "metadata"),
        ({"thumbnail": b"<svg/>"}, "PNG"),
    ],
)
def test_what_the_format_does_not_allow_is_not_written(tmp_path: Path, change: dict[str, Any], sentence: str) -> None:
    path = tmp_path / "b.vel"
    path.write_bytes(b"what was there")
    values: dict[str, Any] = {"name": "a", "frames": {"P1": np.zeros((6, 5, 3), np.uint8)}} | change
    with pytest.raises(BundleError, match=sentence):
        write_bundle(
            path,
            NewBundle(stage="s", calibration="c", created_unix_s=0, outputs=[("P1", 5, 6)]),
            appearances=[NewAppearance(**values)],
        )
    assert path.read_bytes() == b"what was there"
    assert [file.name for file in tmp_path.iterdir()] == ["b.vel"]
