"""The steps of a quick recalibration: look what has changed, repeat that, keep the rest of the last calibration.

A projector that turned about its lens, or whose light changed, is corrected without codes: its white image is
photographed anew, its correspondences and metapixels are moved. One that moved otherwise gets new codes. If camera or
object moved, everything is measured again.
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

from controller.arrays import ByteImage, load_arrays, save_arrays
from controller.calibrate.drift import Drift, ProjectorDrift
from controller.calibrate.drift_report import advice, sentences
from controller.calibrate.shifted import dimmed_radiometry, shifted_pixels
from controller.calibrate.values import Radiometry
from controller.capture.brackets import merge_brackets
from controller.errors import CalibrationError
from controller.session import costs
from controller.session.calibrating import read_black
from controller.session.capturing import exposures_of
from controller.session.drifting import drift_steps, read_drift
from controller.session.grading import verification_photographs_step, verify_step
from controller.session.journal import Journal
from controller.session.modes import mode_of
from controller.session.progress import Level
from controller.session.rig import Rig, RigProjector
from controller.session.runner import Context, Step
from controller.session.shots import Planned, read_index, take_all
from controller.session.solving import Calibrated


class Way(enum.Enum):
    """What a quick recalibration does with a step of the full one."""

    RUN = "run"
    KEEP = "keep"
    CORRECT = "correct"


def quick_steps(
    rig: Rig, run: Path, last: Calibrated, full: Sequence[Step], *, longest_exposure_s: float
) -> list[Step]:
    """From the drift check to the grade.

    ``last``: the calibration that is brought up to date; ``full``: the steps of a full calibration, in the order and
    with the options of ``last``; each is run, kept or corrected once the drift is known
    """
    scale = costs.scale(projector.size_px for projector in rig.projectors)
    steps = drift_steps(rig, last, longest_exposure_s=longest_exposure_s)
    steps.append(Step("plan", _tell, after=("drift",), title="Choosing what to repeat", weight=0.01, always=True))
    steps += [_chosen(rig, last, step) for step in full]
    now = Calibrated(run, last.projectors)
    names = [step.name for step in full]
    steps.append(verification_photographs_step(rig, now, names))
    steps.append(verify_step(now, [*names, steps[-1].name], scale))
    return steps


def _tell(context: Context) -> Sequence[Path]:
    """Say what was found. Raises CalibrationError("projector-dark") where no calibration would help."""
    drift = read_drift(context.folder)
    found = sentences(drift)
    for sentence in found[:-1] or found:
        context.reporter.say(sentence)
    if advice(drift) == "look":
        for taken in read_index(context.folder, "drift-photographs").values():
            taken.path.unlink(missing_ok=True)  # the same command looks again, once the projector has been seen to
        raise CalibrationError("projector-dark", what=found[0], remedy=found[-1])
    if advice(drift) == "full":
        context.reporter.say("All of it is measured again: nothing of the last calibration holds.", Level.WARNING)
    context.journal.record("drift", " ".join(found))
    return ()


def _chosen(rig: Rig, last: Calibrated, step: Step) -> Step:
    """The step, run, kept or corrected as the drift will say."""

    def run(context: Context) -> Sequence[Path]:
        way = way_of(step.name, read_drift(context.folder), mode_of(last.folder))
        if way is Way.RUN:
            return step.run(context)
        kept = keep(last.folder, step.name, context)
        if kept is None:  # the last calibration had no such step
            return step.run(context)
        return kept if way is Way.KEEP else _correct(rig, last, step.name, kept, context)

    return dataclasses.replace(step, run=run, after=(*step.after, "drift"), weight=0.1 * step.weight)


def way_of(step: str, drift: Drift, mode: str = "fast") -> Way:
    """What becomes of a step of the full calibration. ``mode``: how the last one measured its metapixels."""
    if advice(drift) == "full":
        return Way.RUN
    if drift.nothing:
        return Way.KEEP
    if step == "black":
        return Way.RUN
    if step == "geometry":
        return Way.RUN if drift.moved else Way.KEEP
    for one in drift.projectors:
        if step.endswith(f"-{one.name}"):
            return _way_of(step.removesuffix(f"-{one.name}"), one, mode)
    return Way.KEEP


def _way_of(kind: str, one: ProjectorDrift, mode: str) -> Way:
    if not one.known or (one.moved and not (one.turned_only and mode == "fast")):
        return Way.RUN
    if kind == "radiometry":
        return Way.CORRECT  # black has been photographed anew
    if kind == "light":
        return Way.CORRECT if one.moved or one.dimmed else Way.KEEP
    return Way.CORRECT if kind == "pixels" and one.moved else Way.KEEP


def keep(last: Path, step: str, context: Context) -> list[Path] | None:
    """The artefacts of the last calibration's step, in this run's folder; None if it had no such step."""
    with Journal(last) as journal:
        artefacts = journal.latest(step)
    if artefacts is None:
        return None
    paths = []
    for artefact in artefacts:
        path = context.folder / artefact.path.relative_to(last.resolve())
        path.parent.mkdir(parents=True, exist_ok=True)
        path.unlink(missing_ok=True)
        try:
            os.link(artefact.path, path)  # every writer replaces files and never changes them
        except OSError:
            shutil.copy2(artefact.path, path)
        paths.append(path)
    return paths


def _correct(rig: Rig, last: Calibrated, step: str, kept: list[Path], context: Context) -> Sequence[Path]:
    kind, _, name = step.partition("-")
    one = next(one for one in read_drift(context.folder).projectors if one.name == name)
    if kind == "light":
        projector = next(projector for projector in rig.projectors if projector.name == name)
        return [*kept, *_photograph_white(rig, projector, context)]
    path = context.folder / f"{step}.npz"
    arrays = load_arrays(path)
    if kind == "pixels":
        save_arrays(path, shifted_pixels(arrays, one.motion.matrix))
        return kept
    arrays["black"] = read_black(context.folder)
    if one.moved or one.dimmed:
        taken = list(read_index(context.folder, f"white-{name}").values())
        white = merge_brackets([t.read().measured() for t in taken], [t.exposure_s for t in taken]).radiance
        arrays["white"] = np.maximum(white - arrays["black"], 0).astype(np.float32)
    if one.dimmed:
        now = dimmed_radiometry(Radiometry(arrays["response"], arrays["mixing"]), one.gain)
        arrays["mixing"] = now.mixing
    save_arrays(path, arrays)
    return kept


def _photograph_white(rig: Rig, projector: RigProjector, context: Context) -> list[Path]:
    exposures = exposures_of(context.folder)[projector.name].white_s
    white = np.full_like(projector.black(), 255)
    plan = [
        Planned(f"{projector.name}-white-again-{number}", partial(_one, projector.name, white), exposure_s)
        for number, exposure_s in enumerate(exposures)
    ]
    return take_all(rig, context, plan, index=f"white-{projector.name}")


def _one(name: str, image: ByteImage) -> dict[str, ByteImage]:
    return {name: image}


__all__ = ["Way", "keep", "quick_steps", "way_of"]
