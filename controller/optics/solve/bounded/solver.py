"""Compensation images by a global, bounded, smooth least-squares solve (paper 2.2-2.4, eqs 2 and 3).

Minimise  sum_u w_u |T p + K - C|^2  +  s sum over adjacent pixels of alpha^2 (p_i - p_j)^2   subject to 0 <= p <= 1
by accelerated projected gradient, one projector after the other (``engine``, docs/decisions/0008). T is (nearly)
non-negative, so the row sums |T_n|' w |T_n| 1 majorise the data part of the Hessian of projector n, and give every one
of its pixels a step of its own.
"""

from __future__ import annotations

import numpy as np

from controller.core.arrays import FloatImage
from controller.core.checks import all_finite, check_image
from controller.core.errors import UsageError
from controller.optics.solve.bounded.engine import ALONE, IterationControl, Processor, SolveContext
from controller.optics.solve.bounded.equations import DEFAULT_SETTINGS, Solution, SolveInput, SolveSettings
from controller.optics.transport import LightTransport


def check_target(camera_shape: tuple[int, ...], target: FloatImage) -> None:
    """Raise UsageError "image-wrong-size" or "target-not-finite" unless ``target`` can be a camera image here."""
    check_image("target", target, (*camera_shape, 3))


def solve_bounded(
    transport: LightTransport,
    target: FloatImage,
    black: FloatImage,
    settings: SolveSettings = DEFAULT_SETTINGS,
    context: SolveContext = ALONE,
) -> Solution:
    """Find the projectors' images that make the camera see ``target``.

    ``target``, ``black`` (rows, columns, 3): linear camera units; the target is raised to ``black`` where it is darker

    Raises
    ------
    UsageError  "image-wrong-size", "target-not-finite", "solve-arguments"
    WorkError   "solve-cancelled"
    """
    chosen = settings.smoothness, settings.weights, settings.start, settings.correction
    given = SolveInput(transport, target, black, *chosen)
    check_input(given)
    control = IterationControl(settings.tolerance, settings.most_iterations, context.progress, context.cancelled)
    return (context.engine or Processor()).solve(given, control)


def check_input(given: SolveInput) -> None:
    """Raise UsageError "image-wrong-size", "target-not-finite" or "solve-arguments" for what can't be solved."""
    check_target(given.transport.camera_shape, given.target)
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
