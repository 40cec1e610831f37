"""Each projector pixel's footprint in the camera image: the moments of the shares that the phase map gives it.

A camera pixel that looks at phi gets the share exp(-1/2 (phi - v)' S^-1 (phi - v)) of pixel v's light (paper 4.2.2).
Mean and covariance of these shares over the camera's pixels are the metapixel, on a curved surface, too, where neither
the place at which the map equals v nor J S J' are.
"""

from __future__ import annotations

from typing import Final

import numba
import numpy as np

from controller.core.arrays import Float64, FloatImage, Mask
from controller.core.jit import compiled
from controller.optics.calibrate.correspondence.inverse_map import InverseMap
from controller.optics.calibrate.values import Correspondence

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
    places = np.ascontiguousarray(np.moveaxis(seen, 2, 0))
    _measure(places, correspondence.valid, inverse.jacobian, blur_px2, covariance_px2, valid, centre, covariance)
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
    plane, of_blur = (a, b, c, d, area), (pp, pq, qq)
    x = np.arange(left, right + 1) - centre[0]
    sums[:] = 0.0
    for i in range(top, bottom + 1):
        y, here = i - centre[1], slice(left, right + 1)
        own = position[0, i, here], position[1, i, here], seen[i, here]
        one, of_x, of_xx, missing = _add_row(own, row, column, x, y, plane, of_blur)
        sums[0] += one
        sums[1] += of_x
        sums[2] += one * y
        sums[3] += of_xx
        sums[4] += of_x * y
        sums[5] += one * y * y
        sums[6] += missing
    return bool(sums[0] > 0 and sums[6] <= MOST_MISSING * sums[0])


@compiled(fastmath=True)
def _add_row(
    own: tuple[FloatImage, FloatImage, Mask],
    row: int,
    column: int,
    x: Float64,
    y: float,
    plane: tuple[float, float, float, float, float],
    inverse: tuple[float, float, float],
) -> tuple[float, float, float, float]:
    """Sums over a row of camera pixels: shares; times x; times x squared; and those missing.

    ``own``: x and y of the projector where they look, and where that is known; ``plane``: its four slopes and their
    determinant; ``inverse``: of the blur. Without branches, so that the loop uses vectors.
    """
    (across, down, seen), (a, b, c, d, area), (pp, pq, qq) = own, plane, inverse
    one = of_x = of_xx = missing = 0.0
    for k in range(x.size):
        p, q = (d * x[k] - b * y) / area, (a * y - c * x[k]) / area
        u, v = across[k] - column, down[k] - row
        near = abs(u - p) + abs(v - q) <= MOST_OFF_PX + MOST_OFF_SHARE * (abs(p) + abs(q))
        found = seen[k] & near
        u, v = u if found else p, v if found else q
        far = pp * u * u + 2 * pq * u * v + qq * v * v
        # exp(-far / 2) as (exp(-far / 128))^64, by a series that is good to 1e-13
        t = -far / 128
        share = 1 + t * (1 + t / 2 * (1 + t / 3 * (1 + t / 4 * (1 + t / 5 * (1 + t / 6 * (1 + t / 7 * (1 + t / 8)))))))
        share = share * share * share * share
        share = share * share * share * share
        share = share * share * share * share if far < REACH_SIGMAS**2 else 0.0
        one += share
        of_x += share * x[k]
        of_xx += share * x[k] * x[k]
        missing += 0.0 if found else share
    return one, of_x, of_xx, missing
