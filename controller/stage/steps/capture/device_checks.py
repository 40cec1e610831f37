"""Checks display and camera before a lamp is struck: sizes of the outputs, and one photograph in the dark."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from controller.core.errors import UsageError
from controller.optics.calibrate.geometry.values import CameraPrior
from controller.optics.capture.linear_files import is_linear
from controller.optics.capture.raw import is_jpeg, read_jpeg_values, read_mosaic, read_samples
from controller.optics.solve.memory_need import calibration_peak_bytes, check_memory, planned_size, solve_peak_bytes
from controller.run.runner import Context, Step
from controller.run.step_id import StepId
from controller.stage.rig.rig import Rig
from hal.notices import Level
from hal.runtime.compute import free_bytes

Size = tuple[int, int]


def device_checks(rig: Rig, prior: CameraPrior) -> list[Step]:
    """The step that compares the outputs of stage.toml with the display's, and reads one photograph.

    Warns of a RAW file without colour matrix or black level. Raises UsageError("display-outputs-differ"),
    ("camera-intrinsics-wrong-size") where the lens file is for another size, WorkError("memory-too-small") where a
    calibration or a solve of that size certainly does not fit, and as ``read_photograph``.
    """
    wanted = {projector.output: projector.size_px for projector in rig.projectors}

    def check(context: Context) -> Sequence[Path]:
        shown = rig.display.outputs(deadline=context.deadline.within(20))
        _check_outputs(wanted, {output.name: (output.width_px, output.height_px) for output in shown})
        file, _ = rig.acquirer.photograph(
            "device-checks", rig.acquirer.exposures_s()[0], context.folder, shown_at_s=time.monotonic(),
            deadline=context.deadline.within(60), wait_s=0.0,
        )  # fmt: skip
        try:
            size_px, missing = _read(file.path)
        finally:
            file.path.unlink(missing_ok=True)
        if missing:
            context.reporter.say(missing, Level.WARNING)
        size, free = planned_size(size_px, list(wanted.values())), free_bytes()
        needs = (solve_peak_bytes(size), "The solve"), (calibration_peak_bytes(size), "The calibration")
        context.reporter.say(check_memory(max(needs)[0], free, max(needs)[1]))
        if prior.size_px not in (None, size_px):
            raise _wrong_lens(prior.size_px or size_px, size_px)
        return ()

    inputs = {"size": repr(prior.size_px), "outputs": repr(sorted(wanted.items()))}
    title = "Checking the display's outputs and a photograph"
    return [Step(StepId("device-checks"), check, inputs=inputs, title=title, weight=1.0)]


def _check_outputs(wanted: dict[str, Size], shown: dict[str, Size]) -> None:
    for name, size_px in wanted.items():
        if shown.get(name) != size_px:
            found = shown.get(name)
            theirs = "does not have it" if found is None else f"says {found[0]} x {found[1]}"
            raise UsageError(
                "display-outputs-differ",
                what=f"Output {name} has {size_px[0]} x {size_px[1]} pixels in stage.toml, but the display {theirs}.",
                remedy="Correct [[display.outputs]] in stage.toml, or the settings of the display.",
            )


def _read(path: Path) -> tuple[Size, str]:
    """(width, height), and a sentence about what the file does not say; raises where it can't be read."""
    missing = ""
    if is_jpeg(path):
        taken = np.asarray(read_jpeg_values(path), np.float32)
    elif is_linear(path):
        taken = read_samples(path)[0]
    else:
        mosaic = read_mosaic(path)
        taken = mosaic.samples.astype(np.float32)
        lacks = ["colour matrix"] * (mosaic.camera_to_xyz is None) + ["black level"] * (not mosaic.levels.black.any())
        if lacks:
            missing = (
                f"The camera's RAW files have no {' and no '.join(lacks)}. "
                "See 'What the files must say' on the page Cameras of the documentation."
            )
    return (taken.shape[1], taken.shape[0]), missing


def _wrong_lens(lens: Size, taken: Size) -> UsageError:
    return UsageError(
        "camera-intrinsics-wrong-size",
        what=f"The lens file is for pictures of {lens[0]} x {lens[1]} pixels, but the camera's have"
        f" {taken[0]} x {taken[1]}.",
        remedy="Use the camera settings of `velatura camera calibrate`, or calibrate the lens again.",
    )
