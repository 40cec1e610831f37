"""What an engine does, and the one that every computer has."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from controller.core.arrays import FloatImage
from controller.solve.bounded.descent import IterationControl, block_coordinate_descent
from controller.solve.bounded.gradient import scale_base
from controller.solve.bounded.problem import Problem
from controller.transport import LightTransport


class Engine(Protocol):
    """The heavy loops of solving and scaling. All engines solve the same problem, to the same KKT residual.

    ``name``: what does the work, for people
    """

    name: str

    def descend(self, problem: Problem, x: FloatImage, control: IterationControl) -> tuple[FloatImage, float, int]:
        """Sweep from ``x`` (3, pixels), which is overwritten; returns the last point, its KKT residual and the sweeps.

        Raises WorkError("solve-cancelled").
        """

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

    def descend(self, problem: Problem, x: FloatImage, control: IterationControl) -> tuple[FloatImage, float, int]:
        """As ``Engine.descend``."""
        return block_coordinate_descent(problem, x, control)

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
