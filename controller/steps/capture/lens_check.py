"""Checks that the lens file fits the camera's pictures, before a lamp is struck."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

from controller.calibrate.geometry.values import CameraPrior
from controller.capture.raw import is_jpeg, read_jpeg_values, read_mosaic
from controller.core.errors import UsageError
from controller.rig.rig import Rig
from controller.run.runner import Context, Step
from controller.run.step_id import StepId


def lens_check(rig: Rig, prior: CameraPrior) -> list[Step]:
    """The step that takes one photograph in the dark and compares its size with that of the lens file.

    None if the focal length is not from such a file. Raises UsageError("camera-intrinsics-wrong-size").
    """
    size_px = prior.size_px
    if size_px is None:
        return []

    def check(context: Context) -> Sequence[Path]:
        file, _ = rig.acquirer.photograph(
            "lens-check", rig.acquirer.exposures_s()[0], context.folder, shown_at_s=time.monotonic(),
            deadline=context.deadline.within(60), wait_s=0.0,
        )  # fmt: skip
        try:
            taken = read_jpeg_values(file.path) if is_jpeg(file.path) else read_mosaic(file.path).samples
        finally:
            file.path.unlink(missing_ok=True)
        rows, columns = taken.shape[:2]
        if (columns, rows) != size_px:
            raise UsageError(
                "camera-intrinsics-wrong-size",
                what=f"The lens file is for pictures of {size_px[0]} x {size_px[1]} pixels, but the camera's have"
                f" {columns} x {rows}.",
                remedy="Use the camera settings of `velatura camera calibrate`, or calibrate the lens again.",
            )
        return ()

    title = "Checking the lens file against a photograph"
    return [Step(StepId("lens-check"), check, inputs={"size": " x ".join(map(str, size_px))}, title=title, weight=1.0)]
