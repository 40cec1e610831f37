"""Array types, and the container for arrays on disk.

The container is NumPy's published ``.npz`` format (a zip of ``.npy`` members), never with pickled objects.
"""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from controller.core.errors import UsageError
from controller.core.storage import stream_atomically

FloatImage: TypeAlias = npt.NDArray[np.float32]
"""(rows, columns) or (rows, columns, 3), linear light."""
ByteImage: TypeAlias = npt.NDArray[np.uint8]
"""(rows, columns, 3) device values of a projector."""
Mask: TypeAlias = npt.NDArray[np.bool_]
"""(rows, columns)."""
Float64: TypeAlias = npt.NDArray[np.float64]


def save_arrays(path: Path, arrays: Mapping[str, npt.NDArray[Any]]) -> None:
    """Write named arrays atomically; the same arrays give the same bytes."""
    stream_atomically(path, lambda file: np.savez(file, **arrays))  # type: ignore[arg-type]


def load_arrays(path: Path) -> dict[str, npt.NDArray[Any]]:
    """Read a file of ``save_arrays``. Raises UsageError("array-file-unreadable") for any other file."""
    try:
        with np.load(path, allow_pickle=False) as archive:
            # Use the members' full names: without the suffix, "a" and "a.npy" would both mean the first.
            return {name: archive[f"{name}.npy"] for name in archive.files}
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise UsageError(
            "array-file-unreadable",
            what=f"{path} is not a readable array file ({error}).",
            remedy="Delete it and run the command that made it again.",
        ) from error
