"""Grades a run's calibration, and shows where it is bad and why."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np

from controller.bundle.describe import png
from controller.core.arrays import ByteImage, FloatImage, Mask
from controller.core.errors import TroubleCode
from controller.optics.calibrate.photometry.glare import veiled, veiling_glare
from controller.optics.calibrate.photometry.reflectance import gloss_strength, glossy
from controller.optics.calibrate.photometry.surface_spread import spreading, typical_spread
from controller.optics.calibrate.values import Calibration, ProjectorCalibration
from controller.optics.calibrate.verify.error_attribution import (
    ErrorAttribution,
    attribute_error,
    attribution_picture,
    ranked,
)
from controller.optics.calibrate.verify.error_causes import WORDS, ErrorCause
from controller.optics.calibrate.verify.grade import Verification, verify
from controller.optics.capture.pattern_frames import device_frame, frame
from controller.optics.capture.patterns import Pattern
from controller.optics.capture.profile import CameraNoise
from controller.optics.solve.scaling.dither import to_light
from controller.run.background import side_by_side
from controller.run.runner import Context, Step
from controller.run.step_id import StepId
from controller.stage.artefacts.calibrated import Calibrated
from controller.stage.artefacts.camera import Exposures
from controller.stage.artefacts.geometry import known_geometry
from controller.stage.artefacts.grade import LIGHT_SHARE, ErrorMaps, in_rows, write_grade
from controller.stage.artefacts.kinds import StepKind
from controller.stage.artefacts.photographs import PATTERN, VERIFICATION, TakenPhotograph, codes_of, noise_of
from controller.stage.artefacts.projectors import IndirectFigures, drawn_by
from controller.stage.rig.rig import Rig
from controller.stage.steps import costs
from controller.stage.steps.appearance.solving import random_pattern
from controller.stage.steps.calibrate.drift import shown_frames
from controller.stage.steps.capture.photographs import Planned, take_all
from controller.stage.steps.troubles import tell

NOISE: Final = WORDS[ErrorCause.DARK][0]
JUDGING_BYTES: Final = 300
"""A camera pixel, while one projector is judged (decision 3)."""


def verify_step(calibrated: Calibrated, after: Sequence[StepId], scale: float) -> Step:
    """Predict each projector's random pattern and compare with its photograph."""
    return Step(
        StepId(StepKind.VERIFY),
        partial(_verify, calibrated),
        after=tuple(after),
        title="Grading the calibration",
        weight=costs.VERIFY_S * scale,
    )


def verification_photographs_step(rig: Rig, calibrated: Calibrated, after: Sequence[StepId]) -> Step:
    """Photograph the random pattern again, for a corrected calibration."""
    scale = costs.scale(projector.size_px for projector in rig.projectors)
    return Step(
        StepId(StepKind.VERIFICATION_PHOTOGRAPHS),
        partial(_photograph, rig, calibrated),
        after=tuple(after),
        title="Photographing the pattern for the grade",
        weight=costs.shot_s(scale) * len(rig.projectors),
    )


def _photograph(rig: Rig, calibrated: Calibrated, context: Context) -> Sequence[Path]:
    exposures = Exposures.read(context.folder)
    plan = []
    for projector in rig.projectors:
        image = shown_frames(calibrated, random_pattern(projector.size_px))[projector.name]
        shown = partial(_one, projector.name, image)
        plan.append(Planned(PATTERN, shown, exposures[projector.name].base_s, projector=projector.name))
    return take_all(rig, context, plan, into=VERIFICATION)


def _one(name: str, image: ByteImage) -> dict[str, ByteImage]:
    return {name: image}


def _taken(folder: Path, projector: str, pattern: Pattern) -> TakenPhotograph:
    if VERIFICATION.index(folder).exists():
        return VERIFICATION.by_projector(folder)[projector]
    return codes_of(projector).by_name(folder)[pattern.name]


