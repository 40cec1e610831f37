"""The steps of a drift check: N + 2 photographs, compared with what the calibration predicts."""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from controller.arrays import ByteImage, FloatImage
from controller.calibrate.drift import Drift, Seen, find_drift
from controller.calibrate.drift_report import drift_from_json, drift_to_json
from controller.capture.patterns import Pattern, PatternKind, device_frame, frame
from controller.session import costs
from controller.session.capturing import bracket
from controller.session.rig import Rig
from controller.session.runner import Context, Step
from controller.session.shots import Planned, inherit_camera, read_index, take_all
from controller.session.solving import Calibrated
from controller.storage import write_atomically

PATTERN = Pattern("drift", PatternKind.RANDOM, seed=17)
"""Not the one on which a calibration is graded."""
FILE = "drift.json"
FULL_SHARE = 0.7
"""Of full scale, for the brightest places: room for light that came in since."""
BLACK_TIMES = 8.0
"""The black photograph's exposure over that of white."""


def drift_steps(rig: Rig, calibrated: Calibrated, *, longest_exposure_s: float) -> list[Step]:
    """Photograph, then judge; the result is ``drift.json`` in the run's folder (``read_drift``)."""
    scale = costs.scale(projector.size_px for projector in rig.projectors)
    inputs = {"calibration": calibrated.folder.name, "longest_exposure_s": repr(longest_exposure_s)}
    return [
        Step(
            "drift-photographs",
            partial(_photograph, rig, calibrated, longest_exposure_s),
            inputs=inputs,
            title="Photographing what may have changed",
            weight=costs.shot_s(scale) * (len(rig.projectors) + 2),
        ),
        Step(
            "drift",
            partial(_judge, calibrated),
            inputs=inputs,
            after=("drift-photographs",),
            title="Comparing with the calibration",
            weight=costs.VERIFY_S * scale * 3,
        ),
    ]


def read_drift(folder: Path) -> Drift:
    """What the step ``drift`` found."""
    return drift_from_json(json.loads((folder / FILE).read_text()))


def exposure_for(light: FloatImage, available_s: Sequence[float], longest_s: float) -> float:
    """The longest exposure that keeps an expected picture (full scales per second) below full scale."""
    brightest = float(np.percentile(light.max(axis=2), 99.9))
    wanted_s = FULL_SHARE / max(brightest, 1e-9)
    usable = [value for value in available_s if value <= min(wanted_s, longest_s)]
    return max(usable, default=min(available_s))


def shown_frames(calibrated: Calibrated, pattern: Pattern) -> dict[str, ByteImage]:
    """``pattern`` on each projector, in device values, by its measured response."""
    found = {}
    for part in calibrated.calibration.projectors:
        rows, columns = part.metapixels.valid.shape
        found[part.name] = device_frame(pattern, (columns, rows), part.radiometry.response)
    return found


def _photograph(rig: Rig, calibrated: Calibrated, longest_s: float, context: Context) -> Sequence[Path]:
    inherit_camera(calibrated.folder, context.folder)
    calibration, available = calibrated.calibration, rig.acquirer.exposures_s()
    frames = shown_frames(calibrated, PATTERN)
    plan = []
    for part in calibration.projectors:
        exposure_s = exposure_for(part.white + calibration.black, available, longest_s)
        plan.append(Planned(f"drift-{part.name}", partial(_one, part.name, frames[part.name]), exposure_s))
    lit = sum((part.white for part in calibration.projectors), start=calibration.black)
    white_s = exposure_for(lit, available, longest_s)
    whites = {name: np.full_like(image, 255) for name, image in frames.items()}
    plan.append(Planned("drift-white", lambda: whites, white_s))
    (black_s,) = bracket(white_s, (BLACK_TIMES,), available, longest_s)
    plan.append(Planned("drift-black", dict, black_s))
    return take_all(rig, context, plan, index="drift-photographs")


def _one(name: str, image: ByteImage) -> dict[str, ByteImage]:
    return {name: image}


def _judge(calibrated: Calibrated, context: Context) -> Sequence[Path]:
    calibration = calibrated.calibration
    taken = read_index(context.folder, "drift-photographs")
    seen = Seen(
        black=taken["drift-black"].per_second(),
        white=taken["drift-white"].per_second(),
        patterns={part.name: taken[f"drift-{part.name}"].per_second() for part in calibration.projectors},
    )
    context.advance(0.2)
    drift = find_drift(calibrated.transport, calibration, linear_frames(calibrated, PATTERN), seen)
    content = drift_to_json(drift, calibration=calibrated.folder.name, photographs=len(taken))
    path = context.folder / FILE
    write_atomically(path, (json.dumps(content, indent=1) + "\n").encode())
    return [path]


def linear_frames(calibrated: Calibrated, pattern: Pattern) -> list[FloatImage]:
    """What ``shown_frames`` sends out: (rows, columns, 3) linear light a projector."""
    sizes = [part.metapixels.valid.shape for part in calibrated.calibration.projectors]
    return [frame(pattern, (columns, rows)) for rows, columns in sizes]
