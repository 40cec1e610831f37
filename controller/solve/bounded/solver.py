"""Compensation images by a global, bounded, smooth least-squares solve (paper 2.2-2.4, eqs 2 and 3).

Minimise  sum_u w_u |T p + K - C|^2  +  s sum over adjacent pixels of alpha^2 (p_i - p_j)^2   subject to 0 <= p <= 1
by accelerated projected gradient, one projector after the other (``descent``, docs/decisions/0022, 0025). T is (nearly)
non-negative, so the row sums |T_n|' w |T_n| 1 majorise the data part of the Hessian of projector n, and give every one
of its pixels a step of its own.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from controller.core.arrays import FloatImage
from controller.core.checks import check_image
from controller.core.errors import UsageError
from controller.solve.bounded.descent import IterationControl
from controller.solve.bounded.gradient import add_smoothness_to_majoriser, inner, weighted_residual
from controller.solve.bounded.initial_estimate import initial_estimate
from controller.solve.bounded.problem import Problem
from controller.solve.bounded.smoothness import EDGE_WEIGHT_STEPS, squared_edge_weights
from controller.solve.engines.processor import Engine, Processor
from controller.transport import LightTransport
from controller.transport.planes import frame_planes, plane_frames, plane_image, planes_above

SMOOTHNESS: Final = 0.001
"""Default strength of smoothness, relative to the mean diagonal of the data's majoriser. On a disturbed synthetic stage
the edges kept (eq. 9) peak between 0.003 and 0.01; colour noise falls up to 0.03, at the cost of detail."""
TOLERANCE: Final = 3e-5
"""Default KKT residual. The objective is then within 1e-3 of its limit on a synthetic stage, and within 1e-2 on a
calibrated one, where the last per cent is about which projector gives the light (docs/decisions/0055)."""
MOST_ITERATIONS: Final = 1000


@dataclass(frozen=True, slots=True)
class Solution:
    """Result of a solve.

    ``frames``: one (rows, columns, 3) float32 linear image a projector, in [0, 1]
    ``light`` (camera rows, columns, 3) float32: T p, the frames' light without the black image
    ``objective``: weighted squared residual plus smoothness, in camera units squared
    ``kkt``: rms of the last projected, scaled gradient step, in units of projector light; 0 at the optimum
    ``converged``: the KKT residual fell below the tolerance before the cap on iterations
    """

    frames: tuple[FloatImage, ...]
    light: FloatImage
    objective: float
    kkt: float
    iterations: int
    seconds: float
    converged: bool


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
    engine : what does the sweeps (``engines``); None: the processor

    Raises
    ------
    UsageError  "image-wrong-size", "target-not-finite", "solve-arguments"
    WorkError   "solve-cancelled"
    """
    began = time.perf_counter()
    check_target(transport, target)
    problem = build_problem(transport, target, black, smoothness, weights)
    if start is None:
        x = initial_point(problem)
    else:
        x = np.clip(frame_planes(start), 0, 1)
        if x.shape != problem.majoriser.shape:
            raise _wrong("the start frames do not have the projectors' sizes")
    x[problem.majoriser == 0] = 0
    control = IterationControl(tolerance, most_iterations, progress, cancelled)
    x, kkt, iterations = (engine or Processor()).descend(problem, x, control)
    light = transport.forward_planes(x)
    objective = objective_of(problem, x, light)
    del problem
    frames = tuple(plane_frames(x, transport.sizes))
    seconds = time.perf_counter() - began
    return Solution(frames, plane_image(light), objective, kkt, iterations, seconds, kkt <= tolerance)


def _wrong(what: str) -> UsageError:
    return UsageError("solve-arguments", what=f"The solve can't start: {what}.", remedy="Correct it and solve again.")


def build_problem(
    transport: LightTransport, target: FloatImage, black: FloatImage, smoothness: float, weights: FloatImage | None
) -> Problem:
    """The equations of a solve, checked; the parameters are those of ``solve_bounded``."""
    if black.shape != target.shape or not np.isfinite(black).all():
        raise _wrong("the black image is not finite or does not have the target's size")
    if not 0 <= smoothness < np.inf:
        raise _wrong(f"a smoothness of {smoothness} is not a number of at least 0")
    counted = transport.object_mask.astype(np.float32)
    if weights is not None:
        if weights.shape != counted.shape or not np.isfinite(weights).all() or weights.min(initial=0) < 0:
            raise _wrong("the weights are not finite numbers of at least 0, one for each camera pixel")
        counted *= weights
    across, down = squared_edge_weights(transport, planes_above(target, black))
    diagonal, scale = _majoriser(transport, counted)
    if transport.beside is not None:
        # A pixel without data stays dark: what little it lights of the object is not worth light on the wall.
        diagonal[:, transport.beside] = 0
    strength_per_step = smoothness * scale / EDGE_WEIGHT_STEPS
    for n, (rows, columns) in enumerate(transport.sizes):
        add_smoothness_to_majoriser(diagonal, across, down, strength_per_step, transport.span(n).start, rows, columns)
    return Problem(transport, target, black, counted, across, down, strength_per_step, diagonal)


def _majoriser(transport: LightTransport, counted: FloatImage) -> tuple[FloatImage, float]:
    """The data's part of each projector's own majoriser, and the mean diagonal of that of all together."""
    magnitude = transport.with_absolute_mixing()
    ones = np.ones((3, transport.pixels), np.float32)
    diagonal = np.zeros_like(ones)
    light, reach, zero = (transport.sensor_buffer() for _ in range(3))
    weighted = np.empty_like(light)
    for n in range(len(transport.sizes)):
        light[:] = 0
        magnitude.accumulate_forward(n, ones, light)
        reach += light
        magnitude.normal_residual(light, counted, zero, weighted)
        magnitude.adjoint_of_buffer(n, weighted, diagonal)
    magnitude.normal_residual(reach, counted, zero, weighted)
    pixels = max(int(np.count_nonzero(diagonal > 0)), 1)
    # 1' T' w T 1 is the sum of all row sums
    return diagonal, inner(reach, weighted) / pixels


def _frame_view(transport: LightTransport, n: int, planes: npt.NDArray[Any]) -> npt.NDArray[Any]:
    return planes[:, transport.span(n)].reshape(3, *transport.sizes[n])


def initial_point(problem: Problem) -> FloatImage:
    """(3, pixels): the best frames for light that is smooth (``initial_estimate``); 0 where a pixel lights nothing."""
    x = initial_estimate(problem.transport, problem.target())
    x[problem.majoriser == 0] = 0
    return x


def objective_of(problem: Problem, x: FloatImage, light: FloatImage) -> float:
    """The objective at ``x`` (3, pixels), whose light T x is ``light`` (3, rows, columns)."""
    target = problem.target()
    return weighted_residual(light, target, problem.weights, target) + smoothness_term(problem, x)


def smoothness_term(problem: Problem, x: FloatImage) -> float:
    """The smoothness term of the objective at ``x`` (3, pixels)."""
    total = 0.0
    for n in range(len(problem.transport.sizes)):
        planes = (x, problem.across, problem.down)
        for frame, across, down in zip(*(_frame_view(problem.transport, n, v) for v in planes), strict=True):
            total += float((across[:, :-1] * np.diff(frame, axis=1) ** 2).sum(dtype=np.float64))
            total += float((down[:-1] * np.diff(frame, axis=0) ** 2).sum(dtype=np.float64))
    return problem.strength_per_step * total
