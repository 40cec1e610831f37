"""How much light blocks of a surface give each other by its shape alone: form factors of small patches of it.

A block holds more than one surface at a crease, and a ledge that the camera sees from the side is a thin line of
pixels. So each block is cut into patches, and what these give each other is added up.
"""

from __future__ import annotations

from typing import Final

import numba
import numpy as np
import numpy.typing as npt

from controller.core import channels
from controller.core.arrays import Float64, FloatImage, Mask
from controller.core.jit import compiled
from controller.transport.surfaces.blocks import down

ACROSS: Final = 3
"""Patches along the side of a block; four are no better, and take three times as long."""
LEAST_KNOWN: Final = 0.2
"""Share of a patch's pixels with a point, for light to be exchanged by shape."""
STEEPEST: Final = 0.1
"""Cosine between view and normal, below which a patch is not taken for larger."""


def form_factors(points_m: FloatImage, normals: FloatImage, grid: tuple[int, int], side: int) -> FloatImage:
    """(blocks, blocks): cos cos A / (pi r^2 + A), of which nothing is hidden; the source's area by its solid angle.

    A block receives the mean of what its patches receive. One without a shape receives what its nearest neighbour with
    one does, and sends nothing.

    ``points_m``, ``normals`` (rows, columns, 3) in the camera's frame, NaN where unknown; ``grid`` (rows, columns) of
    blocks of ``side`` x ``side`` pixels
    """
    from scipy.ndimage import distance_transform_edt

    count, fine = grid[0] * grid[1], max(1, round(side / ACROSS))
    known = channels.finite(points_m) & channels.finite(normals)
    patches = (-(-known.shape[0] // fine), -(-known.shape[1] // fine))
    share = down(known[..., None].astype(np.float32), patches, fine)[:, 0]
    with np.errstate(invalid="ignore", divide="ignore"):
        point, normal = (
            down(np.where(known[..., None], image, 0).astype(np.float32), patches, fine).astype(np.float64)
            / share[:, None]
            for image in (points_m, normals)
        )
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    good: Mask = np.asarray((share > LEAST_KNOWN) & np.isfinite(point).all(axis=1) & np.isfinite(normal).all(axis=1))
    if np.count_nonzero(good) < 2:
        return np.zeros((count, count), np.float32)
    p, n = point[good], normal[good]
    # the camera, at the origin, sees outward normals
    n = np.where(np.sum(n * p, axis=1, keepdims=True) > 0, -n, n)
    area = _areas(point, good, patches, n)
    block = _block_of(patches, fine, grid, side)[good]
    order = np.argsort(block, kind="stable")
    first = np.searchsorted(block[order], np.arange(count + 1))
    out = np.zeros((count, count), np.float32)
    _exchange(p[order], n[order], area[order], block[order], first, out)
    shaped = np.diff(first) > 0
    nearest = distance_transform_edt(~shaped.reshape(grid), return_distances=False, return_indices=True)
    return np.ascontiguousarray(out[np.ravel_multi_index(tuple(nearest.reshape(2, -1)), grid)])


def _block_of(patches: tuple[int, int], fine: int, grid: tuple[int, int], side: int) -> npt.NDArray[np.int64]:
    """(patches,): the block in which the middle of each lies."""
    along = [np.minimum((np.arange(patches[n]) * fine + fine // 2) // side, grid[n] - 1) for n in (0, 1)]
    return np.asarray(np.add.outer(along[0] * grid[1], along[1]).ravel(), np.int64)


def _areas(point: Float64, good: Mask, grid: tuple[int, int], normal: Float64) -> Float64:
    """Area of each good patch: what it covers before the camera, over the cosine to its normal."""
    depth = np.linalg.norm(point[good], axis=1)
    ray = point[good] / depth[:, None]
    # how far apart the rays of adjacent patches are, from all pairs of them
    rays = np.full((*grid, 3), np.nan)
    rays[good.reshape(grid)] = ray
    steps = [channels.length(np.diff(rays, axis=axis)) for axis in (0, 1)]
    across = [float(np.nanmedian(step)) if np.isfinite(step).any() else 0.0 for step in steps]
    slant = np.maximum(np.abs(np.sum(ray * normal, axis=1)), STEEPEST)
    return np.asarray(across[0] * across[1] * depth**2 / slant, np.float64)


@compiled(parallel=True)
def _exchange(
    point: Float64, normal: Float64, area: Float64, block: npt.NDArray[np.int64], first: npt.NDArray[np.int64],
    out: FloatImage,
) -> None:  # fmt: skip
    """Add up what patches give each other into ``out`` (blocks, blocks); block b has those from first[b] on."""
    for receiver in numba.prange(len(out)):
        own = first[receiver + 1] - first[receiver]
        for i in range(first[receiver], first[receiver + 1]):
            for j in range(len(point)):
                x, y, z = point[j, 0] - point[i, 0], point[j, 1] - point[i, 1], point[j, 2] - point[i, 2]
                receiving = x * normal[i, 0] + y * normal[i, 1] + z * normal[i, 2]
                sending = -(x * normal[j, 0] + y * normal[j, 1] + z * normal[j, 2])
                if receiving <= 0 or sending <= 0:
                    continue
                square = x * x + y * y + z * z
                given = receiving * sending / square * area[j] / (np.pi * square + area[j])
                out[receiver, block[j]] += np.float32(given / own)


__all__ = ["form_factors"]
