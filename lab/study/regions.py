"""The paper's solver: regions of the camera image, one after the other in four phases (paper 3.2, eq. 7).

The camera image is cut into regions of 16x16, each solved together with a margin around it, so that 25 % overlap. The
phases take alternate rows and columns of regions; what an earlier phase has settled is held fixed in later ones. A
region determines its own pixels; those of its margin are provisional, and its neighbours solve them again. The
regions of a phase don't touch each other, so their order does not matter. Earlier values being fixed, the result is
near the optimum, not at it: this solver is for comparison with the product's (docs/decisions/0007).

The equations of a region are cut out of the whole solve: the same T, camera blur and colour mixing included, and the
same smoothness; what the pixels that are held fixed contribute stands on the right-hand side.

A region is one small problem, min |A x - b|^2 for 0 <= x <= 1, of some hundred unknowns. ``lsq_linear`` is the
reference, of the family that the paper used; ``clarabel`` (interior point) and ``osqp`` (operator splitting) are
faster, and are imported only when asked for.
"""

from __future__ import annotations

import importlib
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, Final, TypeAlias

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from controller.core.arrays import Float64, FloatImage
from controller.core.errors import UsageError, WorkError
from controller.optics.solve.bounded.engine import (
    ALONE,
    SolveContext,
    kkt_residual,
)
from controller.optics.solve.bounded.equations import (
    DEFAULT_SETTINGS,
    Problem,
    SolveInput,
    SolveSettings,
    build_problem,
    initial_point,
    objective_of,
)
from controller.optics.solve.bounded.solver import check_input
from controller.optics.transport import LightTransport
from controller.optics.transport.planes import CameraBox, plane_frames, plane_image, planes_above

Pixels = npt.NDArray[np.int64]


def channel_groups(transport: LightTransport) -> list[tuple[int, ...]]:
    """Channels that have to be solved together: all three, or each alone where no projector mixes colours."""
    apart = all(np.count_nonzero(mixing - np.diag(np.diag(mixing))) == 0 for mixing in transport.mixing)
    return [(0,), (1,), (2,)] if apart else [(0, 1, 2)]


def box_problem(
    problem: Problem, box: CameraBox, unknown: Pixels, channels: tuple[int, ...], x: FloatImage, light: FloatImage
) -> BoxProblem:
    """The equations at the camera pixels of ``box`` for some projector pixels.

    Parameters
    ----------
    unknown : (n,) rising indices of pixels of all projectors
    channels : to be solved together; unknowns stand in the order (channel, pixel)
    x, light : (3, pixels) current values, and (3, rows, columns) T x
    """
    weights = np.sqrt(problem.weights[box.window].astype(np.float64)).ravel()
    start = x[list(channels)][:, unknown].astype(np.float64).ravel()
    A = problem.transport.submatrix(box, unknown, channels)
    window = (list(channels), *box.window)
    wanted = planes_above(problem.picture[box.window], problem.black[box.window])[list(channels)]
    missing = (wanted - light[window]).astype(np.float64).ravel()
    data_side = missing + A @ start
    scale = np.tile(weights, len(channels))
    rows = np.flatnonzero(scale)
    scale = scale[rows]
    data = sp.diags_array(scale) @ A[rows]
    S, smooth_side = _smoothness(problem, unknown, channels, x)
    matrix = sp.csr_matrix(sp.vstack([data, S]))
    return BoxProblem(matrix, np.concatenate([scale * data_side[rows], smooth_side]), start)


