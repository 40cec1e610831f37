"""Light and shapes that take long to work out, kept for every stage that has the same.

A stage of the same object, size and seed has the same rays, wherever its folder is. So they are kept in the user's
cache folder, by what they depend on, and the second stage starts at once.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from scipy import sparse

from hal.runtime.caches import cache_folder

MOST_BYTES: Final = 3 << 30
"""Of all kept files together. The newest one is kept, whatever its size."""
UNFINISHED_S: Final = 3600.0
"""A file that was not finished for longer than this is of a bench that was killed."""
_PARTS: Final = ("data", "indices", "indptr", "shape")


def light_folder(otherwise: Path) -> Path:
    """The user's folder for it, or ``otherwise`` where that can't be written."""
    return users_folder() or otherwise


def users_folder() -> Path | None:
    """The user's folder for it; None where that can't be written."""
    try:
        folder = cache_folder() / "bench"
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    except (OSError, RuntimeError):  # RuntimeError: the user has no home folder
        return None
    return folder if os.access(folder, os.W_OK) else None


def read_arrays(folder: Path, kind: str, key: str) -> dict[str, npt.NDArray[Any]] | None:
    """The arrays that were written with this key; None if there are none, or the file is damaged."""
    path = _path(folder, kind, key)
    try:
        # Opened here, because numpy leaves the file of a damaged archive open.
        with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
            if str(archive["key"]) != key:
                return None
            arrays = {name: archive[name] for name in archive.files if name != "key"}
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None
    with contextlib.suppress(OSError):
        os.utime(path)  # what is used stays longest
    return arrays


def write_arrays(folder: Path, kind: str, key: str, arrays: Mapping[str, npt.NDArray[Any]]) -> None:
    """Write ``arrays`` for ``read_arrays``, and remove the files that were not used for longest.

    A disk error is ignored: they are worked out again then.
    """
    path = _path(folder, kind, key)
    temporary = path.with_suffix(f".{os.getpid()}.part")
    with contextlib.suppress(OSError):
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with temporary.open("wb") as file:
                np.savez(file, key=np.array(key), **dict(arrays))  # type: ignore[arg-type]  # numpy's stub takes names for flags
            temporary.replace(path)
            _remove_oldest(folder, path)
        finally:
            temporary.unlink(missing_ok=True)


def sparse_arrays(name: str, matrix: sparse.csr_matrix) -> dict[str, npt.NDArray[Any]]:
    """The arrays of a sparse matrix, from which ``sparse_matrix`` makes it again."""
    return {f"{name}_{part}": np.asarray(getattr(matrix, part)) for part in _PARTS}


def sparse_matrix(arrays: Mapping[str, npt.NDArray[Any]], name: str) -> sparse.csr_matrix:
    """Raises ValueError or KeyError where ``arrays`` has no such matrix."""
    data, indices, starts, shape = (arrays[f"{name}_{part}"] for part in _PARTS)
    return sparse.csr_matrix((data, indices, starts), shape=tuple(shape))


def _path(folder: Path, kind: str, key: str) -> Path:
    return folder / f"{kind}-{hashlib.sha256(key.encode()).hexdigest()[:24]}.npz"


def _remove_oldest(folder: Path, newest: Path) -> None:
    now = newest.stat()
    for path, status in _files(folder, "*.part"):
        if status.st_mtime < now.st_mtime - UNFINISHED_S:
            path.unlink(missing_ok=True)
    older = [(path, status) for path, status in _files(folder, "*.npz") if path != newest]
    total = now.st_size
    for path, status in sorted(older, key=lambda one: -one[1].st_mtime):
        total += status.st_size
        if total > MOST_BYTES:
            path.unlink(missing_ok=True)


def _files(folder: Path, pattern: str) -> Iterator[tuple[Path, os.stat_result]]:
    for path in folder.glob(pattern):
        # Another bench may finish or remove one meanwhile.
        with contextlib.suppress(FileNotFoundError):
            yield path, path.stat()
