"""The steps that repeat a part of a calibration, and keep the rest of the last one.

A quick recalibration finds what has changed. A projector that rotated about its lens, or whose light changed, is
corrected without codes: its white image is photographed again, its correspondences and metapixels are moved. After
other movements it gets new codes. If camera or object moved, everything is measured again.

One projector can also be calibrated again. The others' photographs are not taken again, so they can't show whether
camera or object has moved. The pattern of the grade is therefore photographed on every projector, one photograph each:
if another projector is now predicted badly, the old calibration stays in use.
"""

from __future__ import annotations

import dataclasses
import enum
import os
import shutil
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from controller.core.arrays import ByteImage
from controller.core.errors import CalibrationError
from controller.optics.calibrate.verify.drift import (
    Drift,
    ProjectorDrift,
    update_positions,
    update_radiometry,
    update_white,
)
from controller.optics.calibrate.verify.drift_report import advice, sentences
from controller.run.journal import Journal
from controller.run.runner import Context, Step
from controller.run.step_id import StepId
from controller.stage.artefacts.calibrated import Calibrated
from controller.stage.artefacts.calibration import merged, read_black
from controller.stage.artefacts.camera import Exposures
from controller.stage.artefacts.drift import read_drift
from controller.stage.artefacts.kinds import StepKind, white_of
from controller.stage.artefacts.photographs import DRIFT, white_again_of
from controller.stage.artefacts.projectors import Indirect, Light, Pixels, mode_of, read_white_gain
from controller.stage.rig.rig import Rig, RigProjector
from controller.stage.steps import costs
from controller.stage.steps.calibrate.drift import drift_steps
from controller.stage.steps.calibrate.grade import verification_photographs_step, verify_step
from controller.stage.steps.capture.patterns import capture_steps
from controller.stage.steps.capture.photographs import Planned, take_all
from hal.notices import Level


class Reuse(enum.Enum):
    """How a quick recalibration treats a step of the full one."""

    RUN = "run"
    KEEP = "copy_from_last"
    CORRECT = "correct"


def quick_steps(
    rig: Rig, run: Path, last: Calibrated, full: Sequence[Step], *, longest_exposure_s: float
) -> list[Step]:
    """From the drift check to the grade.

    ``last``: the calibration to update; ``full``: the steps of a full calibration, in the order and
    with the options of ``last``; each is run, kept or corrected once the drift is known
    """
    scale = costs.scale(projector.size_px for projector in rig.projectors)
    steps = drift_steps(rig, last, longest_exposure_s=longest_exposure_s)
    steps.append(
        Step(
            StepId(StepKind.PLAN),
            _report,
            after=(StepId(StepKind.DRIFT),),
            title="Choosing what to repeat",
            weight=0.01,
            always=True,
        )
    )
    steps += [chosen(rig, last, step) for step in full]
    now = Calibrated(run, last.projectors)
    done = [step.id for step in full]
    steps.append(verification_photographs_step(rig, now, done))
    steps.append(verify_step(now, [*done, steps[-1].id], scale))
    return steps


def _report(context: Context) -> Sequence[Path]:
    """Report the drift. Raises CalibrationError("projector-dark") if no calibration would help."""
    drift = read_drift(context.folder)
    found = sentences(drift)
    for sentence in found[:-1] or found:
        context.reporter.say(sentence)
    if advice(drift) == "look":
        for taken in DRIFT.read(context.folder):
            taken.path.unlink(missing_ok=True)  # the same command checks again after the projector is repaired
        raise CalibrationError("projector-dark", what=found[0], remedy=found[-1])
    if advice(drift) == "full":
        context.reporter.say("Everything is measured again: the last calibration is no longer valid.", Level.WARNING)
    context.journal.record("drift", " ".join(found))
    return ()


