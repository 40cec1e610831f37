"""A solve whose objective is looked at after every sweep: when was it how near to the best that is known?"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from controller.config.defaults import SMOOTHNESS
from controller.core.arrays import FloatImage
from controller.core.errors import WorkError
from controller.optics.solve.bounded.engine import IterationControl, block_coordinate_descent
from controller.optics.solve.bounded.equations import Problem, build_problem, initial_point, objective_of
from controller.optics.transport import LightTransport
from controller.optics.transport.planes import frame_planes
from lab.timings import Timing


@dataclass(frozen=True, slots=True)
class Sweep:
    """Seconds and processor seconds since the solve began, without those of looking; the objective and KKT residual."""

    seconds: float
    processor_s: float
    objective: float
    kkt: float


@dataclass(frozen=True, slots=True)
class Trace:
    """``setup``: before the first sweep; ``sweeps``: after each."""

    setup: Sweep
    sweeps: list[Sweep]

    @property
    def best(self) -> float:
        """The least objective: an upper bound of the optimum, so gaps to it are lower bounds of the true ones."""
        return min(sweep.objective for sweep in self.sweeps)

    def reached(self, objective: float) -> tuple[int, Sweep]:
        """The number of sweeps, and the first of them, after which the objective is no higher; the last if none is."""
        for number, sweep in enumerate(self.sweeps, 1):
            if sweep.objective <= objective:
                return number, sweep
        return len(self.sweeps), self.sweeps[-1]

    @property
    def sweep(self) -> Timing:
        """Seconds of one sweep."""
        seconds = np.diff([self.setup.seconds, *(sweep.seconds for sweep in self.sweeps)])
        return Timing(float(seconds.min()), float(np.median(seconds)), float(seconds.max()))


def traced(
    transport: LightTransport,
    target: FloatImage,
    black: FloatImage,
    sweeps: int,
    *,
    start: Sequence[FloatImage] | None = None,
    enough: float = -np.inf,
    most_s: float = np.inf,
) -> Trace:
    """Solve as ``solve_bounded`` does, for so many sweeps, or until the objective is ``enough`` or the time is over."""
    began = time.perf_counter(), time.process_time()
    problem = build_problem(transport, target, black, SMOOTHNESS, None)
    x = initial_point(problem) if start is None else frame_planes(start)
    x[problem.majoriser == 0] = 0
    setup = Sweep(time.perf_counter() - began[0], time.process_time() - began[1], np.inf, np.inf)
    light = np.empty((3, *transport.camera_shape), np.float32)
    found: list[Sweep] = []
    looked = [0.0, 0.0]

    def look(number: int, x: FloatImage) -> None:
        here = time.perf_counter(), time.process_time()
        spent = here[0] - began[0] - looked[0], here[1] - began[1] - looked[1]
        found.append(Sweep(*spent, _objective(problem, x, light), np.inf))
        looked[0] += time.perf_counter() - here[0]
        looked[1] += time.process_time() - here[1]

    def told(number: int, kkt: float) -> None:
        last = found[-1]
        found[-1] = Sweep(last.seconds, last.processor_s, last.objective, kkt)

    def over() -> bool:
        return bool(found) and (found[-1].objective <= enough or time.perf_counter() - began[0] > most_s)

    _descend(problem, x, IterationControl(0, sweeps, progress=told, cancelled=over, on_iterate=look))
    return Trace(setup, found)


def _descend(problem: Problem, x: FloatImage, control: IterationControl) -> None:
    try:
        block_coordinate_descent(problem, x, control)
    except WorkError as stopped:
        if stopped.code != "solve-cancelled":
            raise


def _objective(problem: Problem, x: FloatImage, light: FloatImage) -> float:
    problem.transport.forward_planes(x, out=light)
    return objective_of(problem, x, light)
