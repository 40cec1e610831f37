"""What an engine does, and the one that every computer has: block coordinate descent over the projectors
(paper eqs 2 and 3).

A sweep is one Gauss-Seidel pass: each projector takes a projected gradient step against what the others show by then,
scaled by a diagonal preconditioner that bounds its own part of the Hessian alone; with n projectors alike that is n
times as far as a step of all at once could go. Momentum carries on from sweep to sweep, with over-relaxation by part of
the sweep's own step (Kim and Fessler 2016), and restarts where it points uphill (O'Donoghue and Candes 2015). What the
constants are worth: docs/decisions/0008.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Protocol

import numpy as np

from controller.core.arrays import FloatImage
from controller.core.errors import WorkError
from controller.optics.solve.bounded.equations import (
    FIRST_TOLERANCE,
    Problem,
    Solution,
    SolveInput,
    build_problem,
    initial_point,
    objective_of,
)
from controller.optics.solve.bounded.gradient import extrapolate, extrapolate_buffer, projected_step, scale_base
from controller.optics.transport import LightTransport
from controller.optics.transport.planes import frame_planes, plane_frames

MOST_GROWTH: Final = 5.0
"""Without momentum sweeps never go uphill; with it nothing is proven, so it ends where the residual grows as much."""
OVERRELAXATION: Final = 0.9
"""Part of a sweep's step that is taken once more: 1 is optimal for steps of all at once, and too far from 1.2 on."""
RECOMPUTE_EVERY: Final = 50
"""Sweeps until light is computed from the frames again: sums of steps drift, by 1e-4 of the objective in 1000."""


@dataclass(frozen=True, slots=True)
class IterationControl:
    """When to stop, and what to call each sweep; see ``SolveSettings`` and ``SolveContext``.

    ``on_iterate`` gets each sweep's number and point (3, pixels), to be read before it returns
    """

    tolerance: float
    most_iterations: int
    progress: Callable[[int, float], None] | None = None
    cancelled: Callable[[], bool] | None = None
    on_iterate: Callable[[int, FloatImage], None] | None = None


def block_coordinate_descent(
    problem: Problem, x: FloatImage, control: IterationControl
) -> tuple[FloatImage, float, int]:
    """Sweep from ``x`` (3, pixels), which is overwritten; returns the last point, its KKT residual and the sweeps."""
    transport = problem.transport
    # buffers of light: of the point x, of the extrapolated point y, of y before the sweep
    light, light_y, before, residual = (transport.sensor_buffer() for _ in range(4))
    y, step = x.copy(), np.empty_like(x)
    total = _total(problem)
    inertia, kkt, least, iteration = 1.0, np.inf, np.inf, 0
    for iteration in range(1, control.most_iterations + 1):
        if control.cancelled is not None and control.cancelled():
            raise WorkError("solve-cancelled", what="The solve was stopped.", remedy="Start it again to repeat it.")
        squared_step = uphill = 0.0
        if iteration % RECOMPUTE_EVERY == 1:
            _write_forward(transport, x, light)
            light_y[:] = light
            if iteration > 1:
                _write_forward(transport, y, light_y)
            before[:] = light_y
        for n in range(len(transport.sizes)):
            transport.normal_residual(light_y, problem.weights, problem.right_hand_side, residual)
            transport.adjoint_of_buffer(n, residual, step)
            a, b = _projected_step(problem, n, y, x, step)
            squared_step, uphill = squared_step + a, uphill + b
            transport.accumulate_forward(n, step, light_y)
        kkt = float(np.sqrt(squared_step / total))
        next_inertia = (1 + np.sqrt(1 + 4 * inertia**2)) / 2
        momentum, overrelaxation = (inertia - 1) / next_inertia, OVERRELAXATION * inertia / next_inertia
        inertia = next_inertia
        least = min(least, kkt)
        if uphill > 0 or kkt > MOST_GROWTH * least:
            momentum, overrelaxation, inertia = 0.0, 0.0, 1.0
        extrapolate(y, x, step, momentum, overrelaxation)
        if control.on_iterate is not None:
            control.on_iterate(iteration, x)
        # the buffers follow: ``light_y`` is the light of the new point by now, and becomes that of y
        extrapolate_buffer(light_y, light, before, momentum, overrelaxation)
        if control.progress is not None:
            control.progress(iteration, kkt)
        if kkt <= control.tolerance:
            break
    return x, kkt, iteration


def kkt_residual(problem: Problem, x: FloatImage) -> float:
    """The KKT residual at ``x`` (3, pixels): of one step of each projector from there, the others being as they are."""
    transport = problem.transport
    light, residual, step = transport.sensor_buffer(), transport.sensor_buffer(), np.empty_like(x)
    _write_forward(transport, x, light)
    transport.normal_residual(light, problem.weights, problem.right_hand_side, residual)
    squared_step = 0.0
    for n in range(len(transport.sizes)):
        transport.adjoint_of_buffer(n, residual, step)
        squared_step += _projected_step(problem, n, x, x, step)[0]
    return float(np.sqrt(squared_step / _total(problem)))


