"""Indirect light of colour tiles that differs from place to place from what is known of it.

What surfaces throw back depends on the tiles around. What is known of it is the share of white, which is as bright
everywhere as the picture is on the mean. The difference changes slowly from one tile to the next and a tile's levels
do not: so neighbours tell how much of a tile's residual it is (a Gaussian process).
"""

from __future__ import annotations

from typing import Final

import numpy as np

from controller.calibrate.photometry.colour_tiles import DOUBT, TileMeasurements
from controller.core.arrays import Float64

UNEVEN: Final = 0.3
"""Standard deviation of a tile's indirect light from what is known of it, relative, as far as neighbours share it."""
ALIKE_TILES: Final = 1.5
"""Standard deviation of the Gaussian by which tiles are alike, in tiles."""
OWN: Final = 0.05
"""Standard deviation of a tile's own part, relative."""
LEAST_KEPT: Final = 1e-3


def own_weight(tiles: TileMeasurements) -> Float64:
    """(tiles, 3) inverse variance of the measurements where neighbours tell the rest of the indirect light."""
    variance = 1 / tiles.weight + (OWN**2 - DOUBT**2) * tiles.indirect**2
    return np.asarray(1 / np.maximum(variance, 1e-12), np.float64)


def uneven_light(tiles: TileMeasurements, residual: Float64, weight: Float64) -> Float64:
    """(tiles, 3): the part of ``residual`` (tiles, 3) that is indirect light which neighbouring tiles share.

    ``weight`` (tiles, 3): inverse variance of each tile's own part; 0 for what does not count
    """
    from scipy.linalg import solve

    found = np.zeros_like(residual)
    for photograph in range(int(tiles.photograph.max(initial=-1)) + 1):
        own = np.flatnonzero(tiles.photograph == photograph)
        place = tiles.place[own].astype(np.float64)
        apart = ((place[:, None] - place[None]) ** 2).sum(axis=2)
        alike = np.exp(-apart / (2 * ALIKE_TILES**2))
        for channel in range(3):
            strength = UNEVEN * tiles.indirect[own, channel]
            shared = alike * strength[:, None] * strength
            variance = 1 / np.maximum(weight[own, channel], LEAST_KEPT * tiles.weight[own, channel])
            whole = shared + np.diag(variance)
            found[own, channel] = shared @ solve(whole, residual[own, channel], assume_a="pos")
    return found


__all__ = ["own_weight", "uneven_light"]
