"""A solve and base times scale on a graphics processor, next to the processor's in the same run.

The first real device; without one the first in software, whose times say nothing about real ones.
"""

from __future__ import annotations

import sys
import time

import numpy as np

from benchmarks import Row, Timing, at_most, timed
from benchmarks.lab.synthetic import synthetic_calibration, synthetic_target
from controller.core.arrays import FloatImage
from controller.solve.appearance import Base, base_image, prepare_base, scale_frames
from controller.solve.bounded.descent import IterationControl
from controller.solve.bounded.problem import Problem
from controller.solve.bounded.solver import SMOOTHNESS, Solution, build_problem, initial_point, solve_bounded
from controller.solve.engines.processor import Engine, Processor
from controller.solve.feasibility import choose_exposure, target_radiance
from controller.solve.gpu.device import Device, adapters
from controller.solve.gpu.engine import GpuEngine
from controller.transport import LightTransport, build_transport

TOLERANCE = 3e-4
"""The objective is within 1e-2 of its limit there."""
FEW, MORE = 2, 8
"""Sweeps, between which the time of one is taken."""


def measure(size: str) -> list[Row]:
    """Copying, a sweep, a base, a warm appearance and base times scale, on both."""
    found = adapters()
    if not found:
        sys.exit("There is no graphics processor with a working driver. Mesa's lavapipe is one in software.")
    device, notes = Device(found[0]), list[str]()
    engine, here = GpuEngine(device, notes.append), Processor()
    calibration = synthetic_calibration(size)
    transport = build_transport(calibration)
    black, image = calibration.black, base_image(calibration)
    kind = "in software" if device.software else "real"
    problem = build_problem(transport, image, black, SMOOTHNESS, None)
    start = initial_point(problem)
    began = time.perf_counter()
    engine.descend(problem, start.copy(), IterationControl(0, 1))
    rows = [
        at_most("transport copied, kernels compiled, a sweep", time.perf_counter() - began, None, unit="s",
                how=f"{device.name}, {kind}; once a stage; {' '.join(notes)}"),
    ]  # fmt: skip
    sweeps = [_sweep(which, problem, start) for which in (here, engine)]
    rows += _both("a sweep over the projectors", sweeps[0], sweeps[1])
    for tolerance, goal in ((3e-5, 0.5 if size == "paper" and not device.software else None),):
        one, other = (
            solve_bounded(transport, image, black, tolerance=tolerance, engine=which) for which in (here, engine)
        )
        rows += _both("base, as it stops by itself", one.seconds, other.seconds, goal=goal, how=_gap(one, other))
    base = prepare_base(transport, image, black, one)
    reflectance = synthetic_target(transport.camera_shape)
    target = target_radiance(reflectance, black, choose_exposure(transport, reflectance, black))
    goal = 0.1 if size == "paper" and not device.software else None
    full = [
        solve_bounded(transport, target, black, start=one.frames, tolerance=TOLERANCE, engine=which)
        for which in (here, engine)
    ]
    rows += _both("full appearance, warm, to 1e-2", full[0].seconds, full[1].seconds, goal=goal, how=_gap(*full))
    scaled = [_scaled(transport, base, target, black, which) for which in (here, engine)]
    return rows + _both("base times scale, float frames", scaled[0].minimum, scaled[1].minimum)


def _sweep(engine: Engine, problem: Problem, start: FloatImage) -> float:
    """Seconds of one sweep, copies left out."""
    seconds = []
    for sweeps in (FEW, MORE):
        began = time.perf_counter()
        engine.descend(problem, start.copy(), IterationControl(0, sweeps))
        seconds.append(time.perf_counter() - began)
    return (seconds[1] - seconds[0]) / (MORE - FEW)


def _scaled(transport: LightTransport, base: Base, target: FloatImage, black: FloatImage, engine: Engine) -> Timing:
    return timed(lambda: scale_frames(transport, base, target, black, engine=engine), repeats=3)


def _gap(here: Solution, there: Solution) -> str:
    return (
        f"{here.iterations} and {there.iterations} sweeps; objective {there.objective / here.objective - 1:+.1e} "
        f"of the processor's; frames apart by {_apart(here, there):.1e} rms"
    )


def _apart(here: Solution, there: Solution) -> float:
    squares = [float(np.mean((a - b) ** 2)) for a, b in zip(here.frames, there.frames, strict=True)]
    return float(np.sqrt(np.mean(squares)))


def _both(what: str, here: float, there: float, *, goal: float | None = None, how: str = "") -> list[Row]:
    return [
        at_most(f"{what}: processor", here, None, unit="s", how=how),
        at_most(f"{what}: device", there, goal, unit="s", how=""),
        at_most(f"{what}: device by processor", there / max(here, 1e-9), None, unit="x", how=""),
    ]
