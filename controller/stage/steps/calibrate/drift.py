"""The steps of a drift check: N + 2 photographs, compared with the calibration's prediction."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from controller.core import channels
from controller.core.arrays import ByteImage, FloatImage
from controller.optics.calibrate.photometry.view_colours import LAMP_CHANGED
from controller.optics.calibrate.verify.drift import DriftPhotographs, find_drift
from controller.optics.capture.pattern_frames import device_frame, frame
from controller.optics.capture.patterns import Pattern, PatternKind
from controller.optics.capture.profile import CameraProfile, load_profile
from controller.optics.solve.scaling.dither import to_light
from controller.run.runner import Context, Step
from controller.run.step_id import StepId
from controller.stage.artefacts.calibrated import Calibrated, all_views
from controller.stage.artefacts.camera import inherit_camera
from controller.stage.artefacts.drift import write_drift
from controller.stage.artefacts.geometry import read_geometry_figures
from controller.stage.artefacts.kinds import StepKind
from controller.stage.artefacts.photographs import DRIFT as TAKEN
from controller.stage.artefacts.photographs import PATTERN as PATTERN_NAME
from controller.stage.artefacts.projectors import IndirectFigures, Light
from controller.stage.artefacts.views import newest_view
from controller.stage.rig.rig import Rig
from controller.stage.steps import costs
from controller.stage.steps.capture.exposure import bracket
from controller.stage.steps.capture.photographs import Planned, take_all

PATTERN = Pattern("drift", PatternKind.RANDOM, seed=17)
"""Not the pattern on which a calibration is graded."""
FULL_SHARE = 0.7
"""Share of full scale for the brightest pixels: room for additional light."""
NEAR = 0.2, 1.3
"""Of the wanted exposure, those that a known one may have: darker pictures have more noise, brighter ones clip."""
BLACK_TIMES = 8.0
"""The black photograph's exposure over that of white."""


def drift_steps(rig: Rig, calibrated: Calibrated, *, longest_exposure_s: float) -> list[Step]:
    """Photograph, then judge; the result is ``drift.json`` in the run's folder (``artefacts.drift``)."""
    scale = costs.scale(projector.size_px for projector in rig.projectors)
    inputs = {"calibration": calibrated.folder.name, "longest_exposure_s": repr(longest_exposure_s)}
    return [
        Step(
            StepId(StepKind.DRIFT_PHOTOGRAPHS),
            partial(_photograph, rig, calibrated, longest_exposure_s),
            inputs=inputs,
            title="Taking the photographs of the drift check",
            weight=costs.shot_s(scale) * (len(rig.projectors) + 2),
        ),
        Step(
            StepId(StepKind.DRIFT),
            partial(_judge, calibrated),
            inputs=inputs,
            after=(StepId(StepKind.DRIFT_PHOTOGRAPHS),),
            title="Comparing with the calibration",
            weight=costs.VERIFY_S * scale * 3,
        ),
    ]


def exposure_for(
    light: FloatImage, available_s: Sequence[float], longest_s: float, profile: CameraProfile | None = None
) -> float:
    """The longest exposure that keeps an expected picture (full scales per second) below full scale.

    Where the camera's times are wrong, it is the nearest one whose true time ``profile`` has, if one is ``NEAR``: with
    another, the lamp would seem brighter or darker than it is.
    """
    brightest = float(np.percentile(channels.largest(light), 99.9))
    wanted_s = min(FULL_SHARE / max(brightest, 1e-9), longest_s)
    found = max((value for value in available_s if value <= wanted_s), default=min(available_s))
    if profile is None or profile.knows(found):
        return found
    low, high = (factor * wanted_s for factor in NEAR)
    known = [value for value in available_s if low <= value <= min(high, longest_s) and profile.knows(value)]
    return min(known, key=lambda value: abs(math.log(value / wanted_s)), default=found)


def shown_frames(calibrated: Calibrated, pattern: Pattern) -> dict[str, ByteImage]:
    """``pattern`` for each projector, in device values, by its measured response."""
    found = {}
    for part in calibrated.calibration.projectors:
        rows, columns = part.metapixels.valid.shape
        found[part.name] = device_frame(pattern, (columns, rows), part.radiometry.response)
    return found


def _photograph(rig: Rig, calibrated: Calibrated, longest_s: float, context: Context) -> Sequence[Path]:
    inherit_camera(calibrated.folder, context.folder)
    calibration, available, profile = calibrated.calibration, rig.acquirer.exposures_s(), load_profile(context.folder)
    frames = shown_frames(calibrated, PATTERN)
    plan = []
    for part in calibration.projectors:
        exposure_s = exposure_for(part.white + calibration.black, available, longest_s, profile)
        shown = partial(_one, part.name, frames[part.name])
        plan.append(Planned(PATTERN_NAME, shown, exposure_s, projector=part.name))
    lit = sum((part.white for part in calibration.projectors), start=calibration.black)
    white_s = exposure_for(lit, available, longest_s, profile)
    whites = {name: np.full_like(image, 255) for name, image in frames.items()}
    plan.append(Planned("white", lambda: whites, white_s))
    (black_s,) = bracket(white_s, (BLACK_TIMES,), available, longest_s)
    plan.append(Planned("black", dict, black_s))
    return take_all(rig, context, plan, into=TAKEN)