def _smoothness(
    problem: Problem, unknown: Pixels, channels: tuple[int, ...], x: FloatImage
) -> tuple[sp.csr_matrix[np.float64], Float64]:
    """One row alpha (p_i - p_j) for each pair of which at least one pixel is unknown (paper 2.4, eq. 3)."""
    sizes = problem.transport.sizes
    start = np.cumsum([0, *(rows * columns for rows, columns in sizes)])
    owner = np.searchsorted(start, unknown, side="right") - 1
    width = np.array([size[1] for size in problem.transport.sizes], np.int64)[owner]
    rows, columns, values, right_hand_side, count = [], [], [], [], 0
    for edges, step in ((problem.across, np.ones_like(width)), (problem.down, width)):
        before = unknown - step >= start[owner]
        pairs = np.concatenate([np.stack([unknown, unknown + step]), np.stack([unknown - step, unknown])[:, before]], 1)
        pairs = np.unique(pairs, axis=1)
        for index, c in enumerate(channels):
            here = pairs[:, edges[c, pairs[0]] > 0]
            alpha = np.sqrt(problem.strength_per_step * edges[c, here[0]].astype(np.float64))
            known = np.zeros(alpha.size)
            for pixel, sign in ((here[0], 1.0), (here[1], -1.0)):
                at = np.minimum(np.searchsorted(unknown, pixel), unknown.size - 1)
                found = unknown[at] == pixel
                rows.append(count + np.flatnonzero(found))
                columns.append(index * unknown.size + at[found])
                values.append(sign * alpha[found])
                known[~found] -= sign * alpha[~found] * x[c, pixel[~found]]
            right_hand_side.append(known)
            count += alpha.size
    entries = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
    return sp.csr_matrix(entries, shape=(count, unknown.size * len(channels))), np.concatenate(right_hand_side)


TOLERANCE: Final = 1e-8
OSQP_TOLERANCE: Final = 1e-5
"""Splitting converges slowly; this is its accuracy at the usual cost."""


@dataclass(frozen=True, slots=True)
class BoxProblem:
    """``matrix`` (equations, unknowns) sparse rows; ``right_hand_side`` (equations,); ``start`` (unknowns,)."""

    matrix: sp.csr_matrix[np.float64]
    right_hand_side: Float64
    start: Float64

    def objective(self, x: Float64) -> float:
        """|A x - b|^2."""
        return float(np.sum((self.matrix @ x - self.right_hand_side) ** 2))


BoxSolver: TypeAlias = Callable[[BoxProblem], Float64]


def solve_box(solver: str, problem: BoxProblem) -> Float64:
    """(unknowns,) in [0, 1], by the solver of that name; a plain function of plain values, to be sent anywhere.

    Raises UsageError("solver-unknown"), UsageError("solver-missing") or WorkError("region-unsolved").
    """
    if solver not in SOLVERS:
        raise UsageError(
            "solver-unknown",
            what=f"The solver {solver} for regions is unknown.",
            remedy=f"Choose one of {', '.join(SOLVERS)}.",
        )
    x = SOLVERS[solver](problem)
    if not np.isfinite(x).all():
        raise WorkError(
            "region-unsolved",
            what=f"The solver {solver} found no solution for a region of {problem.start.size} unknowns.",
            remedy="Use lsq_linear for the regions, or the global solver.",
        )
    return np.clip(x, 0, 1)


def _by_lsq_linear(problem: BoxProblem) -> Float64:
    from scipy.optimize import lsq_linear

    return np.asarray(lsq_linear(problem.matrix, problem.right_hand_side, (0, 1), tol=TOLERANCE, lsmr_tol="auto").x)


def _by_clarabel(problem: BoxProblem) -> Float64:
    clarabel = _imported("clarabel")
    quadratic, linear = _quadratic(problem)
    count = linear.size
    identity = sp.identity(count, format="csc")
    constraints = sp.vstack([identity, -identity], format="csc")
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.max_threads = 1
    # By itself it takes the plain factorisation up to some thousand unknowns, which light that mixes makes dense.
    settings.direct_solve_method = "faer"
    bounds = np.concatenate([np.ones(count), np.zeros(count)])
    cones = [clarabel.NonnegativeConeT(2 * count)]
    return np.array(clarabel.DefaultSolver(quadratic, linear, constraints, bounds, cones, settings).solve().x)


def _by_osqp(problem: BoxProblem) -> Float64:
    osqp = _imported("osqp")
    quadratic, linear = _quadratic(problem)
    count = linear.size
    solver = osqp.OSQP()
    solver.setup(
        quadratic, linear, sp.identity(count, format="csc"), np.zeros(count), np.ones(count),
        verbose=False, eps_abs=OSQP_TOLERANCE, eps_rel=OSQP_TOLERANCE, polishing=False,
    )  # fmt: skip
    solver.warm_start(x=problem.start)
    return np.array(solver.solve(raise_error=False).x)


def _quadratic(problem: BoxProblem) -> tuple[sp.csc_matrix[np.float64], Float64]:
    """The upper triangle of A'A and -A'b, scaled so that tolerances mean the same in any unit of light."""
    hessian = (problem.matrix.T @ problem.matrix).tocsc()
    scale = 1 / max(float(hessian.diagonal().mean()), np.finfo(np.float64).tiny)
    return sp.triu(hessian * scale, format="csc"), -scale * np.asarray(problem.matrix.T @ problem.right_hand_side)