def _verify(calibrated: Calibrated, context: Context) -> Sequence[Path]:
    calibrated.read_all()
    calibration = calibrated.calibration
    figures, pictures = {}, []
    maps: dict[str, ErrorMaps] = {}
    # one of several views may not see a projector
    seen = [n for n, part in enumerate(calibration.projectors) if part.metapixels.valid.any()]
    judged = side_by_side(
        lambda at: _judged(calibrated, context.folder, seen[at]),
        len(seen),
        bytes_each=JUDGING_BYTES * calibration.object_mask.size,
    )
    for n, one in zip(seen, judged, strict=True):
        name = calibration.projectors[n].name
        context.advance((n + 1) / (len(calibration.projectors) + 1), name)
        figures[name], maps[name], picture = one
        pictures.append(picture)
    geometry = known_geometry(context.folder, calibrated.projectors)
    troubles = {
        TroubleCode.GLOSS: glossy(gloss_strength(calibration, geometry)),
        TroubleCode.CAMERA_GLARE: veiled(veiling_glare(calibration, geometry)),
        TroubleCode.SURFACE_SPREAD: spreading(typical_spread([part.spread for part in calibration.projectors])),
    }
    said = tell(context, StepId(StepKind.VERIFY), troubles)
    return [*write_grade(context.folder, figures, maps, png(in_rows(pictures))), said]


def _judged(calibrated: Calibrated, folder: Path, n: int) -> tuple[dict[str, object], ErrorMaps, ByteImage]:
    """Figures of projector ``n``, its errors, and a picture of their causes."""
    calibration, transport = calibrated.calibration, calibrated.transport
    part = calibration.projectors[n]
    rows, columns = part.metapixels.valid.shape
    pattern = random_pattern((columns, rows))
    shown = _shown(folder, part, pattern, (columns, rows))
    light, indirect = transport.forward_part(n, shown), calibrated.indirect_of(n, shown)
    taken = _taken(folder, part.name, pattern)
    photograph = taken.read()
    seen = photograph.measured() / np.float32(taken.exposure_s)
    variance = noise_of(taken).variance(seen, interpolated=photograph.colours is not None)
    expected = light + calibration.black if indirect is None else light + indirect + calibration.black
    # a camera's noise that was not measured may be less than that of others
    known = taken.profile is not None and taken.profile.noise != CameraNoise()
    found = verify(expected, seen, calibration.black, transport.lit[n], variance if known else None)
    why = attribute_error(transport, calibration, n, shown, seen, variance=variance, indirect=indirect)
    share = _light_share(calibration, n, transport.lit[n])
    figures = _figures(found, why) | {LIGHT_SHARE: share} | _indirect_figures(folder, part.name)
    return figures, ErrorMaps(found.error_map, why.labels), attribution_picture(why, calibration, part.name)


def _light_share(calibration: Calibration, n: int, lit: Mask) -> float:
    whites = [part.white[lit] for part in calibration.projectors]
    whole = np.add.reduce(whites)
    return float(np.linalg.norm(whites[n]) / np.linalg.norm(whole))


def _shown(folder: Path, part: ProjectorCalibration, pattern: Pattern, size_px: tuple[int, int]) -> FloatImage:
    """The light of the pattern: its device values may have been chosen by a response that was corrected since."""
    meant = frame(pattern, size_px)
    again = VERIFICATION.index(folder).exists()
    if part.radiometry.segment == 0 and (part.indirect is None or again):
        return meant
    response = part.radiometry.response if again else drawn_by(folder, part.name)
    return to_light(device_frame(pattern, size_px, response), part.radiometry)


def _indirect_figures(folder: Path, projector: str) -> dict[str, object]:
    figures = IndirectFigures.read(folder, projector)
    return {} if figures is None else {"indirect": {"median": figures.median, "p95": figures.p95}}


def _figures(found: Verification, why: ErrorAttribution) -> dict[str, object]:
    return {
        "relative_rms": found.relative_rms,
        "without_gain_rms": found.without_gain_rms,
        "gain": found.gain,
        "grade": found.grade.value,
        "noise_rms": found.noise_rms,
        # noise that was taken off is the reason for nothing
        "reasons": sorted(ranked(why), key=lambda row: found.noise_rms > 0 and row["reason"] == NOISE),
    }
