"""Light that enters a surface and leaves it millimetres away, as in marble: diffusion along the surface.

The light E that falls on a surface spreads by (1 - d^2 Laplacian) u = E, whose answer to a point of light on a plane is
K0(r / d) / (2 pi d^2): all of it leaves again, at sqrt(r^2) = 2 d. Finite elements on the grid of the camera's pixels
keep the light's sum on any shape, and let none pass where the grid is torn by a depth edge.
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
TORN: Final = 6.0
"""Times the median side of the grid's triangles: longer ones span a depth edge."""


@dataclass(frozen=True, slots=True, eq=False)
class Spread:
    """The spread on a surface. ``areas`` (P,): of each pixel; 0 where none is known, and nothing spreads."""

    areas: Floats
    solver: Any

    @classmethod
    def over(cls, pixels: npt.NDArray[np.int32], points: FloatImage, width: int, spread_m: float) -> Self:
        """``pixels`` (P,): flat indices in a picture of ``width``; ``points`` (P, 3) of the surface there."""
        triangles = _triangles(pixels, points.astype(np.float64), width)
        stiffness, areas = _elements(points.astype(np.float64), triangles)
        mass = np.where(areas > 0.0, areas, 1.0)
        system = sparse.diags(mass) + spread_m**2 * stiffness
        return cls(areas, splu(system.tocsc(), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}))

    def of(self, falling: FloatImage) -> FloatImage:
        """Light (P, 3) that leaves for light that falls on the pixels."""
        mass = np.where(self.areas > 0.0, self.areas, 1.0)[:, None]
        return np.asarray(self.solver.solve(mass * falling.astype(np.float64)), np.float32)


def _triangles(pixels: npt.NDArray[np.int32], points: Floats, width: int) -> npt.NDArray[np.int64]:
    """Two for each square of four pixels with points, but those that span a depth edge."""
    height = int(pixels.max(initial=0)) // width + 2
    index = np.full((height, width + 1), -1, np.int64)
    index[pixels // width, pixels % width] = np.arange(len(pixels))
    here, right, below, across = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
    pairs = (here, right, below), (right, across, below)
    found = np.concatenate([np.stack([one.ravel() for one in corners], axis=1) for corners in pairs])
    found = found[(found >= 0).all(axis=1)]
    sides = np.max([np.linalg.norm(points[found[:, n]] - points[found[:, n - 1]], axis=1) for n in range(3)], axis=0)
    return found[sides <= TORN * np.median(sides)] if len(found) else found


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
