"""The steps that calibrate one projector again and keep the last calibration of the others.

The others' photographs are not taken again, so they can't show whether camera or object has moved. The
pattern of the grade is therefore photographed on every projector, one photograph each: if another projector is
now predicted badly, the old calibration stays in use.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from controller.run.runner import Context, Step
from controller.run.step_id import StepId
from controller.stage.artefacts.calibrated import Calibrated
from controller.stage.artefacts.calibration import read_black
from controller.stage.artefacts.camera import Exposures
from controller.stage.artefacts.kinds import StepKind
from controller.stage.artefacts.projectors import Light
from controller.stage.rig.rig import Rig
from controller.stage.steps import costs
from controller.stage.steps.calibrate.grade import verification_photographs_step, verify_step
from controller.stage.steps.calibrate.quick import Reuse, copy_from_last
from controller.stage.steps.capture.patterns import capture_steps

REPEATED = (StepKind.BLACK, StepKind.GEOMETRY, StepKind.EDGE_TERMS)
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
        if (way := reuse_of(step.id, projector)) is Reuse.RUN
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


def reuse_of(step: StepId, projector: str) -> Reuse:
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


__all__ = ["one_projector_steps", "reuse_of"]
