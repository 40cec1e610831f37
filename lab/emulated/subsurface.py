"""Light that enters a surface and leaves it millimetres away, as in marble: diffusion along the surface.

The light E that falls on a surface spreads by (1 - d^2 Laplacian) u = E, whose answer to a point of light on a plane is
K0(r / d) / (2 pi d^2): all of it leaves again, at sqrt(r^2) = 2 d. Finite elements on the grid of the camera's pixels
keep the light's sum on any shape, and let none pass where the grid is torn by a depth edge.

Light that has spread has no detail much finer than d. Where d is many pixels, it is sought at fewer places, every
second or fourth pixel and so on, and is linear between them: the sum of light stays the same.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final, Self

import numpy as np
import numpy.typing as npt
from scipy import sparse
from scipy.sparse.linalg import splu

Floats = npt.NDArray[np.float64]
FloatImage = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]
TORN: Final = 6.0
"""Times the median side of the grid's triangles: longer ones span a depth edge."""
FINEST: Final = 3.2
"""Distance of two places, times this: at most d."""
FARTHEST: Final = 0.5
"""Of d, a pixel from a place: farther ones lie beyond a depth edge, or on a surface that is seen so obliquely that each
pixel is a place of its own."""


@dataclass(frozen=True, slots=True, eq=False)
class Spread:
    """The spread on a surface.

    ``areas`` (P,): of each pixel; 0 where none is known, and nothing spreads; ``between`` (P, N): each pixel's share of
    the light at N places
    """

    areas: Floats
    between: Any
    solver: Any

    @classmethod
    def over(cls, pixels: npt.NDArray[np.int32], points: FloatImage, width: int, spread_m: float) -> Self:
        """``pixels`` (P,): flat indices in a picture of ``width``; ``points`` (P, 3) of the surface there."""
        at = points.astype(np.float64)
        triangles, side_m = _triangles(pixels, at, width)
        stiffness, areas = _elements(at, triangles)
        mass = np.where(areas > 0.0, areas, 1.0)
        step = max(1, int(spread_m / (FINEST * side_m)))
        between = _between(pixels, at, areas > 0.0, width, step, FARTHEST * spread_m)
        system = between.T @ (sparse.diags(mass) + spread_m**2 * stiffness) @ between
        solver = splu(system.tocsc(), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
        return cls(areas, between, solver)

    def of(self, falling: FloatImage) -> FloatImage:
        """Light (P, 3) that leaves for light that falls on the pixels."""
        mass = np.where(self.areas > 0.0, self.areas, 1.0)[:, None]
        return np.asarray(self.between @ self.solver.solve(self.between.T @ (mass * falling)), np.float32)


def _triangles(pixels: npt.NDArray[np.int32], points: Floats, width: int) -> tuple[npt.NDArray[np.int64], float]:
    """Two for each square of four pixels with points, but those that span a depth edge; and their median side."""
    index = _index(pixels, width, 1)
    here, right, below, across = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
    pairs = (here, right, below), (right, across, below)
    triangles = np.concatenate([np.stack([one.ravel() for one in corners], axis=1) for corners in pairs])
    triangles = triangles[(triangles >= 0).all(axis=1)]
    if not len(triangles):
        return triangles, np.inf
    sides = np.max(
        [np.linalg.norm(points[triangles[:, n]] - points[triangles[:, n - 1]], axis=1) for n in range(3)], axis=0
    )
    usual = float(np.median(sides))
    return triangles[sides <= TORN * usual], usual


def _index(pixels: npt.NDArray[np.int32], width: int, around: int) -> npt.NDArray[np.int64]:
    """(rows, columns) which of ``pixels`` lies there, -1 where none does, with so many more rows and columns."""
    height = int(pixels.max(initial=0)) // width + 1
    index = np.full((height + around, width + around), -1, np.int64)
    index[pixels // width, pixels % width] = np.arange(len(pixels))
    return index


def _between(
    pixels: npt.NDArray[np.int32], points: Floats, has_area: Mask, width: int, step: int, farthest_m: float
) -> Any:
    """(P, N) shares of the light at every ``step``th pixel of both axes, linear between them; their sum is 1.

    A place beyond a depth edge has none. A pixel that is left without any, or is not ``known``, is a place of its own.
    """
    count = len(pixels)
    if step == 1:
        return sparse.identity(count, format="csr")
    index = _index(pixels, width, step)
    row, column = pixels // width, pixels % width
    rows, places, values = [], [], []
    for down in (0, 1):
        for right in (0, 1):
            at = index[(row // step + down) * step, (column // step + right) * step]
            share = np.abs(1 - down - row % step / step) * np.abs(1 - right - column % step / step)
            near = np.linalg.norm(points - points[at], axis=1) <= farthest_m
            used = np.flatnonzero((at >= 0) & near & has_area & has_area[at] & (share > 0))
            rows.append(used)
            places.append(at[used])
            values.append(share[used])
    own = np.setdiff1d(np.arange(count), np.concatenate(rows))
    shares = sparse.csr_matrix(
        (np.concatenate([*values, np.ones(len(own))]), (np.concatenate([*rows, own]), np.concatenate([*places, own]))),
        shape=(count, count),
    )
    shares = sparse.diags(1.0 / np.asarray(shares.sum(axis=1)).ravel()) @ shares
    return shares.tocsc()[:, np.unique(shares.indices)].tocsr()


def _elements(points: Floats, triangles: npt.NDArray[np.int64]) -> tuple[Any, Floats]:
    """Stiffness (P, P) of linear elements on triangles, and the area (P,) that belongs to each corner."""
    count = len(points)
    rows, columns, values = [], [], []
    a, b, c = (points[triangles[:, n]] for n in range(3))
    double = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    areas = np.bincount(triangles.T.ravel(), weights=np.tile(double / 6.0, 3), minlength=count)
    for n in range(3):
        opposite, one, other = (triangles[:, (n + step) % 3] for step in range(3))
        first, second = points[one] - points[opposite], points[other] - points[opposite]
        half = 0.5 * np.einsum("nk,nk->n", first, second) / np.maximum(double, 1e-30)
        rows += [one, other, one, other]
        columns += [other, one, one, other]
        values += [-half, -half, half, half]
    parts = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
    return sparse.csr_matrix(parts, shape=(count, count)), np.asarray(areas, np.float64)
