"""Photographs for experiments, on the opened stage."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import scipy.sparse as sp

from controller.artefacts.calibrated import Calibrated
from controller.artefacts.calibration import read_correspondence, read_phase_map
from controller.artefacts.geometry import read_geometry
from controller.artefacts.kinds import StepKind
from controller.artefacts.photographs import Developed, PhotographSet
from controller.artefacts.projectors import DotNotes, Light
from controller.calibrate.metapixels.from_dots import fit_dots
from controller.calibrate.metapixels.initial_estimate import initial_metapixels, modelled_correspondence, where_missing
from controller.calibrate.values import PhaseMap
from controller.capture.dots import DotPattern, dot_patterns
from controller.core.arrays import ByteImage, Float64, FloatImage
from controller.rig.rig import Rig
from controller.run.runner import Context, Step
from controller.steps.appearance.publishing import take_hdr
from controller.steps.appearance.solving import device_frames
from controller.steps.calibrate.dots import capture_step, read_dots
from controller.steps.capture.photographs import frames_digest
from controller.steps.modes import DotOptions
from controller.study.lab.subject import Dots, Shares

FAINTEST_SHARE = 0.01
"""A dot's light below this share of white is left out as noise of the photograph."""
DOTS = DotOptions("paper", None)


@dataclass(frozen=True, slots=True)
class RigPhotographer:
    """``subject.Photographer`` on real devices; ``name`` is the experiment's."""

    rig: Rig
    context: Context
    calibrated: Calibrated
    name: str
    longest_exposure_s: float
    used: list[Path] = field(default_factory=list)
    """The photographs of this run or an earlier one."""

    def photograph(self, name: str, frames: Sequence[FloatImage], *, white: float) -> FloatImage:
        return self.photograph_shown(name, device_frames(self.calibrated.calibration, frames), white=white)

    def photograph_shown(self, name: str, shown: Mapping[str, ByteImage], *, white: float) -> FloatImage:
        """As ``photograph``, of 8-bit frames by projector name as the displays get them."""
        presented = self.rig.display.show(self.rig.on_outputs(shown), deadline=self.context.deadline.within(20))
        taken, merged = take_hdr(
            self.rig, self.context, "study", f"{self.name}-{name}", white, self.longest_exposure_s,
            shown_at_s=presented.at_s, of={"frames": frames_digest(shown)},
        )  # fmt: skip
        self.used.extend(one.path for one in taken)
        # Too bright for the shortest exposure is at least its full scale; black would be the one wrong answer.
        return np.asarray(np.nan_to_num(merged, nan=1 / min(one.exposure_s for one in taken)), np.float32)

    def dots(self, n: int) -> Dots:
        folder, name = self.context.folder, self.calibrated.projectors[n]
        spacing = DotNotes.read(folder, StepKind.STUDY_DOTS, name).spacing_px
        rows, columns = self.calibrated.calibration.projectors[n].metapixels.valid.shape
        patterns = dot_patterns((columns, rows), spacing)
        taken = read_dots(folder, PhotographSet(StepKind.STUDY_DOTS, name), patterns)
        light = Light.read(folder, name)
        captures = Developed(taken, {"black": light.black})
        phase_map, _ = read_phase_map(folder, name)
        assert phase_map is not None
        white = np.nan_to_num(light.white)
        shares = dots_as_shares(captures, white, phase_map, patterns, (rows, columns))
        model = initial_metapixels(modelled_correspondence(read_geometry(folder, [name]), 0), (columns, rows))
        start = where_missing(initial_metapixels(read_correspondence(folder, name), (columns, rows)), model)
        fitted, _ = fit_dots(captures, light.white, start, spacing, fallback=model)
        return Dots(shares, fitted)


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


def dot_steps(rig: Rig, *, longest_exposure_s: float) -> list[Step]:
    """Photograph the dots of each projector, for ``Photographer.dots``; the calibration itself stays the fast one."""
    return [
        capture_step(rig, projector, DOTS, longest_exposure_s, kind=StepKind.STUDY_DOTS) for projector in rig.projectors
    ]