def _imported(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise UsageError(
            "solver-missing",
            what=f"The solver {name} is not installed ({error}).",
            remedy=f"Install the Python package {name}, or use lsq_linear.",
        ) from error


SOLVERS: Final[Mapping[str, BoxSolver]] = {
    "lsq_linear": _by_lsq_linear,
    "clarabel": _by_clarabel,
    "osqp": _by_osqp,
}


SIZE_PX: Final = 16
OVERLAP: Final = 0.25
PHASES: Final = ((0, 0), (0, 1), (1, 0), (1, 1))
"""Rows and columns of regions, modulo 2."""


@dataclass(frozen=True, slots=True)
class RegionCut:
    """How the camera image is cut: regions of ``size_px`` camera pixels that overlap by that part.

    ``solver``: the name of one of ``SOLVERS``
    """

    solver: str = "lsq_linear"
    size_px: int = SIZE_PX
    overlap: float = OVERLAP


PAPER_CUT: Final = RegionCut()


@dataclass(frozen=True, slots=True)
class RegionSolution:
    """Result of the regions.

    ``frames``: one (rows, columns, 3) float32 linear image a projector, in [0, 1]
    ``light`` (camera rows, columns, 3) float32: T p
    ``objective``, ``kkt``: as of ``Solution``, over the whole image
    ``regions``, ``unknowns``: how many were solved, and their unknowns in all
    """

    frames: tuple[FloatImage, ...]
    light: FloatImage
    objective: float
    kkt: float
    regions: int
    unknowns: int
    seconds: float


class Regions:
    """The regions of one solve: which projector pixels belong to each, and its equations."""

    def __init__(self, problem: Problem, *, size_px: int = SIZE_PX, overlap: float = OVERLAP) -> None:
        """Raises UsageError("solve-arguments") where the margins of two regions of one phase would touch."""
        self.problem = problem
        self.size_px = size_px
        self.margin_px = round(size_px * overlap / 2)
        if size_px < 1 or not 0 <= 2 * self.margin_px < size_px:
            raise UsageError(
                "solve-arguments",
                what=f"Regions of {size_px} pixels can't overlap by {overlap:g}.",
                remedy="Choose regions of at least 4 pixels, and an overlap from 0 to below 1.",
            )
        self._pixels = np.flatnonzero(problem.majoriser.max(axis=0) > 0)
        self._at = _centres(problem.transport, self._pixels)
        shape = problem.transport.camera_shape
        self.counts = (-(-shape[0] // size_px), -(-shape[1] // size_px))
        cell = self._at // size_px
        self._home = cell[:, 0] * self.counts[1] + cell[:, 1]
        self._order = np.argsort(self._home, kind="stable")
        self._first = np.searchsorted(self._home[self._order], np.arange(self.counts[0] * self.counts[1] + 1))
        self._groups = channel_groups(problem.transport)

    def of_phase(self, phase: tuple[int, int]) -> Iterator[tuple[int, int]]:
        """(row, column) of the regions of one phase that see some of the object and hold projector pixels."""
        for i in range(phase[0], self.counts[0], 2):
            for j in range(phase[1], self.counts[1], 2):
                if self.core(i, j).size and self.problem.weights[self.box(i, j).window].any():
                    yield i, j

    def box(self, i: int, j: int) -> CameraBox:
        """The camera pixels of a region with its margin."""
        s = self.size_px
        return CameraBox(i * s, j * s, (i + 1) * s, (j + 1) * s).grown(
            self.margin_px, self.problem.transport.camera_shape
        )

    def core(self, i: int, j: int) -> Pixels:
        """The projector pixels of a region, without its margin."""
        region = i * self.counts[1] + j
        return np.sort(self._pixels[self._order[self._first[region] : self._first[region + 1]]])

    def unknown(self, i: int, j: int, settled: npt.NDArray[np.bool_]) -> Pixels:
        """The projector pixels in a region and its margin that no earlier phase has settled."""
        box, parts = self.box(i, j), []
        for row in range(max(i - 1, 0), min(i + 2, self.counts[0])):
            first, last = max(j - 1, 0), min(j + 1, self.counts[1] - 1)
            region = row * self.counts[1]
            parts.append(self._order[self._first[region + first] : self._first[region + last + 1]])
        near = np.concatenate(parts)
        y, x = self._at[near].T
        inside = (y >= box.top) & (y < box.bottom) & (x >= box.left) & (x < box.right)
        pixels: Pixels = np.sort(self._pixels[near[inside]])
        open_ones: Pixels = pixels[~settled[pixels]]
        return open_ones

    def equations(self, i: int, j: int, unknown: Pixels, x: FloatImage, light: FloatImage) -> list[BoxProblem]:
        """One problem, or one a channel where colours don't mix; ``x`` and ``light`` as in ``box_problem``."""
        return [box_problem(self.problem, self.box(i, j), unknown, group, x, light) for group in self._groups]

    @property
    def groups(self) -> list[tuple[int, ...]]:
        """The channels of each of the problems that ``equations`` gives."""
        return self._groups


def solve_regions(
    transport: LightTransport,
    target: FloatImage,
    black: FloatImage,
    settings: SolveSettings = DEFAULT_SETTINGS,
    context: SolveContext = ALONE,
    cut: RegionCut = PAPER_CUT,
) -> RegionSolution:
    """Find the projectors' images as the paper does; parameters as of ``solve_bounded``.

    Of ``settings``, the smoothness and the weights count; ``context.progress`` is called after each region with how
    many are done and the share of the work that is left.

    Raises
    ------
    UsageError  "image-wrong-size", "target-not-finite", "solve-arguments", "solver-unknown", "solver-missing"
    WorkError   "solve-cancelled", "region-unsolved"
    """
    began = time.perf_counter()
    check_input(SolveInput(transport, target, black, settings.smoothness, settings.weights, None))
    problem = build_problem(transport, target, black, settings.smoothness, settings.weights)
    regions = Regions(problem, size_px=cut.size_px, overlap=cut.overlap)
    x = initial_point(problem)
    x[problem.majoriser == 0] = 0
    settled = np.zeros(x.shape[1], np.bool_)
    phases = [list(regions.of_phase(phase)) for phase in PHASES]
    total, done, unknowns = max(sum(map(len, phases)), 1), 0, 0
    for phase in phases:
        for solved in _solve_phase(regions, phase, partial(solve_box, cut.solver), x, settled):
            unknowns += solved
            done += 1
            if context.progress is not None:
                context.progress(done, 1 - done / total)
            if context.cancelled is not None and context.cancelled():
                raise WorkError("solve-cancelled", what="The solve was stopped.", remedy="Start it again to repeat it.")
    light = transport.forward_planes(x)
    objective, kkt = objective_of(problem, x, light), kkt_residual(problem, x)
    frames = tuple(plane_frames(x, transport.sizes))
    return RegionSolution(frames, plane_image(light), objective, kkt, done, unknowns, time.perf_counter() - began)


def _solve_phase(
    regions: Regions,
    phase: list[tuple[int, int]],
    solve: BoxSolver,
    x: FloatImage,
    settled: npt.NDArray[np.bool_],
) -> Iterator[int]:
    """Solve the regions of a phase and settle their pixels; yields the unknowns of each."""
    light = regions.problem.transport.forward_planes(x)
    before, held = x.copy(), settled.copy()
    unknown = [regions.unknown(i, j, held) for i, j in phase]
    cut = zip(phase, unknown, strict=True)
    problems = (part for (i, j), pixels in cut for part in regions.equations(i, j, pixels, before, light))
    results = map(solve, problems)
    for (i, j), pixels in zip(phase, unknown, strict=True):
        for group in regions.groups:
            x[np.ix_(np.array(group), pixels)] = next(results).reshape(len(group), pixels.size)
        x[regions.problem.majoriser == 0] = 0
        settled[regions.core(i, j)] = True
        yield 3 * pixels.size


def _centres(transport: LightTransport, pixels: Pixels) -> Pixels:
    """(n, 2): camera row and column of the centre of each projector pixel's light."""
    rows, columns = transport.camera_shape
    place = np.zeros((3, rows, columns), np.float32)
    place[0], place[1] = np.arange(rows)[:, None], np.arange(columns)[None, :]
    at = np.floor(transport.gaussian_mean_planes(place)[:2, pixels].T + 0.5).astype(np.int64)
    inside: Pixels = np.clip(at, 0, np.array([rows - 1, columns - 1]))
    return inside
