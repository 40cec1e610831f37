"""The transfer of a stage, worked out once and kept for all stages that have the same."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from scipy import sparse

from plugins.emulated.core.truth import BenchTruth, SurfaceTruth
from plugins.emulated.optics.indirect.paths import TracedTransfer, traced_transfer
from plugins.emulated.optics.indirect.radiosity import Scattering, Transfer, scattering_of, transfer_of
from plugins.emulated.optics.light_cache import read_arrays, write_arrays
from plugins.emulated.optics.objects import StageObject, scene_of
from plugins.emulated.optics.rays import Progress, key_of

KIND: Final = "indirect"
VERSION: Final = 1


class IndirectTransfers:
    """Transfers of one object; what depends on the scene alone is kept for a stage whose devices move."""

    def __init__(self, thing: StageObject, cache: Path) -> None:
        self._thing = thing
        self._folder = cache
        self._scattering: tuple[tuple[SurfaceTruth, ...], Scattering] | None = None

    def transfer(
        self, truth: BenchTruth, pixels: npt.NDArray[np.int32], progress: Progress, *, keep: bool
    ) -> Transfer | TracedTransfer | None:
        """The transfer of ``truth``; None without engine. ``pixels``: ``Samples.pixels``.

        ``keep``: it may come from the file, where it was worked out for this very stage, and goes there.
        Raises DeviceError ``engine-missing``.
        """
        if truth.engine == "direct":
            return None
        fineness = truth.patches if truth.engine == "radiosity" else f"{truth.engine} {truth.paths}"
        key = f"{VERSION} {fineness} {truth.seed} {key_of(truth, self._thing)}"
        transfer = _read(self._folder, key) if keep else None
        if transfer is None:
            if truth.engine == "mitsuba":
                transfer = traced_transfer(truth, self._thing, pixels, progress)
            else:
                transfer = transfer_of(truth, self._scattered(truth, progress), pixels)
            if keep:
                _write(self._folder, key, transfer)
        progress(1.0)
        return transfer

    def _scattered(self, truth: BenchTruth, progress: Progress) -> Scattering:
        if self._scattering is None or self._scattering[0] != truth.surfaces:
            scene = scene_of(self._thing, truth.surfaces)
            self._scattering = (truth.surfaces, scattering_of(scene, truth.patches, truth.seed, progress))
        return self._scattering[1]


def _read(folder: Path, key: str) -> Transfer | TracedTransfer | None:
    """A file that is absent, damaged or of another stage counts as none."""
    arrays = read_arrays(folder, KIND, key)
    try:
        if arrays is None:
            return None
        blend, projectors = _matrix(arrays, "blend"), range(int(arrays["projectors"]))
        if "back" in arrays:
            arrive = tuple(_matrix(arrays, f"arrive{n}") for n in projectors)
            return Transfer(arrive, arrays["back"], arrays["cells"], blend)
        parts = tuple(tuple(_matrix(arrays, f"part{n}{channel}") for channel in range(3)) for n in projectors)
        return TracedTransfer(parts, tuple(int(side) for side in arrays["group"]), blend)
    except (ValueError, KeyError):
        return None


def _write(folder: Path, key: str, transfer: Transfer | TracedTransfer) -> None:
    matrices: dict[str, sparse.csr_matrix] = {"blend": transfer.blend}
    if isinstance(transfer, Transfer):
        arrays: dict[str, Any] = {"back": transfer.back, "cells": transfer.cells}
        matrices |= {f"arrive{n}": one for n, one in enumerate(transfer.arrive)}
        count = len(transfer.arrive)
    else:
        arrays, count = {"group": np.array(transfer.group)}, len(transfer.parts)
        matrices |= {
            f"part{n}{channel}": one for n, part in enumerate(transfer.parts) for channel, one in enumerate(part)
        }
    arrays |= {
        f"{name}_{part}": getattr(matrix, part)
        for name, matrix in matrices.items()
        for part in ("data", "indices", "indptr", "shape")
    }
    write_arrays(folder, KIND, key, {"projectors": np.array(count), **arrays})


def _matrix(arrays: Mapping[str, npt.NDArray[Any]], name: str) -> sparse.csr_matrix:
    data, indices, starts, shape = (arrays[f"{name}_{part}"] for part in ("data", "indices", "indptr", "shape"))
    return sparse.csr_matrix((data, indices, starts), shape=tuple(shape))
