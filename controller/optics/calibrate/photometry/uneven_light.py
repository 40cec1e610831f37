"""Indirect light of colour tiles that differs from place to place from what is known of it.

What surfaces throw back depends on the tiles around. What is known of it is the share of white, which is as bright
everywhere as the picture is on the mean. The difference changes slowly from one tile to the next and a tile's levels
do not: so neighbours tell how much of a tile's residual it is (a Gaussian process).
"""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
import numpy.typing as npt

from controller.core.arrays import Float64
from controller.optics.calibrate.photometry.colour_tiles import DOUBT, TileMeasurements

UNEVEN: Final = 0.3
"""Standard deviation of a tile's indirect light from what is known of it, relative, as far as neighbours share it."""
ALIKE_TILES: Final = 1.5
"""Standard deviation of the Gaussian by which tiles are alike, in tiles."""
OWN: Final = 0.05
"""Standard deviation of a tile's own part, relative."""
LEAST_KEPT: Final = 1e-3
REACH: Final = 6.0
"""Standard deviations beyond which tiles are not alike."""
CONVERGED: Final = 1e-7
MOST_TURNS: Final = 1000


def own_weight(tiles: TileMeasurements) -> Float64:
    """(tiles, 3) inverse variance of the measurements where neighbours tell the rest of the indirect light."""
    variance = 1 / tiles.weight + (OWN**2 - DOUBT**2) * tiles.indirect**2
    return np.asarray(1 / np.maximum(variance, 1e-12), np.float64)


def uneven_light(tiles: TileMeasurements, residual: Float64, weight: Float64) -> Float64:
    """(tiles, 3): the part of ``residual`` (tiles, 3) that is indirect light which neighbouring tiles share.

    ``weight`` (tiles, 3): inverse variance of each tile's own part; 0 for what does not count
    """
    found = np.zeros_like(residual)
    for photograph in range(int(tiles.photograph.max(initial=-1)) + 1):
        own = np.flatnonzero(tiles.photograph == photograph)
        variance = 1 / np.maximum(weight[own], LEAST_KEPT * tiles.weight[own])
        shared = _Shared(tiles.place[own], UNEVEN * tiles.indirect[own])
        found[own] = shared.times(_solved(shared, variance, residual[own]))
    return found


class _Shared:
    """The covariance (tiles, tiles) of each channel, as a filter of the tiles' grid: 8,100 tiles make a big matrix."""

    def __init__(self, place: npt.NDArray[np.int64], strength: Float64) -> None:
        self._place, self._strength = (place[:, 0], place[:, 1]), strength
        self._size = (*(place.max(axis=0, initial=0) + 1), 3)
        reach = np.arange(-int(REACH * ALIKE_TILES), int(REACH * ALIKE_TILES) + 1)
        self._alike = np.exp(-(reach**2) / (2 * ALIKE_TILES**2))
        self.variance = strength**2

    def times(self, values: Float64) -> Float64:
        """``values`` (tiles, 3) of each channel times its covariance."""
        grid = np.zeros(self._size)
        grid[self._place] = values * self._strength
        around = cv2.sepFilter2D(grid, cv2.CV_64F, self._alike, self._alike, borderType=cv2.BORDER_CONSTANT)
        return np.asarray(around[self._place] * self._strength, np.float64)


def _solved(shared: _Shared, variance: Float64, residual: Float64) -> Float64:
    """x of each channel in (shared + variance) x = residual, by conjugate gradients."""
    from scipy.sparse.linalg import LinearOperator, cg

    shape, size = residual.shape, residual.size
    scale = (1 / (variance + shared.variance)).ravel()

    def whole(x: Float64) -> Float64:
        values = x.reshape(shape)
        return (shared.times(values) + variance * values).ravel()

    found, _ = cg(
        LinearOperator((size, size), matvec=whole, dtype=np.float64),
        residual.ravel(),
        rtol=CONVERGED,
        maxiter=MOST_TURNS,
        M=LinearOperator((size, size), matvec=lambda x: scale * x, dtype=np.float64),
    )
    return np.asarray(found.reshape(shape), np.float64)


__all__ = ["own_weight", "uneven_light"]
