"""The equations of a bounded solve, their smoothness and weights, where it starts, and its objective.

Smoothness between adjacent pixels of one projector (paper 2.4, eq. 3): superimposed projectors leave many ways to make
the same image; these equations choose the one without noise. Each asks two adjacent pixels to be equal, and is weighted
down where the target or the object changes between them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from numba import prange

from controller.config.defaults import SMOOTHNESS
from controller.core import channels
from controller.core.arrays import FloatImage, Mask
from controller.core.jit import compiled
from controller.optics.solve.bounded.gradient import EdgeWeights, add_smoothness_to_majoriser, inner, weighted_residual
from controller.optics.solve.bounded.initial_estimate import block_means, blocks_of, initial_estimate, white_light
from controller.optics.transport import LightTransport
from controller.optics.transport.planes import planes_above

TOLERANCE: Final = 3e-5
"""Default KKT residual. The objective is then within 1.7e-3 of its limit on synthetic stages up to that of the paper,
and within 1e-2 on a calibrated one: there the last per cent is about which projector gives the light (decision 8)."""
APPEARANCE_TOLERANCE: Final = 1.5e-4
"""KKT residual at which an appearance is done, in half of the sweeps: those on to 1e-4, a sixth more, change the median
of CIEDE2000 by less than 0.01 and its 95th percentile by less than 0.02 (docs/decisions/0008)."""
MOST_ITERATIONS: Final = 1000
FIRST_TOLERANCE: Final = 2.0
"""In tolerances, before a target is corrected: after it there is no momentum, most of the KKT residual by then."""
Correction = Callable[[Sequence[FloatImage]], FloatImage]
"""From the frames for a target, what to aim at instead: a radiance (rows, columns, 3)."""


@dataclass(frozen=True, slots=True)
class Problem:
    """Data of one solve on planes; smoothness is already scaled by its strength.

    ``picture``, ``black`` (camera rows, columns, 3): what is wanted, and the black image; not copies
    ``weights`` (camera rows, columns): 0 off the object
    ``right_hand_side``: D' w target, a buffer; ``blocks`` (3, rows, columns): means of the target's light over blocks
    ``across``, ``down`` (3, pixels of all projectors) uint16: squared weights of the smoothness edges to the right
    and lower neighbour, in steps of 1 / EDGE_WEIGHT_STEPS
    ``strength_per_step``: factor in the objective of an edge whose stored weight is 1
    ``majoriser`` (3, pixels): the diagonal that bounds each projector's own Hessian, 0 where a pixel lights nothing
    """

    transport: LightTransport
    picture: FloatImage
    black: FloatImage
    weights: FloatImage
    right_hand_side: FloatImage
    blocks: FloatImage
    across: EdgeWeights
    down: EdgeWeights
    strength_per_step: float
    majoriser: FloatImage

    def aimed_at(self, picture: FloatImage) -> Problem:
        """The same with another ``picture`` that is nearly alike: weights, smoothness and majoriser stay."""
        light = planes_above(picture, self.black)
        return replace(self, picture=picture, right_hand_side=self.transport.right_hand_side(light, self.weights))

    def target(self) -> FloatImage:
        """(3, camera rows, columns): the light to be made. A new array each time: a sweep does not need it."""
        return planes_above(self.picture, self.black)


@dataclass(frozen=True, slots=True, eq=False)
class SolveSettings:
    """How a solve is done.

    ``smoothness``: >= 0, relative to the mean of the data's majorising diagonal
    ``weights`` (rows, columns) >= 0: how much each camera pixel counts; None: 1 everywhere
    ``start``: frames to start from, for example those of a similar target; None: ``initial_estimate``
    ``tolerance``: stop when the rms scaled projected gradient step falls below it
    ``most_iterations``: and at the latest after so many sweeps
    ``correction``: of the target, to be made once there are frames for it
    """

    smoothness: float = SMOOTHNESS
    weights: FloatImage | None = None
    start: Sequence[FloatImage] | None = None
    tolerance: float = TOLERANCE
    most_iterations: int = MOST_ITERATIONS
    correction: Correction | None = None


DEFAULT_SETTINGS: Final = SolveSettings()


@dataclass(frozen=True, slots=True)
class SolveInput:
    """What an engine is asked to solve; ``solver.solve_bounded`` says what each means, and has checked it."""

    transport: LightTransport
    target: FloatImage
    black: FloatImage
    smoothness: float
    weights: FloatImage | None
    start: Sequence[FloatImage] | None
    correction: Correction | None = None


@dataclass(frozen=True, slots=True)
class Solution:
    """Result of a solve.

    ``frames``: one (rows, columns, 3) float32 linear image a projector, in [0, 1]
    ``objective``: weighted squared residual plus smoothness, in camera units squared. The residual is of the pixels
    of ``transport.object_mask`` alone: what is wanted beside them adds the same to every solution
    ``kkt``: rms of the last projected, scaled gradient step, in units of projector light; 0 at the optimum
    ``converged``: the KKT residual fell below the tolerance before the cap on iterations
    """

    frames: tuple[FloatImage, ...]
    objective: float
    kkt: float
    iterations: int
    seconds: float
    converged: bool


BEYOND_REACH: Final = 0.2
"""A pixel that can't be right anyway must not spoil its neighbours, but should still look as near as it can."""
DARKNESS_EXPONENT: Final = 0.7
"""Between even weights (0) and the squared slope of L* (4/3): measured on the demo's targets, it gives the lowest 95th
percentile of CIEDE2000 for no loss in the median."""
DARKEST: Final = 0.02


