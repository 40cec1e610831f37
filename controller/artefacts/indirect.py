"""What a run measured of the light that reaches the camera by way of other surfaces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Self

import numpy as np

from controller.artefacts.kinds import StepKind
from controller.artefacts.names import json_path, npz_path, read_json, write_json
from controller.calibrate.values import Radiometry
from controller.core.arrays import Float64, FloatImage, load_arrays, save_arrays

LEAST_MEDIAN: Final = 0.005
LEAST_P95: Final = 0.02
"""With less indirect light than both, a stage is taken as one without."""


@dataclass(frozen=True, slots=True)
class Indirect:
    """``indirect-PROJECTOR.npz``: the share of its white that is indirect, and its radiometry in direct light.

    ``share`` (camera rows, columns, 3) float32, 0 to 1; ``response``, ``mixing``: see ``Radiometry``
    """

    share: FloatImage
    response: Float64
    mixing: Float64

    @property
    def radiometry(self) -> Radiometry:
        return Radiometry(self.response, self.mixing)

    def write(self, run: Path, projector: str) -> Path:
        path = npz_path(run, StepKind.INDIRECT, projector)
        save_arrays(path, {"share": self.share.astype(np.float16), "response": self.response, "mixing": self.mixing})
        return path

    @classmethod
    def read(cls, run: Path, projector: str) -> Self:
        arrays = load_arrays(npz_path(run, StepKind.INDIRECT, projector))
        return cls(arrays["share"].astype(np.float32), arrays["response"], arrays["mixing"])


@dataclass(frozen=True, slots=True)
class IndirectFigures:
    """``indirect-PROJECTOR.json``: indirect light as a share of a projector's white, ``median`` and ``p95`` of pixels.

    ``response`` (3,): relative change of the response at value 64 by being fitted to direct light
    """

    median: float
    p95: float
    response: tuple[float, ...] = ()

    @property
    def matters(self) -> bool:
        return self.median >= LEAST_MEDIAN or self.p95 >= LEAST_P95

    def write(self, run: Path, projector: str) -> Path:
        row = {"median": self.median, "p95": self.p95, "response": list(self.response)}
        return write_json(json_path(run, StepKind.INDIRECT, projector), row)

    @classmethod
    def read(cls, run: Path, projector: str) -> Self | None:
        """None for a run that did not measure it."""
        path = json_path(run, StepKind.INDIRECT, projector)
        if not path.exists():
            return None
        row = read_json(path)
        return cls(float(row["median"]), float(row["p95"]), tuple(float(value) for value in row["response"]))


def read_indirect(run: Path, projectors: Sequence[str]) -> list[Indirect] | None:
    """Of each of these projectors; None where it was not measured, or is too little to count."""
    figures = [IndirectFigures.read(run, name) for name in projectors]
    if any(one is None for one in figures) or not any(one is not None and one.matters for one in figures):
        return None
    return [Indirect.read(run, name) for name in projectors]
