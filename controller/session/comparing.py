"""The steps that show what is installed, photograph it, and compare each photograph with its stored target."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np

from controller.arrays import Mask, save_arrays
from controller.session import costs
from controller.session.compared import figures_path
from controller.session.publishing import bundle_display, photograph_hdr
from controller.session.rig import Rig
from controller.session.runner import Context, Step
from controller.session.shots import inherit_camera
from controller.session.solving import Calibrated, Solved, read_solved
from controller.solve.metrics import compare, sharpness_windows
from controller.storage import sha256_of, write_atomically

WINDOWS: Final = 48
"""Windows of the resolution map along the camera picture's longer side."""
LEAST_WINDOW_PX: Final = 16


def compare_steps(
    rig: Rig, calibrated: Calibrated, names: Sequence[str], *, bundle: str, longest_exposure_s: float
) -> list[Step]:
    """A step for each appearance, which leaves ``compared-NAME.npz`` and ``.json`` (``session.compared``).

    ``bundle``: what identifies the installed bundle; the appearances were solved on ``calibrated``. What was
    photographed on another day is not gone on with: the figures are those of the day on which they are asked for.
    """
    scale = costs.scale(projector.size_px for projector in rig.projectors)
    inputs = {"bundle": bundle, "calibration": calibrated.folder.name, "day": time.strftime("%Y-%m-%d"),
              "longest_exposure_s": repr(longest_exposure_s)}  # fmt: skip
    return [
        Step(
            f"compare-{name}",
            partial(_compare, rig, calibrated, name, (bundle, longest_exposure_s)),
            inputs=inputs | {"target": sha256_of(calibrated.folder / f"appearance-{name}.json")},
            title=f"Photographing {name}",
            weight=3 * costs.shot_s(scale) + costs.VERIFY_S * scale,
        )
        for name in names
    ]


def compared_mask(calibrated: Calibrated, solved: Solved) -> Mask:
    """Where photograph and target are compared, (rows, columns): on the object, where the target can be reached."""
    return solved.reachable & calibrated.calibration.object_mask


def window_px(shape: tuple[int, ...]) -> int:
    """The side of the resolution map's windows for a camera picture of this shape."""
    return max(LEAST_WINDOW_PX, round(max(shape[:2]) / WINDOWS))


def _compare(
    rig: Rig, calibrated: Calibrated, name: str, settings: tuple[str, float], context: Context
) -> Sequence[Path]:
    bundle, longest_s = settings
    inherit_camera(calibrated.folder, context.folder)
    solved = read_solved(calibrated.folder, name, calibrated.projectors)
    display = bundle_display(rig)
    display.load_bundle(rig.stage / "bundles" / "current", deadline=context.deadline.within(20))
    shown = display.play(name, deadline=context.deadline.within(20))
    # The day is of the photograph's settings as well: yesterday's are not taken for today's.
    of = {"bundle": bundle, "appearance": name, "day": time.strftime("%Y-%m-%d")}
    photographed_s = time.time()
    picture = photograph_hdr(rig, context, f"played-{name}", solved.exposure, longest_s, shown_at_s=shown.at_s, of=of)
    context.advance(0.7, "comparing with the target")
    mask, size_px = compared_mask(calibrated, solved), window_px(picture.shape)
    found = compare(picture, solved.target, calibrated.calibration.camera_to_xyz, solved.exposure, mask)
    local, _ = sharpness_windows(picture, solved.target, solved.exposure, mask, size_px)
    arrays = context.folder / f"compared-{name}.npz"
    save_arrays(arrays, {"photograph": picture, "error": found.error_map.astype(np.float16), "resolution": local})
    figures = {
        "name": name,
        "title": str(solved.figures.get("title", name)),
        "calibration": calibrated.folder.name,
        "photographed_unix_s": photographed_s,
        "delta_e00_median": found.delta_e00_median,
        "delta_e00_p95": found.delta_e00_p95,
        "rmse": found.rmse,
        "sharpness_lambda": found.sharpness_lambda,
        "reachable_share": solved.figures.get("reachable_share"),
        "window_px": size_px,
    }
    path = figures_path(context.folder, name)
    write_atomically(path, json.dumps(figures, indent=1).encode())
    return [path, arrays]