def chosen(rig: Rig, last: Calibrated, step: Step) -> Step:
    """The step, run, kept or corrected depending on the drift."""

    def run(context: Context) -> Sequence[Path]:
        way = reuse_of(step.id, read_drift(context.folder), mode_of(last.folder))
        if way is Reuse.RUN:
            return step.run(context)
        kept = copy_from_last(last.folder, step.id, context)
        if kept is None:  # the last calibration had no such step
            return step.run(context)
        return kept if way is Reuse.KEEP else _correct(rig, last, step.id, kept, context)

    after = (*step.after, StepId(StepKind.DRIFT))
    return dataclasses.replace(step, run=run, after=after, weight=0.1 * step.weight, unsteady=False)


def reuse_of(step: StepId, drift: Drift, mode: str = "fast") -> Reuse:
    """How to treat a step of the full calibration. ``mode``: how the last one measured its metapixels."""
    if advice(drift) == "full":
        return Reuse.RUN
    if drift.nothing:
        return Reuse.KEEP
    if step.kind == StepKind.BLACK:
        return Reuse.RUN
    if step.kind in (StepKind.SHAPE, StepKind.GEOMETRY):
        return Reuse.RUN if drift.moved else Reuse.KEEP
    for moved in drift.projectors:
        if step.projector == moved.name:
            way = _reuse_of(step.kind, moved, mode)
            # white is photographed again by the step of the light
            return Reuse.KEEP if way is Reuse.CORRECT and step == white_of(moved.name) else way
    return Reuse.KEEP


def _reuse_of(kind: str, one: ProjectorDrift, mode: str) -> Reuse:
    if not one.known or (one.moved and not (one.turned_only and mode == "fast")):
        return Reuse.RUN
    if kind == StepKind.RADIOMETRY:
        return Reuse.CORRECT  # black has been photographed again
    if kind == StepKind.LIGHT:
        return Reuse.CORRECT if one.moved or one.dimmed else Reuse.KEEP
    if kind == StepKind.INDIRECT:
        return Reuse.CORRECT if one.moved or one.dimmed else Reuse.KEEP
    return Reuse.CORRECT if kind == StepKind.PIXELS and one.moved else Reuse.KEEP


def copy_from_last(last: Path, step: StepId, context: Context) -> list[Path] | None:
    """The artefacts of the last calibration's step, in this run's folder; None if it had no such step."""
    with Journal(last) as journal:
        artefacts = journal.latest(step)
    if artefacts is None:
        # earlier versions photographed white in the step of the light, to whose artefacts it belongs, too
        return [] if step.projector is not None and step == white_of(step.projector) else None
    paths = []
    for artefact in artefacts:
        path = context.folder / artefact.path.relative_to(last.resolve())
        path.parent.mkdir(parents=True, exist_ok=True)
        path.unlink(missing_ok=True)
        try:
            os.link(artefact.path, path)  # all writers replace files and never change them
        except OSError:
            shutil.copy2(artefact.path, path)
        paths.append(path)
    return paths


def _correct(rig: Rig, last: Calibrated, step: StepId, kept: list[Path], context: Context) -> Sequence[Path]:
    name = step.projector
    assert name is not None
    one = next(one for one in read_drift(context.folder).projectors if one.name == name)
    if step.kind == StepKind.LIGHT:
        projector = next(projector for projector in rig.projectors if projector.name == name)
        return [*kept, *_photograph_white(rig, projector, context)]
    if step.kind == StepKind.PIXELS:
        _shift_pixels(context.folder, name, one)
    elif step.kind == StepKind.INDIRECT:
        found = Indirect.read(context.folder, name)
        mixing = update_radiometry(found.radiometry, one.gain).mixing if one.dimmed else found.mixing
        # its stripes lay elsewhere or were brighter; those of the others are enough. Its white is photographed again.
        dataclasses.replace(found, mixing=mixing, stripes=None, white_gain=None).write(context.folder, name)
    else:
        _correct_light(last.folder, context.folder, one)
    return kept


def _shift_pixels(folder: Path, name: str, one: ProjectorDrift) -> None:
    pixels = Pixels.read(folder, name)
    dataclasses.replace(pixels, **update_positions(pixels.arrays(), one.motion.matrix)).write(folder, name)


