"""The transfer of a stage, worked out once and kept in a file."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from scipy import sparse

from plugins.emulated.optics.furnished import furnished
from plugins.emulated.optics.indirect.scattering import Scattering, scattering_of
from plugins.emulated.optics.indirect.transfer import Transfer, transfer_of
from plugins.emulated.optics.objects import StageObject
from plugins.emulated.optics.rays import Progress, key_of
from plugins.emulated.optics.truth import BenchTruth, SurfaceTruth

CACHE: Final = "indirect.npz"
VERSION: Final = 1


class Indirect:
    """Transfers of one object; what depends on the scene alone is kept for a stage whose devices move."""

    def __init__(self, thing: StageObject, cache: Path) -> None:
        self._thing = thing
        self._path = cache / CACHE
        self._scattering: tuple[tuple[SurfaceTruth, ...], Scattering] | None = None

    def transfer(
        self, truth: BenchTruth, pixels: npt.NDArray[np.int32], progress: Progress, *, keep: bool
    ) -> Transfer | None:
        """The transfer of ``truth``; None without engine. ``pixels``: ``Samples.pixels``.

        ``keep``: it may come from the file, where it was worked out for this very stage, and goes there.
        """
        if truth.engine == "direct":
            return None
        key = f"{VERSION} {truth.patches} {truth.seed} {key_of(truth, self._thing)}"
        found = _read(self._path, key) if keep else None
        if found is None:
            found = transfer_of(truth, self._scattered(truth, progress), pixels)
            if keep:
                _write(self._path, key, found)
        progress(1.0)
        return found

    def _scattered(self, truth: BenchTruth, progress: Progress) -> Scattering:
        if self._scattering is None or self._scattering[0] != truth.surfaces:
            scene = furnished(self._thing, truth.surfaces)
            self._scattering = (truth.surfaces, scattering_of(scene, truth.patches, truth.seed, progress))
        return self._scattering[1]


def _read(path: Path, key: str) -> Transfer | None:
    """A file that is absent, damaged or of another stage counts as none."""
    try:
        with np.load(path, allow_pickle=False) as archive:
            if str(archive["key"]) != key:
                return None
            arrive = tuple(_matrix(archive, f"arrive{n}") for n in range(int(archive["projectors"])))
            return Transfer(arrive, archive["back"], archive["cells"], _matrix(archive, "blend"))
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None


def _write(path: Path, key: str, transfer: Transfer) -> None:
    matrices = {f"arrive{n}": one for n, one in enumerate(transfer.arrive)} | {"blend": transfer.blend}
    parts: dict[str, Any] = {
        f"{name}_{part}": getattr(matrix, part)
        for name, matrix in matrices.items()
        for part in ("data", "indices", "indptr", "shape")
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(path.name + ".part")
    try:
        with temporary.open("wb") as file:
            counts: dict[str, Any] = {"key": np.array(key), "projectors": np.array(len(transfer.arrive))}
            np.savez(file, **counts, back=transfer.back, cells=transfer.cells, **parts)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def _matrix(archive: Any, name: str) -> sparse.csr_matrix:
    data, indices, starts, shape = (archive[f"{name}_{part}"] for part in ("data", "indices", "indptr", "shape"))
    return sparse.csr_matrix((data, indices, starts), shape=tuple(shape))