def _projected_step(problem: Problem, n: int, y: FloatImage, x: FloatImage, step: FloatImage) -> tuple[float, float]:
    """``projected_step`` of projector ``n``."""
    rows, columns = problem.transport.sizes[n]
    start, segment = problem.transport.span(n).start, problem.transport.segment(n)
    smoothness = problem.majoriser, problem.across, problem.down, problem.strength_per_step
    return projected_step(y, x, step, *smoothness, start, rows, columns, segment)


def _total(problem: Problem) -> float:
    return max(float(problem.majoriser.sum(dtype=np.float64)), np.finfo(np.float64).tiny)


def _write_forward(transport: LightTransport, x: FloatImage, buffer: FloatImage) -> None:
    """Write the light of ``x`` (3, pixels) to a sensor buffer."""
    buffer[:] = 0
    for n in range(len(transport.sizes)):
        transport.accumulate_forward(n, x, buffer)


def first_control(given: SolveInput, control: IterationControl) -> IterationControl:
    """Until when to sweep for the target as it is given."""
    return control if given.correction is None else replace(control, tolerance=FIRST_TOLERANCE * control.tolerance)


def corrected(engine: Engine, given: SolveInput, control: IterationControl) -> SolveInput:
    """``given`` with its correction made, where it has one, for engines that solve from the start again."""
    if given.correction is None:
        return given
    first = engine.solve(replace(given, correction=None), first_control(given, control))
    return replace(given, target=given.correction(first.frames), start=first.frames, correction=None)


class Engine(Protocol):
    """The heavy loops of solving and scaling. All engines solve the same problem, to the same KKT residual.

    ``name``: what does the work, for people; ``worked``: the name of what did the last of it, which is the processor
    where a device refuses
    """

    name: str

    @property
    def worked(self) -> str: ...

    def solve(self, given: SolveInput, control: IterationControl) -> Solution:
        """What ``solver.solve_bounded`` finds. Raises WorkError("solve-cancelled")."""

    def scaled(
        self, transport: LightTransport, light: FloatImage, inverse: FloatImage, mixed: FloatImage, coverage: FloatImage
    ) -> FloatImage:
        """Frames (3, pixels) in [0, 1] by base times scale (paper eqs 4-6).

        ``light`` (3, rows, columns): the target's, without the black image; overwritten. ``inverse``, ``mixed`` and
        ``coverage``: those of ``appearance.Base``, which an engine may keep; not to be written to
        """


@dataclass(frozen=True, slots=True)
class SolveContext:
    """What a solve runs in.

    ``engine``: what does the heavy loops (``solve.engines``); None: the processor
    ``progress``: called with (iteration, kkt); ``cancelled``: asked once an iteration, or once in a few of them
    ``folder``: for nameless files of what need not stay in memory during a solve; None: it stays there
    """

    engine: Engine | None = None
    progress: Callable[[int, float], None] | None = None
    cancelled: Callable[[], bool] | None = None
    folder: Path | None = None


ALONE: Final = SolveContext()
"""On the processor, in memory, from beginning to end."""


class Processor:
    """The engine of compiled loops on the processor's cores."""

    name = "processor"
    worked = name

    def solve(self, given: SolveInput, control: IterationControl) -> Solution:
        """As ``Engine.solve``."""
        began_s = time.perf_counter()
        transport = given.transport
        problem = build_problem(transport, given.target, given.black, given.smoothness, given.weights)
        x = initial_point(problem) if given.start is None else np.clip(frame_planes(given.start), 0, 1)
        x[problem.majoriser == 0] = 0
        x, kkt, iterations = block_coordinate_descent(problem, x, first_control(given, control))
        if given.correction is not None:
            problem = problem.aimed_at(given.correction(plane_frames(x, transport.sizes)))
            x, kkt, more = block_coordinate_descent(problem, x, control)
            iterations += more
        objective = objective_of(problem, x, transport.forward_planes(x))
        del problem
        frames = tuple(plane_frames(x, transport.sizes))
        return Solution(frames, objective, kkt, iterations, time.perf_counter() - began_s, kkt <= control.tolerance)

    def scaled(
        self, transport: LightTransport, light: FloatImage, inverse: FloatImage, mixed: FloatImage, coverage: FloatImage
    ) -> FloatImage:
        """As ``Engine.scaled``."""
        light *= inverse
        means = transport.gaussian_mean_planes(light)
        out = means
        for n, M in enumerate(transport.mixing):
            start, end = transport.span(n).start, transport.span(n).stop
            unmix = np.linalg.inv(M.astype(np.float64)).astype(np.float32)
            scale_base(mixed, means, coverage, unmix, start, end, out)
            if transport.segment(n):
                out[:, start:end] = _saturated(out[:, start:end], transport.segment(n))
        return out


def _saturated(planes: FloatImage, segment: float) -> FloatImage:
    """Frames (3, pixels) as a projector with a white segment shows them: saturated colours end earlier."""
    top = 1 - segment * (1 - planes.min(axis=0))
    return np.minimum(planes, np.asarray(top, np.float32))