def _correct_light(last: Path, folder: Path, one: ProjectorDrift) -> None:
    name = one.name
    light = Light.read(folder, name)
    light = dataclasses.replace(light, black=read_black(folder))
    if one.moved or one.dimmed:
        gain, again = read_white_gain(last, name), merged(white_again_of(name).read(folder))
        before = light.white if gain is None else light.white * gain
        seen = np.maximum(again.radiance - light.black, 0).astype(np.float32)
        light = dataclasses.replace(light, white=update_white(before, seen, again.sigma))
    if one.dimmed:
        light = dataclasses.replace(light, mixing=update_radiometry(light.radiometry, one.gain).mixing)
    light.write(folder, name)


def _photograph_white(rig: Rig, projector: RigProjector, context: Context) -> list[Path]:
    exposures = Exposures.read(context.folder)[projector.name].white_s
    white = projector.white()
    plan = [
        Planned(str(number), partial(_one, projector.name, white), exposure_s)
        for number, exposure_s in enumerate(exposures)
    ]
    return take_all(rig, context, plan, into=white_again_of(projector.name))


def _one(name: str, image: ByteImage) -> dict[str, ByteImage]:
    return {name: image}


REPEATED = (StepKind.BLACK, StepKind.GEOMETRY)
"""Kinds of steps that concern every projector and depend on the new measurements."""
EXPOSURE = StepId(StepKind.EXPOSURE)


def one_projector_steps(
    rig: Rig, run: Path, last: Calibrated, full: Sequence[Step], projector: str, *, longest_exposure_s: float
) -> list[Step]:
    """From the exposure of ``projector`` to the grade of all.

    ``last`` and ``full`` as for ``steps.calibrate.quick.quick_steps``; ``projector``: the name of one of the rig's.
    """
    own = tuple(device for device in rig.projectors if device.name == projector)
    alone = capture_steps(dataclasses.replace(rig, projectors=own), longest_exposure_s=longest_exposure_s)
    exposing = next(step for step in alone if step.id == EXPOSURE)
    # A continued run for another projector, or from another calibration, must not count these steps as done.
    inputs = {"only": projector, "calibration": last.folder.name}
    steps = [
        dataclasses.replace(step, run=partial(_exposure, last, exposing) if step.id == EXPOSURE else step.run)
        if (way := reuse_for_one(step.id, projector)) is Reuse.RUN
        else dataclasses.replace(step, run=partial(_kept, last, step, way), weight=0.01)
        for step in full
    ]
    steps = [dataclasses.replace(step, inputs={**step.inputs, **inputs}) for step in steps]
    now = Calibrated(run, last.projectors)
    done = [step.id for step in steps]
    steps.append(verification_photographs_step(rig, now, done))
    scale = costs.scale(device.size_px for device in rig.projectors)
    steps.append(verify_step(now, [*done, steps[-1].id], scale))
    return steps


def reuse_for_one(step: StepId, projector: str) -> Reuse:
    """How to treat a step of the full calibration."""
    if step.kind in REPEATED or step == EXPOSURE or step.projector == projector:
        return Reuse.RUN
    return Reuse.CORRECT if step.kind == StepKind.RADIOMETRY else Reuse.KEEP


def _exposure(last: Calibrated, exposing: Step, context: Context) -> Sequence[Path]:
    """The last calibration's exposures, with a new one for this projector."""
    exposing.run(context)
    found = Exposures.read(context.folder)
    return [Exposures.write(context.folder, {**Exposures.read(last.folder), **found})]


def _kept(last: Calibrated, step: Step, way: Reuse, context: Context) -> Sequence[Path]:
    kept = copy_from_last(last.folder, step.id, context)
    if kept is None:  # the last calibration had no such step
        return step.run(context)
    if way is Reuse.CORRECT:
        name = step.id.projector
        assert name is not None
        # The room's light has been photographed again, and counts for every projector.
        light = dataclasses.replace(Light.read(context.folder, name), black=read_black(context.folder))
        light.write(context.folder, name)
    return kept
