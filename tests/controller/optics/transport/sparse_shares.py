"""Shares of the light as plain sparse matrices: the plain form of a light transport, as an oracle.

``LightTransport`` is the fast form of the same. Weights are (camera pixels, projector pixels), row-major both, and lie
in [0, 1].
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from controller.core.arrays import Float64, FloatImage, Mask
from controller.optics.calibrate.values import Metapixels, PhaseMap

CUT = 3.0
"""Gaussians end at this Mahalanobis distance."""


def gaussian_weights(metapixels: Metapixels, camera_shape: tuple[int, int]) -> sp.csr_matrix[np.float64]:
    """Each metapixel's Gaussian, 1 at its centre, at the camera pixels within the cut (paper 4.2.3).

    Metapixels that are not valid, or whose covariance is not positive definite, have none.
    """
    rows, columns = camera_shape
    xx, xy, yy = np.moveaxis(metapixels.covariance_px2.astype(np.float64), -1, 0)
    which = np.flatnonzero(metapixels.valid & (xx > 0) & (yy > 0) & (xx * yy > xy * xy))
    centre = metapixels.centre_px.reshape(-1, 2)[which].astype(np.float64)
    xx, xy, yy = metapixels.covariance_px2.reshape(-1, 3)[which].astype(np.float64).T
    reach_x, reach_y = (int(np.ceil(CUT * np.sqrt(v.max(initial=0)) + 0.5)) for v in (xx, yy))
    parts = [(np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0))]
    for dy in range(-reach_y, reach_y + 1):
        for dx in range(-reach_x, reach_x + 1):
            x, y = np.round(centre[:, 0]).astype(np.int64) + dx, np.round(centre[:, 1]).astype(np.int64) + dy
            u, v = x - centre[:, 0], y - centre[:, 1]
            squared = (yy * u * u - 2 * xy * u * v + xx * v * v) / (xx * yy - xy * xy)
            ok = (squared <= CUT**2) & (x >= 0) & (y >= 0) & (x < columns) & (y < rows)
            parts.append(((y * columns + x)[ok], which[ok], np.exp(-0.5 * squared[ok])))
    row, column, value = (np.concatenate(part) for part in zip(*parts, strict=True))
    return sp.csr_matrix((value, (row, column)), shape=(rows * columns, metapixels.valid.size))


def phase_map_shares(phase_map: PhaseMap) -> sp.csr_matrix[np.float64]:
    """Each camera pixel's normalised Gaussian over the projector's pixels, cut at four standard deviations.

    The blur is that of the projector pixel nearest to where the camera pixel looks. The plain form of what
    ``controller.optics.transport.windows.profiles`` keeps, without the camera's colours.
    """
    rows, columns = phase_map.spread_px2.shape[:2]
    position = phase_map.projector_px.reshape(-1, 2).astype(np.float64)
    x, y = position.T
    with np.errstate(invalid="ignore"):
        which = np.flatnonzero((x >= -2) & (y >= -2) & (x < columns + 1) & (y < rows + 1))
    x, y = position[which].T
    near = np.clip(np.floor(y + 0.5), 0, rows - 1).astype(int), np.clip(np.floor(x + 0.5), 0, columns - 1).astype(int)
    xx, xy, yy = phase_map.spread_px2[near].astype(np.float64).T
    with np.errstate(invalid="ignore"):
        good = (xx > 0) & (yy > 0) & (xx * yy > xy * xy)
    which, x, y, xx, xy, yy = which[good], x[good], y[good], xx[good], xy[good], yy[good]
    reach_x, reach_y = (int(np.ceil(4 * np.sqrt(v.max(initial=0)) + 1)) for v in (xx, yy))
    parts = [(np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0))]
    for dy in range(-reach_y, reach_y + 1):
        for dx in range(-reach_x, reach_x + 1):
            column, row = np.round(x).astype(np.int64) + dx, np.round(y).astype(np.int64) + dy
            u, v = x - column, y - row
            squared = (yy * u * u - 2 * xy * u * v + xx * v * v) / (xx * yy - xy * xy)
            ok = (squared <= 16) & (column >= 0) & (row >= 0) & (column < columns) & (row < rows)
            parts.append((which[ok], (row * columns + column)[ok], np.exp(-0.5 * squared[ok])))
    at, to, value = (np.concatenate(part) for part in zip(*parts, strict=True))
    return normalised(sp.csr_matrix((value, (at, to)), shape=(position.shape[0], rows * columns)))


def normalised(weights: sp.csr_matrix[np.float64]) -> sp.csr_matrix[np.float64]:
    """Shares: each row divided by its sum, so that all pixels at white give the white image; empty rows stay empty."""
    total = np.asarray(weights.sum(axis=1)).ravel()
    inverse = np.divide(1.0, total, out=np.zeros_like(total), where=total > 0)
    return sp.csr_matrix(sp.diags_array(inverse) @ weights)


def predicted(
    shares: sp.csr_matrix[np.float64], white: FloatImage, mixing: Float64, frame: FloatImage
) -> tuple[FloatImage, Mask]:
    """W (.) [G (p M')]: the camera image of one projector's frame, less black, and where there are shares at all.

    ``white`` (camera rows, columns, 3) less black; ``mixing`` (3, 3) camera by projector channel; ``frame`` (rows,
    columns, 3) linear, in [0, 1]
    """
    light = np.asarray(shares @ (frame.reshape(-1, 3).astype(np.float64) @ mixing.T))
    image: FloatImage = np.asarray(white * light.reshape(white.shape), np.float32)
    known: Mask = np.diff(shares.indptr).reshape(white.shape[:2]) > 0
    return image, known
