"""A solve and base times scale on a graphics processor, next to the processor's in the same run.

The first real device; without one the first in software, whose times say nothing about real ones. ``BENCH_RUN=FOLDER``
measures a run that exists instead of a synthetic stage. ``BENCH_PROCESSOR=0`` leaves the processor out.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np

from controller.core.arrays import FloatImage
from controller.optics.solve.appearance import base_image, prepare_base, scale_frames
from controller.optics.solve.bounded.engine import Engine, Processor, SolveContext
from controller.optics.solve.bounded.equations import Solution, SolveSettings
from controller.optics.solve.bounded.solver import solve_bounded
from controller.optics.solve.gpu.device import Device, adapters
from controller.optics.solve.gpu.engine import GpuEngine
from controller.optics.solve.reach.drive_levels import DriveLevels
from controller.optics.solve.reach.feasibility import exposures, target_radiance
from controller.optics.transport import LightTransport
from controller.stage.artefacts.calibrated import Calibrated
from controller.stage.artefacts.geometry import projectors_of
from lab.timings import Row, at_most, timed
from lab.timings.tools.synthetic import PROJECTOR, synthetic_target, write_synthetic_run

SIZES: Final = tuple(PROJECTOR)
NEAR_ENOUGH: Final = 1e-2
BEST_SWEEPS: Final = 400
"""Of a solve whose objective counts as the best."""
FEW, MORE = 2, 18
"""Sweeps, between which the time of one is taken."""
REPEATS: Final = 3
GOALS_S: Final = {"paper": (0.5, 0.1), "uhd": (3.0, None)}
"""Of a base, and of a full appearance to ``NEAR_ENOUGH``, on a real device."""


def measure(size: str) -> list[Row]:
    """Copying, a sweep, a base, a full appearance and base times scale, on both."""
    found = adapters()
    if not found:
        sys.exit("There is no graphics processor with a working driver. Mesa's lavapipe is one in software.")
    device, notes = Device(found[0]), list[str]()
    engines: list[Engine] = [GpuEngine(device, notes.append)]
    if os.environ.get("BENCH_PROCESSOR") != "0":
        engines.append(Processor())
    goals_s = (None, None) if device.software else GOALS_S.get(size, (None, None))
    with _run(size) as (run, names):
        calibration = Calibrated(run, names)
        stage = Stage(calibration.transport, base_image(calibration.calibration), calibration.calibration.black)
        rows = list(measured(stage, engines, goals_s))
    kind = "in software" if device.software else "real"
    how = f"{device.name}, {kind}; {' '.join(notes)}"
    return [at_most("memory of the device", device.held_bytes / 1e9, None, unit="GB", how=how), *rows]


@contextmanager
def _run(size: str) -> Iterator[tuple[Path, list[str]]]:
    if given := os.environ.get("BENCH_RUN"):
        yield Path(given), projectors_of(Path(given))
        return
    with tempfile.TemporaryDirectory(prefix="velatura-gpu-", dir=os.environ.get("BENCH_FOLDER")) as folder:
        yield Path(folder), write_synthetic_run(Path(folder), size)


@dataclass(frozen=True, slots=True)
class Stage:
    """What is solved: the base ``image`` and a target made of it, and their ``black``, (rows, columns, 3)."""

    transport: LightTransport
    image: FloatImage
    black: FloatImage

    def target(self) -> FloatImage:
        reflectance = synthetic_target(self.transport.camera_shape)
        exposure, _ = exposures(DriveLevels.of_transport(self.transport), reflectance, self.black)
        return target_radiance(reflectance, self.black, exposure)

    def solved(self, engine: Engine, wanted: FloatImage, sweeps: int | None = None) -> Solution:
        """As it stops by itself, or after so many sweeps."""
        settings = SolveSettings() if sweeps is None else SolveSettings(tolerance=0, most_iterations=sweeps)
        return solve_bounded(self.transport, wanted, self.black, settings, SolveContext(engine))


def measured(stage: Stage, engines: Sequence[Engine], goals_s: tuple[float | None, float | None]) -> Iterator[Row]:
    """The rows of each engine; ``goals_s`` of the first one's base and full appearance."""
    target, first = stage.target(), engines[0]
    began = time.perf_counter()
    stage.solved(first, stage.image, 1)
    once_s = time.perf_counter() - began
    yield _row("once a stage: transport copied, white light, kernels; and a sweep", first, once_s)
    best = stage.solved(first, target, BEST_SWEEPS).objective
    needed = _least(lambda sweeps: stage.solved(first, target, sweeps).objective <= best * (1 + NEAR_ENOUGH))
    bases = [stage.solved(engine, stage.image) for engine in engines]
    base = prepare_base(stage.transport, stage.image, stage.black, bases[-1])
    for engine, one in zip(engines, bases, strict=True):
        goals = goals_s if engine is first else (None, None)
        yield from _of_base(stage, engine, goals[0], _gap(one, bases[-1]))
        full = timed(partial(stage.solved, engine, target, needed), repeats=REPEATS)
        how = f"{full}; {needed} sweeps from where a solve starts; the best is that of {BEST_SWEEPS}"
        yield _row(f"full appearance, to {NEAR_ENOUGH:g}", engine, full.minimum, goals[1], how)
        began = time.perf_counter()
        sweeps = stage.solved(engine, target).iterations
        seconds = time.perf_counter() - began
        yield _row("full appearance, as it stops by itself", engine, seconds, how=f"{sweeps} sweeps")
        scaled = timed(
            partial(scale_frames, stage.transport, base, target, stage.black, engine=engine), repeats=REPEATS
        )
        yield _row("base times scale, float frames", engine, scaled.minimum, how=str(scaled))


def _of_base(stage: Stage, engine: Engine, goal_s: float | None, gap: str) -> Iterator[Row]:
    few, more = (timed(partial(stage.solved, engine, stage.image, n), repeats=REPEATS).minimum for n in (FEW, MORE))
    yield _row("a sweep over the projectors", engine, (more - few) / (MORE - FEW))
    nothing = timed(partial(stage.solved, engine, stage.image, 0), repeats=REPEATS)
    yield _row("a base without its sweeps", engine, nothing.minimum, how=str(nothing))
    whole = timed(partial(stage.solved, engine, stage.image), repeats=REPEATS)
    yield _row("base, as it stops by itself", engine, whole.minimum, goal_s, f"{whole}; {gap}")


def _least(enough: Callable[[int], bool]) -> int:
    """The least number of sweeps that is enough; more are, too."""
    high = 1
    while not enough(high):
        high *= 2
    low = high // 2
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if enough(middle) else (middle, high)
    return high


def _gap(one: Solution, other: Solution) -> str:
    squares = [float(np.mean((a - b) ** 2)) for a, b in zip(one.frames, other.frames, strict=True)]
    return (
        f"{one.iterations} sweeps, {other.iterations} on the processor; objective "
        f"{one.objective / other.objective - 1:+.1e} of the processor's; frames apart by "
        f"{float(np.sqrt(np.mean(squares))):.1e} rms"
    )


def _row(what: str, engine: Engine, seconds: float, goal_s: float | None = None, how: str = "") -> Row:
    return at_most(f"{what}: {engine.name}", seconds, goal_s, unit="s", how=how)
