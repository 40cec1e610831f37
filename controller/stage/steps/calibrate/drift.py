"""The steps of a drift check: N + 2 photographs, compared with a prediction; and how far apart the outputs change."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np

from controller.core import channels
from controller.core.arrays import ByteImage, Float64, FloatImage
from controller.optics.calibrate.photometry.view_colours import LAMP_CHANGED
from controller.optics.calibrate.verify.drift import DriftPhotographs, find_drift
from controller.optics.capture.acquire import Shot
from controller.optics.capture.latency import blocks, seen_change
from controller.optics.capture.pattern_frames import device_frame, frame
from controller.optics.capture.patterns import Pattern, PatternKind
from controller.optics.capture.profile import CameraProfile, load_profile, true_exposure
from controller.optics.solve.scaling.dither import to_light
from controller.run.runner import Context, Step
from controller.run.step_id import StepId
from controller.stage.artefacts.calibrated import Calibrated, all_views
from controller.stage.artefacts.camera import inherit_camera
from controller.stage.artefacts.drift import write_drift
from controller.stage.artefacts.geometry import read_geometry_figures
from controller.stage.artefacts.kinds import StepKind
from controller.stage.artefacts.names import CAPTURES, json_path, write_json
from controller.stage.artefacts.photographs import DRIFT as TAKEN
from controller.stage.artefacts.photographs import PATTERN as PATTERN_NAME
from controller.stage.artefacts.photographs import SKEW, TakenPhotograph
from controller.stage.artefacts.projectors import IndirectFigures, Light
from controller.stage.artefacts.views import newest_view
from controller.stage.rig.rig import Rig
from controller.stage.steps import costs
from controller.stage.steps.capture.exposure import bracket
from controller.stage.steps.capture.photographs import Planned, take_all
from hal.notices import Level

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
        shown = partial(dict[str, ByteImage], {part.name: frames[part.name]})
        plan.append(Planned(PATTERN_NAME, shown, exposure_s, projector=part.name))
    lit = sum((part.white for part in calibration.projectors), start=calibration.black)
    white_s = exposure_for(lit, available, longest_s, profile)
    whites = {name: np.full_like(image, 255) for name, image in frames.items()}
    plan.append(Planned("white", lambda: whites, white_s))
    (black_s,) = bracket(white_s, (BLACK_TIMES,), available, longest_s)
    plan.append(Planned("black", dict, black_s))
    return take_all(rig, context, plan, into=TAKEN)


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


CHANGES, MOST_CHANGES = 8, 32
CHANGE_S: Final = 0.15
"""Exposure: longer than outputs are apart, and than it is uncertain when a camera opens."""
INSIDE: Final = 0.47
"""Of the exposure: a change that is farther from its middle may be outside."""
T95: Final = 2.365  # Student's t for CHANGES
SURE_S: Final = 0.002  # a larger uncertainty is a warning


def skew_step(rig: Rig, calibrated: Calibrated, first: str, longest_s: float) -> Step:
    """``skew.json``: how much later than the output ``first`` each one changes, after a drift check in the same run."""
    run = partial(_measure_skew, rig, calibrated, first, longest_s)
    return Step(StepId(StepKind.SKEW), run, title="Measuring how far apart the outputs change", weight=20.0)


def _measure_skew(rig: Rig, calibrated: Calibrated, first: str, longest_s: float, context: Context) -> Sequence[Path]:
    acquirer, profile, deadline = rig.acquirer, load_profile(context.folder), context.deadline
    lights = [Light.read(calibrated.folder, projector.name) for projector in rig.projectors]
    short = [value for value in acquirer.exposures_s() if value <= longest_s] or acquirer.exposures_s()[:1]
    exposure_s = min(short, key=lambda value: abs(value - CHANGE_S))
    brightest = np.nanpercentile(channels.largest(sum((one.white for one in lights), start=lights[0].black)), 99.9)
    level = min(1.0, FULL_SHARE / (float(brightest) * exposure_s))
    lit = {
        projector.name: projector.black() + np.array([np.argmin(abs(row - level)) for row in light.response], np.uint8)
        for projector, light in zip(rig.projectors, lights, strict=True)
    }
    whites = np.stack([blocks(light.white) for light in lights])
    caught: list[list[float]] = []
    release_s = acquirer.wait_s
    with contextlib.nullcontext() if rig.seat is None else rig.seat.only(deadline), ThreadPoolExecutor(1) as pool:
        plan = [Planned("black", dict, exposure_s), Planned("lit", lambda: lit, exposure_s)]
        paths = take_all(rig, context, plan, into=SKEW)
        stills = [blocks(taken.measured()) for taken in SKEW.read(context.folder)]
        for number in range(MOST_CHANGES):
            context.advance(len(caught) / CHANGES, "display and camera")
            deadline.sleep(acquirer.wait_s)  # until the picture before is whole
            shot = Shot(f"change-{number}", rig.on_outputs(lit if number % 2 else {}), exposure_s)
            shown_s = time.monotonic() + max(0.0, -release_s)
            shown = pool.submit(_show_at, shown_s, rig, shot, context)
            file, _ = acquirer.photograph(
                shot.name, exposure_s, context.folder / CAPTURES, shown_at_s=shown_s, deadline=deadline,
                wait_s=release_s,
            )  # fmt: skip
            shown.result()
            seen = blocks(TakenPhotograph(shot.name, file.path, exposure_s, profile=profile).measured())
            file.path.unlink()
            before, after = stills if number % 2 else stills[::-1]
            *shares, rise = seen_change(seen, before, after, whites)
            if max(abs(share - 0.5) for share in shares) + abs(rise) / 2 < INSIDE:
                caught.append(shares)
            if len(caught) == CHANGES:
                break
            release_s += exposure_s * (0.5 - float(np.clip(np.mean(shares), 0, 1)))
    rig.check_light(deadline=deadline)
    names = [projector.output for projector in rig.projectors]
    figures = _skew_figures(names, names.index(first), np.array(caught), true_exposure(profile, exposure_s))
    context.reporter.say(figures["sentence"], Level.INFO if figures["uncertain_s"] <= SURE_S else Level.WARNING)
    return [write_json(json_path(context.folder, StepKind.SKEW), figures), *paths]


def _show_at(at_s: float, rig: Rig, shot: Shot, context: Context) -> None:
    context.deadline.sleep(max(0.0, at_s - time.monotonic()))
    rig.acquirer.present(shot.frames, deadline=context.deadline)


def _skew_figures(names: Sequence[str], first: int, after: Float64, exposure_s: float) -> dict[str, Any]:
    """Seconds, uncertainties for 95 %. ``after`` (changes, outputs): shares of the exposure after each change."""
    if len(after) < CHANGES:
        sentence = f"Only {len(after)} of {MOST_CHANGES} photographs of {exposure_s:.2g} s show each output change."
        sentence += " Either the outputs are further apart, or it is too uncertain when the camera opens."
        return {"outputs": {}, "apart_s": None, "uncertain_s": exposure_s, "sentence": sentence}
    late_s = (after[:, [first]] - after) * exposure_s
    mean_s, uncertain_s = late_s.mean(axis=0), T95 * late_s.std(axis=0, ddof=1) / math.sqrt(len(after))
    rows = zip(names, mean_s.tolist(), uncertain_s.tolist(), strict=True)
    outputs = {name: {"late_s": late, "uncertain_s": uncertain} for name, late, uncertain in rows}
    apart_s, most_s = float(np.ptp(mean_s)), float(uncertain_s.max())
    each = ", ".join(f"{name} {1e3 * row['late_s']:+.1f}" for name, row in outputs.items())
    sentence = f"Seen by the camera, the outputs change {1e3 * apart_s:.1f} ± {1e3 * most_s:.1f} ms apart: {each} ms."
    return {"outputs": outputs, "apart_s": apart_s, "uncertain_s": most_s, "sentence": sentence}
