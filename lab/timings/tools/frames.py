"""Compensation frames as a stage would play them: solved and dithered on the synthetic stage."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from controller.core.arrays import ByteImage, FloatImage
from controller.optics.calibrate.values import Radiometry
from controller.optics.solve.bounded.equations import SolveSettings
from controller.optics.solve.bounded.solver import solve_bounded
from controller.optics.solve.reach.drive_levels import DriveLevels
from controller.optics.solve.reach.feasibility import exposures, target_radiance
from controller.optics.solve.scaling.dither import to_device
from controller.optics.transport import build_transport
from controller.stage.steps.appearance.solving import device_frames
from lab.timings.tools.synthetic import synthetic_calibration, synthetic_target

OUTPUTS = ("P1", "P2", "P3")
MOST_ITERATIONS = 30
"""Enough for frames that look, and compress, like finished ones."""


UHD = "uhd"
UHD_OUTPUTS = ("P1", "P2", "P3", "P4")
_UHD_PX = (2160, 3840)


def compensation_frames(size: str, appearances: int) -> list[dict[str, ByteImage]]:
    """For each appearance its outputs' device frames, (rows, columns, 3) uint8: three outputs, with size uhd four.

    Those of size uhd are solved at paper size and mirrored until they fill 3840x2160; then they are dithered.
    """
    uhd = size == UHD
    calibration = synthetic_calibration("paper" if uhd else size)
    transport = build_transport(calibration)
    shape = transport.camera_shape
    found = []
    for number in range(appearances):
        target = _turned(synthetic_target(shape), number)
        exposure, _ = exposures(DriveLevels.of_transport(transport), target, calibration.black)
        wanted = target_radiance(target, calibration.black, exposure)
        solution = solve_bounded(transport, wanted, calibration.black, SolveSettings(most_iterations=MOST_ITERATIONS))
        if uhd:
            found.append(_four_uhd(solution.frames, calibration.projectors[0].radiometry))
        else:
            frames = device_frames(calibration, solution.frames).values()
            found.append(dict(zip(OUTPUTS, frames, strict=True)))
    return found


def _four_uhd(solved: Sequence[FloatImage], radiometry: Radiometry) -> dict[str, ByteImage]:
    sources = [*solved, np.roll(solved[0], 211, axis=1)]
    return {name: to_device(_mirrored(values), radiometry) for name, values in zip(UHD_OUTPUTS, sources, strict=True)}


def _mirrored(values: FloatImage) -> FloatImage:
    """Rows and columns of a picture mirrored at its edges until it fills 3840x2160."""
    missing = [whole - side for whole, side in zip(_UHD_PX, values.shape[:2], strict=True)]
    return np.pad(values, [(0, missing[0]), (0, missing[1]), (0, 0)], mode="symmetric")


def _turned(target: FloatImage, number: int) -> FloatImage:
    """Other pictures from one: shifted, mirrored, its colours in another order."""
    moved = np.roll(target, 37 * number, axis=1)[:, :: -1 if number % 2 else 1]
    return np.ascontiguousarray(np.roll(moved, number, axis=2))
