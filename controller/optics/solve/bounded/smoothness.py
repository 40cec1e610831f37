"""Smoothness between adjacent pixels of one projector (paper 2.4, eq. 3).

Superimposed projectors leave many ways to make the same image; these equations choose the one without noise. Each asks
two adjacent pixels to be equal, and is weighted down where the target or the object changes between them.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numba import prange

from controller.core.arrays import FloatImage
from controller.core.jit import compiled
from controller.optics.solve.bounded.problem import EdgeWeights
from controller.optics.transport import LightTransport

EDGE_WEIGHT_STEPS: Final = 65535
"""Squared weights, 0 to 1, are kept in so many steps: 2 bytes instead of 4, and at most 1/131070 off."""

FAINTEST: Final = 1e-3
"""Fraction of a projector's brightest observed pixel below which a pixel counts as in shadow."""


def squared_edge_weights(transport: LightTransport, wanted: FloatImage) -> tuple[EdgeWeights, EdgeWeights]:
    """alpha squared for all projectors; alpha is 0 beside a pixel that contributes nothing (paper 2.4, eq. 3).

    ``wanted`` (3, camera rows, columns): the light to be made, without the black image; overwritten. Returns two arrays
    (3, pixels) in steps of 1 / EDGE_WEIGHT_STEPS: from each pixel to its right neighbour, and to the one below; 0 at
    the last column and row.
    """
    count = transport.pixels
    across, down = np.zeros((3, count), np.uint16), np.zeros((3, count), np.uint16)
    target = transport.gaussian_mean_planes(wanted)
    light, ones = wanted, np.ones((3, count), np.float32)
    for n, (rows, columns) in enumerate(transport.sizes):
        span = transport.span(n)
        transport.forward_planes(ones, projectors=(n, n + 1), out=light)
        observed = transport.gaussian_mean_planes(light, projectors=(n, n + 1))[:, span]
        faint = float(FAINTEST * observed.max(initial=0))
        _squared(target, observed, faint, span.start, rows, columns, across, down)
    return across, down


@compiled()
def _squared_alike(target: float, observed: float, other: float, other_observed: float, faint: float) -> int:
    """In steps."""
    if observed <= faint or other_observed <= faint:
        return 0
    a, b = target / observed, other / other_observed
    larger = max(a, b)
    alpha = min(a, b) / larger if larger > 0 else 1.0
    return int(EDGE_WEIGHT_STEPS * alpha * alpha + 0.5)


@compiled(parallel=True)
def _squared(
    target: FloatImage,
    observed: FloatImage,
    faint: float,
    start: int,
    rows: int,
    columns: int,
    across: EdgeWeights,
    down: EdgeWeights,
) -> None:
    """The squared weights of one projector; ``observed`` (3, its pixels), the others of all projectors."""
    for y in prange(rows):
        for c in range(3):
            for x in range(columns):
                i = y * columns + x
                k = start + i
                here, seen = target[c, k], observed[c, i]
                if x + 1 < columns:
                    across[c, k] = _squared_alike(here, seen, target[c, k + 1], observed[c, i + 1], faint)
                if y + 1 < rows:
                    below = k + columns, i + columns
                    down[c, k] = _squared_alike(here, seen, target[c, below[0]], observed[c, below[1]], faint)
