"""Each projector pixel's footprint in the camera image: the moments of the shares that the phase map gives it.

A camera pixel that looks at phi gets the share exp(-1/2 (phi - v)' S^-1 (phi - v)) of pixel v's light (paper 4.2.2).
Mean and covariance of these shares over the camera's pixels are the metapixel, on a curved surface, too, where neither
the place at which the map equals v nor J S J' are.
"""

from __future__ import annotations

from typing import Final

import numba
import numpy as np

from controller.calibrate.correspondence.inverse_map import InverseMap
from controller.calibrate.values import Correspondence
from controller.core.arrays import Float64, FloatImage, Mask
from controller.core.jit import compiled

REACH_SIGMAS: Final = 3.5
"""Shares are added up to this Mahalanobis distance; a Gaussian's variance beyond it is compensated."""
WIDER: Final = 1.25
"""Size of the window, relative to that of a flat surface."""
MOST_MISSING: Final = 0.2
"""Of a footprint's light, on camera pixels that were not decoded or lie on another surface: there the plane is used."""
LEAST_AREA: Final = 0.25
"""Of the flat footprint's; a smaller one falls between the camera's pixels."""
MOST_OFF_PX, MOST_OFF_SHARE = 0.5, 0.35
"""Projector px off the plane, and share of the way from the centre, from which it is another surface."""


def measure_footprints(
    correspondence: Correspondence, inverse: InverseMap, blur_px2: FloatImage, covariance_px2: FloatImage, valid: Mask
) -> tuple[FloatImage, FloatImage]:
    """Centres and covariances of one projector's pixels in the camera image.

    Parameters
    ----------
    inverse : planes of the same map; they tell where to look, and what continues over missing camera pixels
    blur_px2 : (rows, columns, 3) float32, S of each projector pixel, projector px squared: xx, xy, yy
    covariance_px2 : (rows, columns, 3) float32, J S J' in camera px squared
    valid : (rows, columns), the pixels wanted

    Returns
    -------
    (rows, columns, 2) and (rows, columns, 3) float32; those of ``inverse`` and ``covariance_px2`` at pixels that are
    not wanted, leave the camera's image, or lie largely on more than one surface
    """
    seen = correspondence.projector_px if correspondence.as_seen_px is None else correspondence.as_seen_px
    centre, covariance = inverse.centre_px.copy(), covariance_px2.copy()
    _measure(seen, correspondence.valid, inverse.jacobian, blur_px2, covariance_px2, valid, centre, covariance)
    return centre, covariance


@compiled(parallel=True)
def _measure(
    position: FloatImage,
    seen: Mask,
    jacobian: FloatImage,
    blur: FloatImage,
    flat: FloatImage,
    wanted: Mask,
    centre: FloatImage,
    covariance: FloatImage,
) -> None:
    tail = np.exp(-(REACH_SIGMAS**2) / 2)
    kept = 1 - REACH_SIGMAS**2 / 2 * tail / (1 - tail)
    for row in numba.prange(wanted.shape[0]):
        sums = np.empty(7)
        for column in range(wanted.shape[1]):
            if not wanted[row, column] or not _add_up(
                position, seen, row, column, centre[row, column], jacobian[row, column], blur[row, column],
                flat[row, column], sums,
            ):  # fmt: skip
                continue
            x, y = sums[1] / sums[0], sums[2] / sums[0]
            xx, xy = sums[3] / sums[0] - x * x, sums[4] / sums[0] - x * y
            yy = sums[5] / sums[0] - y * y
            area = flat[row, column, 0] * flat[row, column, 2] - flat[row, column, 1] ** 2
            if xx * yy - xy * xy <= LEAST_AREA**2 * area:
                continue
            centre[row, column, 0] += x
            centre[row, column, 1] += y
            covariance[row, column, 0] = xx / kept
            covariance[row, column, 1] = xy / kept
            covariance[row, column, 2] = yy / kept


@compiled()
def _add_up(
    position: FloatImage,
    seen: Mask,
    row: int,
    column: int,
    centre: FloatImage,
    jacobian: FloatImage,
    blur: FloatImage,
    flat: FloatImage,
    sums: Float64,
) -> bool:
    """Shares around ``centre`` into ``sums``: 1, x, y, xx, xy, yy, and those missing. False where they do not tell."""
    a, b, c, d = jacobian[0], jacobian[1], jacobian[2], jacobian[3]
    area, spread = a * d - b * c, blur[0] * blur[2] - blur[1] * blur[1]
    pp, pq, qq = blur[2] / spread, -blur[1] / spread, blur[0] / spread
    across = REACH_SIGMAS * WIDER * np.sqrt(flat[0]) + 1
    down = REACH_SIGMAS * WIDER * np.sqrt(flat[2]) + 1
    left, right = int(np.ceil(centre[0] - across)), int(np.floor(centre[0] + across))
    top, bottom = int(np.ceil(centre[1] - down)), int(np.floor(centre[1] + down))
    if left < 0 or top < 0 or right >= seen.shape[1] or bottom >= seen.shape[0]:
        return False
    sums[:] = 0.0
    for i in range(top, bottom + 1):
        for j in range(left, right + 1):
            x, y = j - centre[0], i - centre[1]
            p, q = (d * x - b * y) / area, (a * y - c * x) / area
            missing = True
            if seen[i, j]:
                u, v = position[i, j, 0] - column, position[i, j, 1] - row
                if abs(u - p) + abs(v - q) <= MOST_OFF_PX + MOST_OFF_SHARE * (abs(p) + abs(q)):
                    p, q, missing = u, v, False
            far = pp * p * p + 2 * pq * p * q + qq * q * q
            if far < REACH_SIGMAS**2:
                share = np.exp(-0.5 * far)
                sums[0] += share
                sums[1] += share * x
                sums[2] += share * y
                sums[3] += share * x * x
                sums[4] += share * x * y
                sums[5] += share * y * y
                if missing:
                    sums[6] += share
    return bool(sums[0] > 0 and sums[6] <= MOST_MISSING * sums[0])
