"""What an engine does, and the one that every computer has."""

from __future__ import annotations

import time
from typing import Protocol

import numpy as np

from controller.core.arrays import FloatImage
from controller.optics.solve.bounded.descent import IterationControl, block_coordinate_descent
from controller.optics.solve.bounded.equations import build_problem, initial_point, objective_of
from controller.optics.solve.bounded.gradient import scale_base
from controller.optics.solve.bounded.problem import Solution, SolveInput
from controller.optics.transport import LightTransport
from controller.optics.transport.planes import frame_planes, plane_frames


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
        x, kkt, iterations = block_coordinate_descent(problem, x, control)
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
