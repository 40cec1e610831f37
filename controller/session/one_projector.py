"""The steps that calibrate one projector anew and keep what the last calibration knows of the others.

The others' photographs are not taken again, so nothing in them can tell that camera or object has moved since. The
pattern of the grade is therefore photographed on every projector, one photograph each: if one of the others is
predicted badly now, the gate keeps the old calibration.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from controller.arrays import load_arrays, save_arrays
from controller.session import costs
from controller.session.calibrating import read_black
from controller.session.capturing import capture_steps
from controller.session.grading import verification_photographs_step, verify_step
from controller.session.quick import Way, keep
from controller.session.rig import Rig
from controller.session.runner import Context, Step
from controller.session.solving import Calibrated
from controller.storage import write_atomically

ANEW = ("black", "geometry", "edge-terms")
"""Steps that concern every projector, and depend on what is measured anew."""


def one_projector_steps(
    rig: Rig, run: Path, last: Calibrated, full: Sequence[Step], projector: str, *, longest_exposure_s: float
) -> list[Step]:
    """From the exposure of ``projector`` to the grade of all.

    ``last`` and ``full`` as for ``session.quick.quick_steps``; ``projector``: the name of one of the rig's.
    """
    own = tuple(one for one in rig.projectors if one.name == projector)
    alone = capture_steps(dataclasses.replace(rig, projectors=own), longest_exposure_s=longest_exposure_s)
    exposing = next(step for step in alone if step.name == "exposure")
    # A run that goes on, for another projector or from another calibration, must not take these steps as done.
    inputs = {"only": projector, "calibration": last.folder.name}
    steps = [
        dataclasses.replace(step, run=partial(_exposure, last, exposing) if step.name == "exposure" else step.run)
        if (way := way_of(step.name, projector)) is Way.RUN
        else dataclasses.replace(step, run=partial(_kept, last, step, way), weight=0.01)
        for step in full
    ]
    steps = [dataclasses.replace(step, inputs={**step.inputs, **inputs}) for step in steps]
    now = Calibrated(run, last.projectors)
    names = [step.name for step in steps]
    steps.append(verification_photographs_step(rig, now, names))
    scale = costs.scale(one.size_px for one in rig.projectors)
    steps.append(verify_step(now, [*names, steps[-1].name], scale))
    return steps


def way_of(step: str, projector: str) -> Way:
    """What becomes of a step of the full calibration."""
    if step in ANEW or step == "exposure" or step.endswith(f"-{projector}"):
        return Way.RUN
    return Way.CORRECT if step.startswith("radiometry-") else Way.KEEP


def _exposure(last: Calibrated, exposing: Step, context: Context) -> Sequence[Path]:
    """The last calibration's exposures, that of the one projector found anew."""
    (path,) = exposing.run(context)
    before = json.loads((last.folder / path.name).read_text())
    write_atomically(path, json.dumps({**before, **json.loads(path.read_text())}, indent=1).encode())
    return [path]


def _kept(last: Calibrated, step: Step, way: Way, context: Context) -> Sequence[Path]:
    kept = keep(last.folder, step.name, context)
    if kept is None:  # the last calibration had no such step
        return step.run(context)
    if way is Way.CORRECT:
        path = context.folder / f"{step.name}.npz"
        # The room's light has been photographed anew, and counts for every projector.
        save_arrays(path, {**load_arrays(path), "black": read_black(context.folder)})
    return kept


__all__ = ["one_projector_steps", "way_of"]