def appearance_weights(target: FloatImage, reachable: Mask, white: float) -> FloatImage:
    """Weights (rows, columns) float32 of mean 1: more for the dark, where the eye sees a difference sooner.

    ``target`` (rows, columns, 3) radiance; ``white`` its white, > 0; ``reachable`` as ``solve.feasibility`` finds it
    """
    light = channels.mean(target) / np.float32(white) + np.float32(DARKEST)
    weights = light ** np.float32(-DARKNESS_EXPONENT) * np.where(reachable, 1, BEYOND_REACH)
    return np.asarray(weights / weights.mean(dtype=np.float64), np.float32)


EDGE_WEIGHT_STEPS: Final = 65535
"""Squared weights, 0 to 1, are kept in so many steps: 2 bytes instead of 4, and at most 1/131070 off."""


def squared_edge_weights(transport: LightTransport, wanted: FloatImage) -> tuple[EdgeWeights, EdgeWeights]:
    """alpha squared for all projectors; alpha is 0 beside a pixel that contributes nothing (paper 2.4, eq. 3).

    ``wanted`` (3, camera rows, columns): the light to be made, without the black image. Returns two arrays (3, pixels)
    in steps of 1 / EDGE_WEIGHT_STEPS: from each pixel to its right neighbour, and to the one below; 0 at the last
    column and row.
    """
    across, down = (np.zeros((3, transport.pixels), np.uint16) for _ in range(2))
    target, white = transport.gaussian_mean_planes(wanted), white_light(transport)
    for n, size in enumerate(transport.sizes):
        _write_edge_weights(target, white.observed, white.faint[n], transport.span(n).start, *size, across, down)
    return across, down


@compiled()
def _edge_weight(target: float, observed: float, other: float, other_observed: float, faint: float) -> int:
    """alpha^2 of eq. 3 between two adjacent pixels, in steps of 1 / ``EDGE_WEIGHT_STEPS``; 0 beside faint light."""
    if observed <= faint or other_observed <= faint:
        return 0
    a, b = target / observed, other / other_observed
    larger = max(a, b)
    alpha = min(a, b) / larger if larger > 0 else 1.0
    return int(EDGE_WEIGHT_STEPS * alpha * alpha + 0.5)


@compiled(parallel=True)
def _write_edge_weights(
    target: FloatImage,
    observed: FloatImage,
    faint: float,
    start: int,
    rows: int,
    columns: int,
    across: EdgeWeights,
    down: EdgeWeights,
) -> None:
    """The squared weights of one projector; all arrays (3, pixels of all projectors)."""
    for y in prange(rows):
        for c in range(3):
            for x in range(columns):
                i = start + y * columns + x
                here, seen = target[c, i], observed[c, i]
                if x + 1 < columns:
                    across[c, i] = _edge_weight(here, seen, target[c, i + 1], observed[c, i + 1], faint)
                if y + 1 < rows:
                    below = i + columns
                    down[c, i] = _edge_weight(here, seen, target[c, below], observed[c, below], faint)


def build_problem(
    transport: LightTransport, target: FloatImage, black: FloatImage, smoothness: float, weights: FloatImage | None
) -> Problem:
    """The equations of a solve; the parameters are those of ``solve_bounded``, which has checked them."""
    counted = transport.counts()
    if weights is not None:
        counted *= weights
    white_light(transport)  # while no other picture is in memory
    light = planes_above(target, black)
    across, down = squared_edge_weights(transport, light)
    blocks = np.empty((3, *blocks_of(transport.camera_shape)), np.float32)
    block_means(light, blocks)
    right_hand_side = transport.right_hand_side(light, counted)
    del light
    diagonal, scale = _majoriser(transport, counted)
    if transport.beside is not None:
        # A pixel without data stays dark: what little it lights of the object is not worth light on the wall.
        diagonal[:, transport.beside] = 0
    strength_per_step = smoothness * scale / EDGE_WEIGHT_STEPS
    for n, (rows, columns) in enumerate(transport.sizes):
        add_smoothness_to_majoriser(diagonal, across, down, strength_per_step, transport.span(n).start, rows, columns)
    return Problem(
        transport, target, black, counted, right_hand_side, blocks, across, down, strength_per_step, diagonal
    )


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
    x = initial_estimate(problem.transport, problem.blocks)
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
