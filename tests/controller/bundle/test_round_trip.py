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

from controller.bundle.format import PlaylistEntry
from controller.bundle.reader import Bundle
from controller.bundle.writer import NewAppearance, NewLive, write_bundle
from controller.core.errors import BundleError

Pictures = dict[str, dict[str, npt.NDArray[np.uint8]]]
DOCUMENT = Path(__file__).parents[3] / "docs" / "reference" / "bundle-format.md"


def test_the_same_input_gives_the_same_bytes(
    tmp_path: Path, signed: Path, appearances: list[NewAppearance], key: SigningKey
) -> None:
    again = tmp_path / "again.vel"
    write_bundle(
        again,
        stage="demo",
        calibration="run-1",
        created_unix_s=1_700_000_000,
        outputs=[("left", 13, 10), ("right", 8, 6)],
        appearances=iter(appearances),
        key=key,
        revision=3,
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


def test_stripes_are_aligned_and_pixels_of_a_ramp_shrink(tmp_path: Path) -> None:
    ramp = np.tile(np.arange(240, dtype=np.uint8)[:, None, None], (1, 300, 3))
    path = tmp_path / "ramp.vel"
    index = write_bundle(
        path,
        stage="s",
        calibration="c",
        created_unix_s=0,
        outputs=[("P1", 300, 240)],
        appearances=[NewAppearance("ramp", {"P1": ramp})],
    )
    blobs = index.appearances[0].stripes["P1"]
    assert len(blobs) == 6
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
            stage="s",
            calibration="c",
            created_unix_s=0,
            outputs=[("P1", columns, rows)],
            appearances=[NewAppearance("a", {"P1": frame})],
        )
        with Bundle.open(path, allow_unsigned=True) as bundle:
            np.testing.assert_array_equal(bundle.decode("a", "P1"), frame)
            buffer = np.full_like(frame, 99)
            bundle.decode_into("a", {"P1": buffer}, pool)
            np.testing.assert_array_equal(buffer, frame)


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
        path, stage="s", calibration="c", created_unix_s=0, outputs=[("P1", 5, 4)],
        appearances=[NewAppearance("a", {"P1": frame}), NewAppearance("b", {"P1": frame})],
        schedule=[PlaylistEntry("b", 5000, 250), PlaylistEntry("a", 1, 0)], live=NewLive((11, 13), arrays),
    )  # fmt: skip
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
            stage="s",
            calibration="c",
            created_unix_s=0,
            outputs=[("P1", 5, 6)],
            appearances=[NewAppearance(**values)],
        )
    assert path.read_bytes() == b"what was there"
    assert [file.name for file in tmp_path.iterdir()] == ["b.vel"]
