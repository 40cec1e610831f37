"""What a bench keeps for the next stage of the same light."""

from __future__ import annotations

import os
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from plugins.emulated.optics import light_cache as kept_light
from plugins.emulated.optics.light_cache import UNFINISHED_S, light_folder, read_arrays, write_arrays


def test_arrays_come_back_for_their_key_alone(tmp_path: Path) -> None:
    arrays = {"a": np.arange(6, dtype=np.int32).reshape(2, 3), "b": np.array(2.5)}
    write_arrays(tmp_path / "new", "rays", "one", arrays)
    found = read_arrays(tmp_path / "new", "rays", "one")
    assert found is not None
    assert {name: values.tolist() for name, values in found.items()} == {"a": [[0, 1, 2], [3, 4, 5]], "b": 2.5}
    assert read_arrays(tmp_path / "new", "rays", "another") is None
    assert read_arrays(tmp_path / "new", "indirect", "one") is None
    assert read_arrays(tmp_path / "nowhere", "rays", "one") is None


@given(st.integers(0, 2**32 - 1), st.integers(0, 900))
def test_a_damaged_file_is_none_or_the_same(tmp_path_factory: pytest.TempPathFactory, seed: int, cut: int) -> None:
    folder = tmp_path_factory.mktemp("kept")
    write_arrays(folder, "rays", "one", {"a": np.arange(50)})
    (file,) = folder.iterdir()
    content = bytearray(file.read_bytes())
    content[seed % len(content)] ^= 1 + seed % 255
    file.write_bytes(bytes(content[: len(content) - cut]))
    found = read_arrays(folder, "rays", "one")
    # A flipped bit of a field that no reader looks at changes nothing.
    assert found is None or np.array_equal(found["a"], np.arange(50))


def test_files_unused_for_longest_go_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kept_light, "MOST_BYTES", 5 * 8_600)
    for number in range(4):
        write_arrays(tmp_path, "rays", str(number), {"a": np.zeros(1000)})
        (newest,) = set(tmp_path.iterdir()) - set(sorted(tmp_path.iterdir(), key=os.path.getmtime)[:-1])
        os.utime(newest, (number, number))
    assert read_arrays(tmp_path, "rays", "0") is not None
    for number in (4, 5):
        write_arrays(tmp_path, "rays", str(number), {"a": np.zeros(1000)})
    there = [number for number in range(6) if read_arrays(tmp_path, "rays", str(number)) is not None]
    assert there == [0, 2, 3, 4, 5]


def test_what_a_killed_bench_left_goes_and_what_another_one_writes_stays(tmp_path: Path) -> None:
    for name, age_s in (("killed", 2 * UNFINISHED_S), ("another", 1.0)):
        path = tmp_path / f"rays-{name}.123.part"
        path.write_bytes(b"begun")
        os.utime(path, (time.time() - age_s,) * 2)
    write_arrays(tmp_path, "rays", "one", {"a": np.zeros(3)})
    assert [path.name for path in tmp_path.glob("*.part")] == ["rays-another.123.part"]


def test_one_larger_than_all_may_be_is_kept_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kept_light, "MOST_BYTES", 1000)
    for number in range(2):
        write_arrays(tmp_path, "rays", str(number), {"a": np.zeros(1000)})
    assert [read_arrays(tmp_path, "rays", str(number)) is not None for number in range(2)] == [False, True]


def test_a_folder_that_cannot_be_made_is_replaced_by_the_stages(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("VELATURA_CACHE", str(tmp_path / "cache"))
    assert light_folder(tmp_path) == tmp_path / "cache/bench"
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("VELATURA_CACHE", str(tmp_path / "file"))
    assert light_folder(tmp_path) == tmp_path


def test_a_full_disk_stops_no_bench(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    write_arrays(tmp_path / "file/below", "rays", "one", {"a": np.zeros(3)})
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
