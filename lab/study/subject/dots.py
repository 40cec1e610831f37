"""A projector's pixels as photographs of dots show them: photographed and worked out once for all experiments."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np
import scipy.sparse as sp

from controller.core.arrays import Float64, FloatImage, load_arrays, save_arrays
from controller.optics.calibrate.metapixels.from_dots import (
    fit_dots,
    initial_metapixels,
    modelled_correspondence,
    where_missing,
)
from controller.optics.calibrate.values import Metapixels, PhaseMap
from controller.optics.capture.patterns import DotPattern, dot_frame, dot_patterns
from controller.run.runner import Context, Step
from controller.run.step_id import StepId
from controller.stage.artefacts.calibration import read_correspondence, read_phase_map
from controller.stage.artefacts.camera import Exposures
from controller.stage.artefacts.geometry import read_geometry
from controller.stage.artefacts.kinds import StepKind, of_projectors
from controller.stage.artefacts.names import npz_path
from controller.stage.artefacts.photographs import Developed, PhotographSet, TakenPhotograph
from controller.stage.artefacts.projectors import DotNotes, Light
from controller.stage.rig.rig import Rig, RigProjector
from controller.stage.steps import costs
from controller.stage.steps.calibrate.dots import capture_step, read_dots
from controller.stage.steps.capture.dots import check_disk, planned, read_batches, take_in_batches
from controller.stage.steps.modes import DotOptions
from lab.study.subject.subject import Dots, Shares

FAINTEST_SHARE = 0.01
"""A dot's light below this share of white is left out as noise of the photograph."""
DOTS: Final = DotOptions("paper", None)
PLAIN: Final = "study-plain-dots"
"""Kind of the photographs of dots at the exposure of white."""


def dot_steps(rig: Rig, *, longest_exposure_s: float) -> list[Step]:
    """Photograph and evaluate each projector's dots, for ``read_study_dots``; the calibration stays the fast one."""
    taken = [
        capture_step(rig, projector, DOTS, longest_exposure_s, kind=StepKind.STUDY_DOTS) for projector in rig.projectors
    ]
    return [*taken, *(_evaluation(projector) for projector in rig.projectors)]


def _evaluation(projector: RigProjector) -> Step:
    own = of_projectors([projector.name], StepKind.RADIOMETRY, StepKind.PIXELS, StepKind.STUDY_DOTS)
    rows, columns = projector.size_px[1], projector.size_px[0]
    return Step(
        StepId(StepKind.STUDY_SHARES, projector.name),
        partial(_evaluate, projector.name, (rows, columns)),
        after=(StepId(StepKind.GEOMETRY), *own),
        title=f"Evaluating the dots of {projector.name}",
        weight=costs.dots_s(costs.scale([projector.size_px]), len(dot_patterns(projector.size_px))),
    )


def _evaluate(name: str, size: tuple[int, int], context: Context) -> Sequence[Path]:
    spacing = DotNotes.read(context.folder, StepKind.STUDY_DOTS, name).spacing_px
    taken = read_dots(context.folder, PhotographSet(StepKind.STUDY_DOTS, name), dot_patterns(size[::-1], spacing))
    return [write_study_dots(context.folder, name, _dots(context, name, size, spacing, taken))]


def _dots(
    context: Context, name: str, size: tuple[int, int], spacing: int, taken: Mapping[str, TakenPhotograph]
) -> Dots:
    """A projector's dots from their photographs, by the pattern's name; ``size`` (rows, columns)."""
    folder, (rows, columns) = context.folder, size
    patterns = dot_patterns((columns, rows), spacing)
    light = Light.read(folder, name)
    captures = Developed(taken, {"black": light.black})
    phase_map, _ = read_phase_map(folder, name)
    assert phase_map is not None
    shares = dots_as_shares(captures, np.nan_to_num(light.white), phase_map, patterns, size)
    context.advance(0.4, "dots")
    model = initial_metapixels(modelled_correspondence(read_geometry(folder, [name]), 0), (columns, rows))
    start = where_missing(initial_metapixels(read_correspondence(folder, name), (columns, rows)), model)
    fitted, _ = fit_dots(captures, light.white, start, spacing, fallback=model)
    return Dots(shares, fitted)


