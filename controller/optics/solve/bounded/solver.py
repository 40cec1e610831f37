"""Compensation images by a global, bounded, smooth least-squares solve (paper 2.2-2.4, eqs 2 and 3).

Minimise  sum_u w_u |T p + K - C|^2  +  s sum over adjacent pixels of alpha^2 (p_i - p_j)^2   subject to 0 <= p <= 1
by accelerated projected gradient, one projector after the other (``engine``, docs/decisions/0008). T is (nearly)
non-negative, so the row sums |T_n|' w |T_n| 1 majorise the data part of the Hessian of projector n, and give every one
of its pixels a step of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

import numpy as np

from controller.config.defaults import SMOOTHNESS
from controller.core.arrays import FloatImage
from controller.core.checks import all_finite, check_image
from controller.core.errors import UsageError
from controller.optics.solve.bounded.engine import Engine, IterationControl, Processor
from controller.optics.solve.bounded.equations import Solution, SolveInput
from controller.optics.transport import LightTransport

TOLERANCE: Final = 3e-5
"""Default KKT residual. The objective is then within 1e-3 of its limit on a synthetic stage, and within 1e-2 on a
calibrated one, where the last per cent is about which projector gives the light (docs/decisions/0004)."""
MOST_ITERATIONS: Final = 1000


def check_target(transport: LightTransport, target: FloatImage) -> None:
    """Raise UsageError "image-wrong-size" or "target-not-finite" unless ``target`` can be a camera image here."""
    check_image("target", target, (*transport.camera_shape, 3))


def solve_bounded(
    transport: LightTransport,
    target: FloatImage,
    black: FloatImage,
    *,
    smoothness: float = SMOOTHNESS,
    weights: FloatImage | None = None,
    start: Sequence[FloatImage] | None = None,
    tolerance: float = TOLERANCE,
    most_iterations: int = MOST_ITERATIONS,
    progress: Callable[[int, float], None] | None = None,
    cancelled: Callable[[], bool] | None = None,
    engine: Engine | None = None,
) -> Solution:
    """Find the projectors' images that make the camera see ``target``.

    Parameters
    ----------
    target, black : (rows, columns, 3) linear camera units; the target is raised to ``black`` where it is darker
    smoothness : >= 0, relative to the mean of the data's majorising diagonal
    weights : (rows, columns) >= 0, how much each camera pixel counts; default 1 everywhere
    start : frames to start from, for example those of a similar target
    tolerance : stop when the rms scaled projected gradient step falls below it
    progress : called with (iteration, kkt); ``cancelled`` : asked once an iteration, or once in a few of them
    engine : what does the sweeps (``solve.engines``); None: the processor

    Raises
    ------
    UsageError  "image-wrong-size", "target-not-finite", "solve-arguments"
    WorkError   "solve-cancelled"
    """
    given = SolveInput(transport, target, black, smoothness, weights, start)
    check_input(given)
    control = IterationControl(tolerance, most_iterations, progress, cancelled)
    return (engine or Processor()).solve(given, control)


def check_input(given: SolveInput) -> None:
    """Raise UsageError "image-wrong-size", "target-not-finite" or "solve-arguments" for what can't be solved."""
    check_target(given.transport, given.target)
    black, weights, start = given.black, given.weights, given.start
    if black.shape != given.target.shape or not all_finite(black):
        raise _wrong("the black image is not finite or does not have the target's size")
    if not 0 <= given.smoothness < np.inf:
        raise _wrong(f"a smoothness of {given.smoothness} is not a number of at least 0")
    if weights is not None:
        size = given.target.shape[:2]
        if weights.shape != size or not all_finite(weights) or weights.min(initial=0) < 0:
            raise _wrong("the weights are not finite numbers of at least 0, one for each camera pixel")
    if start is not None and [frame.shape for frame in start] != [(*size, 3) for size in given.transport.sizes]:
        raise _wrong("the start frames do not have the projectors' sizes")


def _wrong(what: str) -> UsageError:
    return UsageError("solve-arguments", what=f"The solve can't start: {what}.", remedy="Correct it and solve again.")


__all__ = ["MOST_ITERATIONS", "SMOOTHNESS", "TOLERANCE", "check_input", "check_target", "solve_bounded"]
