"""G from what was measured: form factors of the reconstructed surface, and the indirect part of each white image."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import cv2
import numpy as np
from scipy.ndimage import distance_transform_edt
from scipy.optimize import nnls

from controller.calibrate.values import Calibration, ProjectorCalibration
from controller.core.arrays import Float64, FloatImage, Mask
from controller.transport.indirect import IndirectLight, down, up

BLOCKS: Final = 1200
"""About so many in the whole picture."""
NEAR_BLOCKS: Final = 1.0
"""Standard deviation of near light, in blocks: what spreads under the surface, or between neighbours."""
LEAST_KNOWN: Final = 0.2
"""Share of a block's pixels with a point, for light to be exchanged by shape."""
FAINTEST: Final = 1e-4
"""Of the brightest: less falling light says nothing of what a surface makes of it."""
ROUNDS: Final = 12


def fit_indirect(
    calibration: Calibration, lit: Mask, points_m: FloatImage | None, normals: FloatImage | None
) -> IndirectLight | None:
    """G of a stage; None where no indirect light was measured.

    Parameters
    ----------
    calibration : with the indirect light of each projector's white, camera (rows, columns, 3)
    lit : (rows, columns) camera pixels whose direct light the transport knows
    points_m, normals : (rows, columns, 3) of the surface in the camera's frame, NaN where unknown; None: not known
    """
    indirect = [part.indirect for part in calibration.projectors if part.indirect is not None]
    if len(indirect) < len(calibration.projectors) or not indirect:
        return None
    shape = calibration.black.shape
    side = max(1, round(float(np.sqrt(shape[0] * shape[1] / BLOCKS))))
    grid = -(-shape[0] // side), -(-shape[1] // side)
    direct = [down(part.white, grid, side) for part in calibration.projectors]
    terms = [_even(grid), _near(grid)]
    if points_m is not None and normals is not None:
        terms.append(form_factors(points_m, normals, grid, side))
    terms = _alike(terms, direct)
    factors = np.tensordot(_weights(terms, direct, indirect, grid, side), np.stack(terms), axes=1).astype(np.float32)
    falling = up(factors @ np.sum(direct, axis=0), grid, side, shape)
    faint = FAINTEST * falling.max(initial=0)
    whole = np.sum(indirect, axis=0)
    scale = np.divide(whole, falling, out=np.zeros_like(whole), where=falling > faint)
    return IndirectLight(factors, scale.astype(np.float32), lit, grid, side)


def beside(part: ProjectorCalibration, shown: FloatImage, lit: Mask) -> FloatImage:
    """Direct light (rows, columns, 3) of a projector's frame where the transport knows none: on table and walls."""
    if part.phase_map is None:
        light = np.broadcast_to(shown.mean(axis=(0, 1)), part.white.shape)
    else:
        at = np.nan_to_num(part.phase_map.projector_px, nan=-1e4)
        light = cv2.remap(shown, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    mixed = part.white * (light @ part.radiometry.mixing.T.astype(np.float32))
    return np.where(lit[..., None], np.float32(0), mixed).astype(np.float32)


def form_factors(points_m: FloatImage, normals: FloatImage, grid: tuple[int, int], side: int) -> FloatImage:
    """(blocks, blocks): cos cos A / (pi r^2 + A), of which nothing is hidden; the source's area by its solid angle.

    A block without a shape receives what its nearest neighbour with one does, and sends nothing.
    """
    known: Mask = np.asarray((np.isfinite(points_m) & np.isfinite(normals)).all(axis=2))
    share = down(known[..., None].astype(np.float32), grid, side)[:, 0]
    with np.errstate(invalid="ignore", divide="ignore"):
        point, normal = (
            down(np.where(known[..., None], image, 0).astype(np.float32), grid, side).astype(np.float64)
            / share[:, None]
            for image in (points_m, normals)
        )
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    good = (share > LEAST_KNOWN) & np.isfinite(point).all(axis=1) & np.isfinite(normal).all(axis=1)
    out = np.zeros((len(good), len(good)), np.float32)
    if np.count_nonzero(good) < 2:
        return out
    p, n = point[good], normal[good]
    # the camera, at the origin, sees outward normals
    n = np.where(np.sum(n * p, axis=1, keepdims=True) > 0, -n, n)
    area = _areas(point, good, grid, n)
    apart = p[None] - p[:, None]
    square = np.maximum(np.sum(apart * apart, axis=2), 1e-12)
    receiving = np.maximum(np.einsum("ijk,ik->ij", apart, n), 0)
    sending = np.maximum(np.einsum("ijk,jk->ij", -apart, n), 0)
    between = receiving * sending / square * area / (np.pi * square + area)
    out[np.ix_(good, good)] = between
    nearest = distance_transform_edt(~good.reshape(grid), return_distances=False, return_indices=True)
    rows = np.ravel_multi_index(tuple(nearest.reshape(2, -1)), grid)
    return np.ascontiguousarray(out[rows])


def _areas(point: Float64, good: Mask, grid: tuple[int, int], normal: Float64) -> Float64:
    """Area of each good block: what it covers before the camera, over the cosine to its normal."""
    depth = np.linalg.norm(point[good], axis=1)
    ray = point[good] / depth[:, None]
    # how far apart the rays of adjacent blocks are, from all pairs of them
    rays = np.full((*grid, 3), np.nan)
    rays[good.reshape(grid)] = ray
    steps = [np.linalg.norm(np.diff(rays, axis=axis), axis=2) for axis in (0, 1)]
    across = [float(np.nanmedian(step)) if np.isfinite(step).any() else 0.0 for step in steps]
    slant = np.maximum(np.abs(np.sum(ray * normal, axis=1)), 0.1)
    return np.asarray(across[0] * across[1] * depth**2 / slant, np.float64)


def _even(grid: tuple[int, int]) -> FloatImage:
    """All blocks give the same to all: surroundings that nobody sees, and glare in lenses."""
    count = grid[0] * grid[1]
    return np.full((count, count), 1 / count, np.float32)


def _near(grid: tuple[int, int]) -> FloatImage:
    """A block's neighbourhood."""
    one = [np.exp(-0.5 * (np.subtract.outer(np.arange(n), np.arange(n)) / NEAR_BLOCKS) ** 2) for n in grid]
    return np.asarray(np.kron(*(part / part.sum(axis=1, keepdims=True) for part in one)), np.float32)


def _alike(terms: Sequence[FloatImage], direct: Sequence[FloatImage]) -> list[FloatImage]:
    """Terms that give as much light each for all whites together; without those that give none."""
    whole = np.sum(direct, axis=0)
    means = [float((term @ whole).mean()) for term in terms]
    return [term / np.float32(mean) for term, mean in zip(terms, means, strict=True) if mean > 0]


def _weights(
    terms: Sequence[FloatImage],
    direct: Sequence[FloatImage],
    indirect: Sequence[FloatImage],
    grid: tuple[int, int],
    side: int,
) -> FloatImage:
    """How much of each term, >= 0 and 1 in all, tells the projectors' indirect light apart best.

    S follows from all projectors together, so a projector's light is predicted as its part of what falls, times the
    light of all. Least squares by blocks, relative to the light; the part's denominator is that of the round before.
    """
    seen = np.stack([down(image, grid, side) for image in indirect])
    whole = seen.sum(axis=0)
    light = whole + np.sum(direct, axis=0)
    shape = indirect[0].shape
    falling = np.stack(
        [[down(up(term @ one, grid, side, shape), grid, side) for term in terms] for one in direct]
    )  # fmt: skip
    found = np.full(len(terms), 1 / len(terms))
    use = (whole > 0) & (light > 1e-3 * light.max(initial=0))
    if len(direct) < 2 or not use.any():
        return found.astype(np.float32)
    for _ in range(ROUNDS):
        every = np.tensordot(falling.sum(axis=0), found, axes=(0, 0))
        gain = np.divide(whole / np.sqrt(np.maximum(light, 1e-30)), every, out=np.zeros_like(whole), where=every > 0)
        gain = np.where(use, gain, 0)
        # sum of terms (falling_n - part_n falling) = 0, which alone would have the answer 0; the sum of all is 1
        part = np.divide(seen, whole, out=np.zeros_like(seen), where=whole > 0)
        rows = (falling - part[:, None] * falling.sum(axis=0)) * gain
        equations = rows.transpose(0, 2, 3, 1).reshape(-1, len(terms))
        heavy = 1e3 * float(np.abs(equations).max(initial=0)) * np.sqrt(len(equations))
        after, _ = nnls(np.vstack([equations, np.full(len(terms), heavy)]), np.append(np.zeros(len(equations)), heavy))
        found = after / max(after.sum(), 1e-30)
    return found.astype(np.float32)