def _one(name: str, image: ByteImage) -> dict[str, ByteImage]:
    return {name: image}


def _judge(calibrated: Calibrated, context: Context) -> Sequence[Path]:
    calibration = calibrated.calibration
    taken = TAKEN.read(context.folder)
    alone = TAKEN.by_projector(context.folder)
    together = {photograph.name: photograph for photograph in taken if photograph.projector is None}
    frames = linear_frames(calibrated, PATTERN)
    patterns, white = {}, together["white"].per_second()
    for n, (part, shown) in enumerate(zip(calibration.projectors, frames, strict=True)):
        patterns[part.name] = alone[part.name].per_second()
        # the transport predicts direct light, so that is what is compared
        if part.indirect is not None and (indirect := calibrated.indirect_of(n, shown)) is not None:
            patterns[part.name] = patterns[part.name] - indirect
            white = white - part.indirect
    seen = DriftPhotographs(black=together["black"].per_second(), white=white, patterns=patterns)
    context.advance(0.2)
    drift = find_drift(calibrated.transport, calibration, frames, seen)
    known = {name: IndirectFigures.read(calibrated.folder, name) for name in calibrated.projectors}
    flicker = {name: figures.flicker for name, figures in known.items() if figures is not None}
    drift = replace(drift, projectors=tuple(one.flickering(flicker.get(one.name, 0.0)) for one in drift.projectors))
    return [write_drift(context.folder, drift, calibration=calibrated.folder.name, photographs=len(taken))]


ALIKE: Final = 0.9
"""Correlation from which two pictures show the stage from the same place."""
CLEARLY: Final = 0.1
"""By so much better another view's picture has to fit than the view's own."""
SMALL_PX: Final = 96


def swapped_views(now: Mapping[str, Path], before: Mapping[str, Path]) -> list[str]:
    """A sentence for each pair of views whose cameras seem swapped, or whose cameras are turned upside down.

    ``now``: of drift checks or calibrations, by name, of the only camera nothing is said; ``before``: of calibrations
    """
    if len(now) < 2:
        return []
    seen, known = ({name: _white_of(folder) for name, folder in of.items()} for of in (now, before))
    found = []
    for name in seen:
        own = _alike(seen[name], known[name]) if name in known else -1.0
        if name in known and _alike(seen[name][::-1, ::-1], known[name]) > max(ALIKE, own + CLEARLY):
            found.append(f"The camera of view {name} is upside down: its picture is turned by 180 degrees.")
        found += [
            f"The cameras of the views {name} and {other} are swapped: each sees what the other one saw."
            for other in seen
            if name < other and other in known and name in known
            and _alike(seen[name], known[other]) > max(ALIKE, own + CLEARLY)
            and _alike(seen[other], known[name]) > max(ALIKE, _alike(seen[other], known[other]) + CLEARLY)
        ]  # fmt: skip
    return found


def changed_lamps(run: Path, projectors: Sequence[str]) -> list[str]:
    """A sentence for each projector that is weaker now than when some views of a calibration were photographed."""
    if newest_view(run) is None:
        return []
    calibrated, found = all_views(run, projectors), []
    for name, lamps in zip(projectors, calibrated.lamps.T, strict=True):
        if views := [view for view, lamp in zip(calibrated.names, lamps, strict=True) if lamp < 1 - LAMP_CHANGED]:
            found.append(
                f"Compared with the others, projector {name} has {1 - lamps.min():.0%} less light than when view"
                f" {' and '.join(views)} was photographed. Appearances are solved for the light that it has now."
            )
    return found


def _white_of(folder: Path) -> FloatImage:
    """The stage at white, small (rows, columns): as the drift check photographed it, or as the calibration knows it."""
    names = read_geometry_figures(folder).get("projectors")
    if names is None:
        together = (one for one in TAKEN.read(folder) if one.name == "white" and one.projector is None)
        return _small(next(together).per_second())
    whites = (_small(Light.read(folder, name).white) for name in names)
    return sum(whites, start=np.zeros((SMALL_PX, SMALL_PX), np.float32))


def _small(white: FloatImage) -> FloatImage:
    grey = np.asarray(np.nan_to_num(white).mean(axis=2), np.float32)
    return np.asarray(cv2.resize(grey, (SMALL_PX, SMALL_PX), interpolation=cv2.INTER_AREA))


def _alike(one: FloatImage, other: FloatImage) -> float:
    """The correlation of two pictures; 0 where one is even."""
    return float(np.nan_to_num(np.corrcoef(one.ravel(), other.ravel())[0, 1]))


def linear_frames(calibrated: Calibrated, pattern: Pattern) -> list[FloatImage]:
    """The light of ``shown_frames``: (rows, columns, 3), linear, for each projector."""
    found = []
    for part, shown in zip(calibrated.calibration.projectors, shown_frames(calibrated, pattern).values(), strict=True):
        rows, columns = part.metapixels.valid.shape
        # with a white segment colours are not shown as drawn
        drawn = part.radiometry.segment == 0
        found.append(frame(pattern, (columns, rows)) if drawn else to_light(shown, part.radiometry))
    return found
