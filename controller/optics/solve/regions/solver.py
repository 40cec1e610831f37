"""The paper's solver: regions of the camera image, one after the other in four phases (paper 3.2, eq. 7).

The camera image is cut into regions of 16x16, each solved together with a margin around it, so that 25 % overlap. The
phases take alternate rows and columns of regions; what an earlier phase has settled is held fixed in later ones. A
region determines its own pixels; those of its margin are provisional, and its neighbours solve them again. The
regions of a phase don't touch each other, so their order does not matter. Earlier values being fixed, the result is
near the optimum, not at it: the global solver (``bounded``) is the default, this one is for comparison
(docs/decisions/0007).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np
import numpy.typing as npt

from controller.core.arrays import FloatImage
from controller.core.errors import UsageError, WorkError
from controller.optics.solve.bounded.equations import build_problem, initial_point, objective_of
from controller.optics.solve.bounded.problem import Problem, SolveInput
from controller.optics.solve.bounded.solver import SMOOTHNESS, check_input
from controller.optics.solve.regions.box_solvers import BoxProblem, BoxSolver, solve_box
from controller.optics.solve.regions.equations import Pixels, box_problem, channel_groups
from controller.optics.transport import LightTransport
from controller.optics.transport.camera_box import CameraBox
from controller.optics.transport.planes import plane_frames, plane_image

SIZE_PX: Final = 16
OVERLAP: Final = 0.25
PHASES: Final = ((0, 0), (0, 1), (1, 0), (1, 1))
"""Rows and columns of regions, modulo 2."""


@dataclass(frozen=True, slots=True)
class RegionSolution:
    """Result of the regions.

    ``frames``: one (rows, columns, 3) float32 linear image a projector, in [0, 1]
    ``light`` (camera rows, columns, 3) float32: T p
    ``objective``: as of ``bounded.Solution``, over the whole image
    ``regions``, ``unknowns``: how many were solved, and their unknowns in all
    """

    frames: tuple[FloatImage, ...]
    light: FloatImage
    objective: float
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
    *,
    solver: str = "lsq_linear",
    smoothness: float = SMOOTHNESS,
    weights: FloatImage | None = None,
    size_px: int = SIZE_PX,
    overlap: float = OVERLAP,
    progress: Callable[[float], None] | None = None,
    cancelled: Callable[[], bool] | None = None,
) -> RegionSolution:
    """Find the projectors' images as the paper does; ``target`` to ``weights`` are those of ``solve_bounded``.

    Parameters
    ----------
    solver : one of ``box_solvers.SOLVERS``
    size_px, overlap : of the regions; the paper's 16 and 25 %
    progress : called after each region with the share of the work that is done

    Raises
    ------
    UsageError  "image-wrong-size", "target-not-finite", "solve-arguments", "solver-unknown", "solver-missing"
    WorkError   "solve-cancelled", "region-unsolved"
    """
    began = time.perf_counter()
    check_input(SolveInput(transport, target, black, smoothness, weights, None))
    problem = build_problem(transport, target, black, smoothness, weights)
    regions = Regions(problem, size_px=size_px, overlap=overlap)
    x = initial_point(problem)
    x[problem.majoriser == 0] = 0
    settled = np.zeros(x.shape[1], np.bool_)
    phases = [list(regions.of_phase(phase)) for phase in PHASES]
    total, done, unknowns = max(sum(map(len, phases)), 1), 0, 0
    for phase in phases:
        for solved in _solve_phase(regions, phase, partial(solve_box, solver), x, settled):
            unknowns += solved
            done += 1
            if progress is not None:
                progress(done / total)
            if cancelled is not None and cancelled():
                raise WorkError("solve-cancelled", what="The solve was stopped.", remedy="Start it again to repeat it.")
    light = transport.forward_planes(x)
    objective = objective_of(problem, x, light)
    frames = tuple(plane_frames(x, transport.sizes))
    return RegionSolution(frames, plane_image(light), objective, done, unknowns, time.perf_counter() - began)


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
