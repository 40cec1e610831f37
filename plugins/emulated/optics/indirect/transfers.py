"""The transfer of a stage, worked out once and kept for all stages that have the same."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final, Protocol, Self

import numpy as np
import numpy.typing as npt

from plugins.emulated.core.extensions import extension
from plugins.emulated.core.truth import BenchTruth, SurfaceTruth
from plugins.emulated.optics.indirect.radiosity import Scattering, Transfer, scattering_of, transfer_of
from plugins.emulated.optics.light_cache import read_arrays, write_arrays
from plugins.emulated.optics.objects import StageObject, scene_of
from plugins.emulated.optics.rays import Progress, key_of

KIND: Final = "indirect"
VERSION: Final = 1


class LightTransfer(Protocol):
    """Irradiance that comes back, for what each projector sends out; an engine of another distribution is such a class.

    That has also ``work_out(truth, thing, pixels, progress)``, a class method that may raise DeviceError.
    """

    def light(self, sent: Sequence[npt.NDArray[np.float32] | None]) -> npt.NDArray[np.float32]:
        """(pixels, 3) for what the pixels (rows, columns, 3) of each projector send out; None: nothing."""
        ...

    def arrays(self) -> dict[str, npt.NDArray[Any]]: ...

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, npt.NDArray[Any]]) -> Self:
        """Raises ValueError or KeyError for arrays that are not of one."""
        ...


class IndirectTransfers:
    """Transfers of one object; what depends on the scene alone is kept for a stage whose devices move."""

    def __init__(self, thing: StageObject, cache: Path) -> None:
        self._thing = thing
        self._folder = cache
        self._scattering: tuple[tuple[SurfaceTruth, ...], Scattering] | None = None

    def transfer(
        self, truth: BenchTruth, pixels: npt.NDArray[np.int32], progress: Progress, *, keep: bool
    ) -> LightTransfer | None:
        """The transfer of ``truth``; None without engine. ``pixels``: ``Samples.pixels``.

        ``keep``: it may come from the file, where it was worked out for this very stage, and goes there. A file that is
        absent, damaged or of another stage counts as none. Raises DeviceError ``bench-part-missing``, and that of the
        engine.
        """
        if truth.engine == "direct":
            return None
        own = truth.engine == "radiosity"
        fineness = truth.patches if own else f"{truth.engine} {truth.paths}"
        kind: Any = Transfer if own else extension(truth.engine, asked_by=f'The engine "{truth.engine}" of bench.toml')
        key = f"{VERSION} {fineness} {truth.seed} {key_of(truth, self._thing)}"
        transfer: LightTransfer | None = None
        if keep and (arrays := read_arrays(self._folder, KIND, key)) is not None:
            with contextlib.suppress(ValueError, KeyError):
                transfer = kind.from_arrays(arrays)
        if transfer is None:
            if own:
                transfer = transfer_of(truth, self._scattered(truth, progress), pixels)
            else:
                transfer = kind.work_out(truth, self._thing, pixels, progress)
            if keep:
                write_arrays(self._folder, KIND, key, transfer.arrays())
        progress(1.0)
        return transfer

    def _scattered(self, truth: BenchTruth, progress: Progress) -> Scattering:
        if self._scattering is None or self._scattering[0] != truth.surfaces:
            scene = scene_of(self._thing, truth.surfaces)
            self._scattering = (truth.surfaces, scattering_of(scene, truth.patches, truth.seed, progress))
        return self._scattering[1]
