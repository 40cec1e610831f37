"""Compensation frames as a stage would play them: solved and dithered on the synthetic stage."""

from __future__ import annotations

import numpy as np

from benchmarks._synthetic import synthetic_calibration, synthetic_target
from controller.core.arrays import ByteImage, FloatImage
from controller.solve.bounded.solver import solve_bounded
from controller.solve.feasibility import choose_exposure, target_radiance
from controller.steps.appearance.solving import device_frames
from controller.transport import build_transport

OUTPUTS = ("P1", "P2", "P3")
MOST_ITERATIONS = 30
"""Enough for frames that look, and compress, like finished ones."""


def compensation_frames(size: str, appearances: int) -> list[dict[str, ByteImage]]:
    """For each appearance its three outputs' device frames, (rows, columns, 3) uint8."""
    calibration = synthetic_calibration(size)
    transport = build_transport(calibration)
    shape = transport.camera_shape
    found = []
    for number in range(appearances):
        target = _turned(synthetic_target(shape), number)
        exposure = choose_exposure(transport, target, calibration.black)
        wanted = target_radiance(target, calibration.black, exposure)
        solution = solve_bounded(transport, wanted, calibration.black, most_iterations=MOST_ITERATIONS)
        frames = device_frames(calibration, solution.frames).values()
        found.append(dict(zip(OUTPUTS, frames, strict=True)))
    return found


def _turned(target: FloatImage, number: int) -> FloatImage:
    """Other pictures from one: shifted, mirrored, its colours in another order."""
    moved = np.roll(target, 37 * number, axis=1)[:, :: -1 if number % 2 else 1]
    return np.ascontiguousarray(np.roll(moved, number, axis=2))