def plain_dots(rig: Rig, context: Context, name: str) -> Dots:
    """A projector's dots, photographed now, each once, at the exposure of white: as far apart as those of the steps."""
    folder, into = context.folder, PhotographSet(PLAIN, name)
    (projector,) = (one for one in rig.projectors if one.name == name)
    columns, rows = projector.size_px
    spacing = DotNotes.read(folder, StepKind.STUDY_DOTS, name).spacing_px
    patterns = dot_patterns((columns, rows), spacing)
    check_disk(folder, into, len(patterns))
    exposure_s = Exposures.read(folder)[name].base_s
    plan = [
        planned(projector, pattern.name, partial(dot_frame, pattern, projector.size_px), exposure_s)
        for pattern in patterns
    ]
    take_in_batches(rig, context, plan, into=into)
    taken = {one.name: one for one in read_batches(folder, into, len(patterns))}
    return _dots(context, name, (rows, columns), spacing, taken)


def write_study_dots(folder: Path, name: str, dots: Dots) -> Path:
    """Keep a projector's dots in a run's folder, for ``read_study_dots``."""
    path, shares, fitted = npz_path(folder, StepKind.STUDY_SHARES, name), dots.shares, dots.metapixels
    save_arrays(
        path,
        {
            "share": shares.data, "column": shares.indices, "row_starts": shares.indptr,
            "shape": np.array(shares.shape, np.int64),
            "centre_px": fitted.centre_px, "covariance_px2": fitted.covariance_px2, "valid": fitted.valid,
        },
    )  # fmt: skip
    return path


def read_study_dots(folder: Path, name: str) -> Dots:
    """A projector's dots as the steps of ``dot_steps`` left them in a run's folder."""
    found = load_arrays(npz_path(folder, StepKind.STUDY_SHARES, name))
    rows, columns = (int(side) for side in found["shape"])
    shares = sp.csr_matrix((found["share"], found["column"], found["row_starts"]), shape=(rows, columns))
    return Dots(shares, Metapixels(found["centre_px"], found["covariance_px2"], found["valid"]))


def dots_as_shares(
    captures: Mapping[str, FloatImage],
    white: FloatImage,
    phase_map: PhaseMap,
    patterns: Sequence[DotPattern],
    size: tuple[int, int],
) -> Shares:
    """Light transport as dots show it, with no model: what each camera pixel sees of the dot nearest to where it looks.

    Parameters
    ----------
    captures : "black" and every pattern, in one unit; NaN where saturated
    white : (camera rows, columns, 3) less black, in that unit
    size : (rows, columns) of the projector

    Returns
    -------
    (camera pixels, projector pixels): light of the dot over white light, in [0, 1]; nothing farther from the dot than
    half of the dots' distance
    """
    rows, columns = size
    black = captures["black"].sum(axis=2)
    whole = white.sum(axis=2)
    x, y = np.moveaxis(phase_map.projector_px.astype(np.float64), -1, 0)
    looks = np.isfinite(x) & np.isfinite(y) & (whole > 0)
    at = np.flatnonzero(looks)
    x, y, whole, dark = x.ravel()[at], y.ravel()[at], whole.ravel()[at], black.ravel()[at]
    parts: list[tuple[Float64, Float64, Float64]] = []
    for pattern in patterns:
        r = pattern.spacing_px
        column = np.round((x - pattern.column) / r) * r + pattern.column
        row = np.round((y - pattern.row) / r) * r + pattern.row
        seen = np.nan_to_num(captures[pattern.name].sum(axis=2).ravel()[at] - dark, nan=0.0)
        share = np.clip(seen / whole, 0, 1)
        ok = (share > FAINTEST_SHARE) & (column >= 0) & (row >= 0) & (column < columns) & (row < rows)
        parts.append((at[ok], (row * columns + column)[ok], share[ok]))
    camera, projector, share = (np.concatenate(part) for part in zip(*parts, strict=True))
    shape = (looks.size, rows * columns)
    return sp.csr_matrix((share, (camera.astype(np.int64), projector.astype(np.int64))), shape=shape)
