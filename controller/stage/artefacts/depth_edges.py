"""Files of the measurements with dots at depth edges."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
import numpy.typing as npt

from controller.core.arrays import load_arrays, save_arrays
from controller.optics.calibrate.metapixels.depth_edges import EdgeShares
from controller.optics.transport import LightTransport
from controller.optics.transport.edge_terms import EdgeTerm, term_arrays, terms_from, with_terms
from controller.stage.artefacts.geometry import projectors_of
from controller.stage.artefacts.kinds import StepKind
from controller.stage.artefacts.names import json_path, npz_path, read_json, write_json
from controller.stage.artefacts.projectors import mode_of

_PROJECTORS: Final = "projectors"


@dataclass(frozen=True, slots=True)
class EdgeDots:
    """``edge-dots-PROJECTOR.npz`` and ``.json``: the patterns that measure the depth edges of a projector.

    ``pattern`` (projector rows, columns) int16: in which photograph each pixel is lit, -1 for none
    ``spacing_px`` of the pixels lit together, in projector pixels; ``exposure_s``; ``photographs``: how many
    """

    pattern: npt.NDArray[np.int16]
    spacing_px: int
    exposure_s: float
    photographs: int

    @property
    def notes(self) -> dict[str, Any]:
        """Without the pattern."""
        return {"spacing_px": self.spacing_px, "exposure_s": self.exposure_s, "photographs": self.photographs}

    def write(self, run: Path, projector: str) -> list[Path]:
        arrays, notes = npz_path(run, StepKind.EDGE_DOTS, projector), json_path(run, StepKind.EDGE_DOTS, projector)
        save_arrays(arrays, {"pattern": self.pattern})
        return [arrays, write_json(notes, self.notes)]

    @classmethod
    def read(cls, run: Path, projector: str) -> Self:
        pattern = load_arrays(npz_path(run, StepKind.EDGE_DOTS, projector))["pattern"]
        row = read_json(json_path(run, StepKind.EDGE_DOTS, projector))
        return cls(pattern, int(row["spacing_px"]), float(row["exposure_s"]), int(row["photographs"]))


def write_edges(
    run: Path, projector: str, shares: EdgeShares, reason: npt.NDArray[Any], figures: Mapping[str, Any]
) -> list[Path]:
    """``edges-PROJECTOR.npz`` and ``.json``; ``reason`` (projector rows, columns): why a metapixel is bad."""
    arrays, notes = npz_path(run, StepKind.EDGES, projector), json_path(run, StepKind.EDGES, projector)
    parts: dict[str, npt.NDArray[Any]] = {
        "camera": shares.camera, "projector": shares.projector, "share": shares.share, "pattern": shares.pattern,
        "reason": reason,
    }  # fmt: skip
    save_arrays(arrays, parts)
    return [arrays, write_json(notes, figures)]


def read_edges(run: Path, projectors: Sequence[str]) -> tuple[EdgeShares, ...]:
    """The measurements at the depth edges of each projector."""
    found = []
    for name in projectors:
        arrays = load_arrays(npz_path(run, StepKind.EDGES, name))
        found.append(EdgeShares(arrays["camera"], arrays["projector"], arrays["share"], arrays["pattern"]))
    return tuple(found)


def write_terms(run: Path, projectors: Sequence[str], terms: Sequence[EdgeTerm]) -> Path:
    """``edge-terms.npz``: corrections of the light transport, one for each projector, in this order."""
    path = npz_path(run, StepKind.EDGE_TERMS)
    save_arrays(path, {**term_arrays(terms), _PROJECTORS: np.array(projectors)})
    return path


def edged(model: LightTransport, run: Path, projectors: Sequence[str]) -> LightTransport:
    """The run's transport: ``model``, corrected at depth edges if the automatic mode has measured them.

    ``projectors``: the model's, in its order; the run may have others, too.
    """
    path = npz_path(run, StepKind.EDGE_TERMS)
    if mode_of(run) != "auto" or not path.exists():
        return model
    arrays = load_arrays(path)
    # Runs from before the names were written have the order of the run's projectors.
    written = [str(name) for name in arrays[_PROJECTORS]] if _PROJECTORS in arrays else projectors_of(run)
    return with_terms(model, terms_from(arrays, model.sizes, [written.index(name) for name in projectors]))
