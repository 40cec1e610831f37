"""The steps that show and photograph installed appearances and compare each photograph with its stored target."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from controller.core.arrays import FloatImage, Mask
from controller.core.storage import sha256_of
from controller.optics.calibrate.values import Calibration
from controller.optics.solve.result.ghosting import ghosting
from controller.optics.solve.result.metrics import as_table, by_pixels, compare, sharpness_windows
from controller.run.runner import Context, Step
from controller.run.step_id import StepId
from controller.stage.artefacts.calibrated import Calibrated
from controller.stage.artefacts.camera import inherit_camera
from controller.stage.artefacts.comparison import Compared, ComparedImages, write_compared
from controller.stage.artefacts.kinds import StepKind
from controller.stage.artefacts.solved import Solved, read_solved, solved_figures_path
from controller.stage.rig.rig import Rig
from controller.stage.steps import costs
from controller.stage.steps.appearance.photographing import PLAYED, ShownPicture, photograph_hdr

WINDOWS: Final = 48
"""Windows of the resolution map along the camera picture's longer side."""
LEAST_WINDOW_PX: Final = 16


def compare_steps(
    rig: Rig, calibrated: Calibrated, names: Sequence[str], *, bundle: str, longest_exposure_s: float
) -> list[Step]:
    """A step for each appearance, which leaves ``compared-NAME.npz`` and ``.json`` (``artefacts.comparison``).

    ``bundle``: identifies the installed bundle; the appearances were solved on ``calibrated``. Photographs of another
    day are not used: all figures are from the day of the request.
    """
    scale = costs.scale(projector.size_px for projector in rig.projectors)
    inputs = {"bundle": bundle, "calibration": calibrated.folder.name, "day": time.strftime("%Y-%m-%d"),
              "longest_exposure_s": repr(longest_exposure_s)}  # fmt: skip
    return [
        Step(
            StepId(StepKind.COMPARE, item=name),
            partial(_compare, rig, calibrated, name, (bundle, longest_exposure_s)),
            inputs=inputs | {"target": sha256_of(solved_figures_path(calibrated.folder, name))},
            title=f"Photographing {name}",
            weight=3 * costs.shot_s(scale) + costs.VERIFY_S * scale,
        )
        for name in names
    ]


def compared_mask(calibrated: Calibrated, solved: Solved) -> Mask:
    """Mask of the comparison, (rows, columns): pixels on the object where what was asked for can be reached."""
    return solved.requested.reachable & calibrated.calibration.object_mask


def window_px(shape: tuple[int, ...]) -> int:
    """The side of the resolution map's windows for a camera picture of this shape."""
    return max(LEAST_WINDOW_PX, round(max(shape[:2]) / WINDOWS))


def _compare(
    rig: Rig, calibrated: Calibrated, name: str, settings: tuple[str, float], context: Context
) -> Sequence[Path]:
    bundle, longest_s = settings
    inherit_camera(calibrated.folder, context.folder)
    solved = read_solved(calibrated.folder, name, calibrated.projectors)
    display = rig.bundle_display()
    display.load_bundle(rig.stage / "bundles" / "current", deadline=context.deadline.within(20))
    shown = display.play(name, deadline=context.deadline.within(20))
    # The day is part of the photograph's settings, so that yesterday's photographs are not reused.
    of = {"bundle": bundle, "appearance": name, "day": time.strftime("%Y-%m-%d")}
    photographed_s = time.time()
    what = ShownPicture(PLAYED, name, of, shown.at_s, solved.exposure, solved.target[solved.reachable])
    picture = photograph_hdr(rig, context, what, longest_s)
    context.advance(0.7, "comparing with the target")
    mask, size_px = compared_mask(calibrated, solved), window_px(picture.shape)
    asked = solved.requested.target
    found = compare(picture, asked, calibrated.calibration.camera_to_xyz, solved.exposure, mask)
    local, _ = sharpness_windows(picture, asked, solved.exposure, mask, size_px)
    one = Compared(
        run=context.folder.name,
        name=name,
        title=str(solved.figures.get("title", name)),
        calibration=calibrated.folder.name,
        photographed_unix_s=photographed_s,
        delta_e00_median=found.delta_e00_median,
        delta_e00_p95=found.delta_e00_p95,
        rmse=found.rmse,
        sharpness_lambda=found.sharpness_lambda,
        reachable_share=_number(solved.figures.get("reachable_share")),
        window_px=size_px,
        refined=solved.figures.get("refined"),
        **judged(calibrated.calibration, calibrated.reflectance, solved, picture),
    )
    return write_compared(context.folder, one, ComparedImages(picture, found.error_map.astype(np.float16), local))


def judged(calibration: Calibration, reflectance: FloatImage, solved: Solved, picture: FloatImage) -> dict[str, Any]:
    """What a photograph (rows, columns, 3) says beyond the pixels in reach, and the solve's ``held_back``.

    Raises what ``solve.metrics.compare`` raises.
    """
    asked, lit, matrix, white = solved.requested, calibration.object_mask, calibration.camera_to_xyz, solved.exposure
    sets = by_pixels(picture, asked.target, matrix, white, reachable=asked.reachable, valid=asked.valid, lit=lit)
    shown = lit & asked.valid
    ghost = ghosting(picture, asked.target, reflectance, matrix, white, shown, shown & ~asked.reachable)
    adapted = None
    if solved.asked is not None and (reached := solved.reachable & lit).any():
        found = compare(picture, solved.target, matrix, white, reached)
        adapted = {"delta_e00_median": found.delta_e00_median, "delta_e00_p95": found.delta_e00_p95,
                   "reachable_share": float(reached.sum() / max(int(lit.sum()), 1))}  # fmt: skip
    return {"pixels": as_table(sets), "ghosting": None if ghost is None else asdict(ghost), "adapted": adapted,
            "held_back": solved.figures.get("held_back")}  # fmt: skip


def _number(value: object) -> float | None:
    return None if value is None else float(str(value))
