"""Array files: read or used where they are, the same arrays either way; damaged ones are refused."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from controller.core.arrays import array_in_file, load_arrays, save_arrays, summed
from controller.core.errors import UsageError

NAMES = st.text(st.characters(codec="utf-8", exclude_characters="/\\\0", exclude_categories=["Cs"]), min_size=1)
ARRAYS = hnp.arrays(
    st.sampled_from([np.float32, np.float16, np.float64, np.uint8, np.bool_, np.int64]),
    hnp.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=5),
)


@settings(deadline=None, max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(arrays=st.dictionaries(NAMES, ARRAYS, min_size=1, max_size=4))
def test_what_was_saved_is_found_again_read_or_mapped(
    tmp_path: Path, arrays: dict[str, npt.NDArray[np.generic]]
) -> None:
    path = tmp_path / "a.npz"
    save_arrays(path, arrays)
    for mapped_from in (0, 1 << 30):
        found = load_arrays(path, mapped_from=mapped_from)
        assert list(found) == list(arrays)
        for name, values in arrays.items():
            assert found[name].dtype == values.dtype
            np.testing.assert_array_equal(found[name], values)


def test_mapped_arrays_are_aligned_writable_and_leave_the_file_as_it_is(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    kept: dict[str, npt.NDArray[np.generic]] = {
        "odd name": np.arange(7, dtype=np.uint8),
        "b": np.arange(6, dtype=np.float32).reshape(2, 3),
    }
    save_arrays(path, kept)
    before = path.read_bytes()
    found = load_arrays(path, mapped_from=0)
    for values in found.values():
        assert values.ctypes.data % 64 == 0
        values[:] = 1
    assert path.read_bytes() == before
    np.testing.assert_array_equal(load_arrays(path, mapped_from=0)["b"], kept["b"])


def test_files_of_numpy_itself_are_read_packed_or_not(tmp_path: Path) -> None:
    kept = {"abc": np.arange(5.0), "d": np.asfortranarray(np.arange(6.0).reshape(2, 3))}
    for name, save in (("plain", np.savez), ("packed", np.savez_compressed)):
        path = tmp_path / f"{name}.npz"
        save(path, **kept)  # type: ignore[arg-type]
        found = load_arrays(path, mapped_from=0)
        for key, values in kept.items():
            np.testing.assert_array_equal(found[key], values)


@pytest.mark.parametrize("mapped_from", [0, 1 << 40])
def test_a_small_file_that_unpacks_to_gigabytes_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, mapped_from: int
) -> None:
    monkeypatch.setattr("controller.core.arrays.LARGEST_UNPACKED", 1 << 20)
    np.savez_compressed(tmp_path / "a.npz", zeros=np.zeros(1 << 21, np.uint8))
    with pytest.raises(UsageError, match="packed"):
        load_arrays(tmp_path / "a.npz", mapped_from=mapped_from)
    save_arrays(tmp_path / "b.npz", {"zeros": np.zeros(1 << 21, np.uint8)})
    assert load_arrays(tmp_path / "b.npz", mapped_from=mapped_from)["zeros"].size == 1 << 21


def test_numpy_reads_ours(tmp_path: Path) -> None:
    save_arrays(tmp_path / "a.npz", {"x": np.arange(3)})
    with np.load(tmp_path / "a.npz") as archive:
        np.testing.assert_array_equal(archive["x"], [0, 1, 2])


@settings(deadline=None, max_examples=80, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_a_damaged_file_is_refused_and_never_read_wrongly(tmp_path: Path, data: st.DataObject) -> None:
    path, values = tmp_path / "a.npz", np.arange(40, dtype=np.float32)
    save_arrays(path, {"x": values})
    content = bytearray(path.read_bytes())
    content[data.draw(st.integers(0, len(content) - 1))] ^= data.draw(st.integers(1, 255))
    content = content[: data.draw(st.sampled_from([len(content), len(content) // 2, 3]))]
    path.write_bytes(content)
    found, code = {}, "array-file-unreadable"
    try:
        found = load_arrays(path, mapped_from=0)
    except UsageError as error:
        code = error.code
    assert code == "array-file-unreadable"
    for part in found.values():
        np.testing.assert_array_equal(part, values)


def test_an_array_of_python_objects_is_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", x=np.array([{}], dtype=object))
    for mapped_from in (0, 1 << 30):
        with pytest.raises(UsageError) as refused:
            load_arrays(tmp_path / "a.npz", mapped_from=mapped_from)
        assert refused.value.code == "array-file-unreadable"


def test_members_are_stored_one_after_the_other_without_packing(tmp_path: Path) -> None:
    save_arrays(tmp_path / "a.npz", {"x": np.zeros(1000), "y": np.zeros(3)})
    with zipfile.ZipFile(tmp_path / "a.npz") as archive:
        assert archive.testzip() is None
        assert all(member.compress_type == zipfile.ZIP_STORED for member in archive.infolist())


@pytest.mark.parametrize("from_bytes", [0, 1 << 30])
def test_an_array_in_a_file_is_an_array_and_leaves_nothing(tmp_path: Path, from_bytes: int) -> None:
    values = array_in_file(tmp_path, (3, 4), from_bytes=from_bytes)
    values[:] = 2
    assert values.shape == (3, 4)
    assert values.sum() == 24
    assert list(tmp_path.iterdir()) == []


def test_without_a_disk_memory_takes_its_place(tmp_path: Path) -> None:
    array_in_file(tmp_path / "missing", (2, 2), from_bytes=0)[:] = 1


@given(
    st.lists(
        hnp.arrays(np.float32, (3, 4, 3), elements=st.floats(-1e6, 1e6, width=32)), min_size=1, max_size=4
    )
)  # fmt: skip
def test_a_sum_of_pictures_is_numpys_and_leaves_them_as_they_are(pictures: list[npt.NDArray[np.float32]]) -> None:
    before = [picture.copy() for picture in pictures]
    np.testing.assert_array_equal(summed(pictures), np.sum(pictures, axis=0))
    np.testing.assert_array_equal(pictures, before)
