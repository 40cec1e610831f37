"""The equations of a bounded solve, where it starts, and its objective."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from controller.core.arrays import FloatImage
from controller.optics.solve.bounded.gradient import add_smoothness_to_majoriser, inner, weighted_residual
from controller.optics.solve.bounded.initial_estimate import initial_estimate
from controller.optics.solve.bounded.problem import Problem
from controller.optics.solve.bounded.smoothness import EDGE_WEIGHT_STEPS, squared_edge_weights
from controller.optics.transport import LightTransport
from controller.optics.transport.planes import planes_above


def build_problem(
    transport: LightTransport, target: FloatImage, black: FloatImage, smoothness: float, weights: FloatImage | None
) -> Problem:
    """The equations of a solve; the parameters are those of ``solve_bounded``, which has checked them."""
    counted = transport.object_mask.astype(np.float32)
    if weights is not None:
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
