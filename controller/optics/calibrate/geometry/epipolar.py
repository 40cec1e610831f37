"""What one camera-projector pair says by itself: fundamental matrix, candidates for the projector, flatness."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from controller.core.arrays import Float64, Mask

FOCAL_WIDTHS = (0.5, 8.0)
"""Focal lengths of projectors, in widths of their image (throw ratios), beyond which the search ends."""
SHIFT_HEIGHTS = (-0.8, 1.8)
"""Principal point's row in image heights: 0.5 without lens shift, 1.05 for a projector on a table."""
_COMMON_LENSES = tuple((throw, shift) for throw in (1.0, 1.8, 3.5) for shift in (-0.05, 0.5, 1.05))
_THRESHOLD_PX = 1.5
_FEWEST = 30
_SEEDS = 8


@dataclass(frozen=True, slots=True)
class PairStart:
    """A projector that may explain one fundamental matrix: baseline of length 1; ``in_front``: share of points before
    camera and projector."""

    focal_px: float
    principal_px: tuple[float, float]
    rotation: Float64
    centre: Float64
    in_front: float


def fundamental(camera_px: Float64, projector_px: Float64) -> tuple[Float64, Mask] | None:
    """F with (projector, 1)' F (camera, 1) = 0 by MAGSAC++, and the inliers; None where there is none.

    ``camera_px`` (points, 2) should be scaled so that its pixels are about as large as the projector's.
    """
    if len(camera_px) < _FEWEST:
        return None
    found, inliers = _sought(camera_px, projector_px)
    if found is None or found.shape != (3, 3) or inliers is None or int(inliers.sum()) < _FEWEST:
        return None
    return found.astype(np.float64), inliers.ravel().astype(bool)


def _sought(camera_px: Float64, projector_px: Float64) -> tuple[Any, Any]:
    """What OpenCV finds; None where it finds nothing.

    Its MAGSAC++ (4.14) stops with an internal error when a random sample gives no model, on sound points, too; with
    another sample it goes on. Where none helps, RANSAC, which has no such fault, says what there is.
    """
    for seed in range(_SEEDS):
        try:
            if seed == 0:
                return cv2.findFundamentalMat(camera_px, projector_px, cv2.USAC_MAGSAC, _THRESHOLD_PX, 0.9999, 10000)
            return cv2.findFundamentalMat(camera_px, projector_px, _magsac(seed))
        except cv2.error:
            continue
    return cv2.findFundamentalMat(camera_px, projector_px, cv2.RANSAC, _THRESHOLD_PX, 0.9999, 10000)


def _magsac(seed: int) -> cv2.UsacParams:
    settings = cv2.UsacParams()
    settings.score, settings.final_polisher = cv2.SCORE_METHOD_MAGSAC, cv2.MAGSAC
    settings.loMethod, settings.loIterations, settings.loSampleSize = cv2.LOCAL_OPTIM_SIGMA, 1, 30
    settings.threshold, settings.confidence, settings.maxIterations = _THRESHOLD_PX, 0.9999, 10000
    settings.randomGeneratorState = seed
    return settings


def parallax_px(camera_px: Float64, projector_px: Float64) -> float:
    """How far from flat the scene is: the 80th percentile of the distance to the best homography, projector pixels."""
    homography, _ = cv2.findHomography(camera_px, projector_px, cv2.RANSAC, 3.0)
    if homography is None:
        return 0.0
    mapped = cv2.perspectiveTransform(camera_px[:, None].astype(np.float64), homography)[:, 0]
    return float(np.percentile(np.linalg.norm(mapped - projector_px, axis=1), 80))


def epipolar_distance_px(matrix: Float64, camera_px: Float64, projector_px: Float64) -> Float64:
    """(points,) distance of the projector coordinate from its epipolar line, projector pixels."""
    lines = _homogeneous(camera_px) @ matrix.T
    return np.asarray(np.abs(np.sum(lines * _homogeneous(projector_px), axis=1)) / np.linalg.norm(lines[:, :2], axis=1))


def candidates(
    matrix: Float64, rays: Float64, camera_matrix: Float64, projector_px: Float64, size_px: tuple[int, int], most: int
) -> list[PairStart]:
    """Projectors on a grid over (f, cy) whose essential matrix has locally the most equal singular values; usual ones.

    ``rays`` (points, 2): x, y at depth 1 of the camera pixels that fit ``matrix``; ``projector_px`` (points, 2)
    """
    from scipy import ndimage

    width, height = size_px
    focal = np.geomspace(FOCAL_WIDTHS[0] * width, FOCAL_WIDTHS[1] * width, 48)
    shift = np.linspace(SHIFT_HEIGHTS[0] * height, SHIFT_HEIGHTS[1] * height, 66)
    f, cy = (grid.ravel() for grid in np.meshgrid(focal, shift, indexing="ij"))
    imbalance = _imbalance(_essential(matrix, camera_matrix, f, cy, width))
    table = imbalance.reshape(len(focal), len(shift))
    lowest = np.flatnonzero(ndimage.minimum_filter(table, size=5, mode="nearest").ravel() == imbalance)
    lowest = lowest[np.argsort(imbalance[lowest])][:most]
    # with little depth noise moves the minima anywhere, so usual projectors are tried as well
    f = np.concatenate([f[lowest], [throw * width for throw, _ in _COMMON_LENSES]])
    cy = np.concatenate([cy[lowest], [share * height for _, share in _COMMON_LENSES]])
    starts: list[PairStart] = []
    for essential, own_f, own_cy in zip(_essential(matrix, camera_matrix, f, cy, width), f, cy, strict=True):
        principal = ((width - 1) / 2, float(own_cy))
        rotation, centre, share = _pose(essential, rays, (projector_px - principal) / own_f)
        starts.append(PairStart(float(own_f), principal, rotation, centre, share))
    return starts


def _essential(matrix: Float64, camera_matrix: Float64, f: Float64, cy: Float64, width: int) -> Float64:
    """(candidates, 3, 3) essential matrices for projectors of these focal lengths and principal rows."""
    intrinsic = np.zeros((len(f), 3, 3))
    intrinsic[:, 0, 0] = intrinsic[:, 1, 1] = f
    intrinsic[:, 0, 2], intrinsic[:, 1, 2], intrinsic[:, 2, 2] = (width - 1) / 2, cy, 1.0
    return np.asarray(np.transpose(intrinsic, (0, 2, 1)) @ (matrix @ camera_matrix))


def _imbalance(essential: Float64) -> Float64:
    """(s1 - s2) / (s1 + s2) of the singular values, 0 for a true essential matrix."""
    values = np.linalg.svd(essential, compute_uv=False)
    return np.asarray((values[:, 0] - values[:, 1]) / (values[:, 0] + values[:, 1]))


def inverse_depths(rays: Float64, seen: Float64, rotation: Float64, centre: Float64) -> Float64:
    """(points,) least-squares inverse depth along the camera's rays from one projector's rays (points, 2)."""
    ray, baseline = _homogeneous(rays) @ rotation.T, np.asarray(rotation @ centre)
    left = ray[:, :2] - seen * ray[:, 2:]
    right = baseline[:2] - seen * baseline[2]
    return np.asarray(np.sum(left * right, axis=1) / np.maximum(np.sum(right * right, axis=1), 1e-12))


def _pose(essential: Float64, rays: Float64, seen: Float64) -> tuple[Float64, Float64, float]:
    """The one of four decompositions with the most points in front of both."""
    first, second, translation = cv2.decomposeEssentialMat(essential)
    best: tuple[Float64, Float64, float] | None = None
    for rotation in (first.astype(np.float64), second.astype(np.float64)):
        for sign in (1.0, -1.0):
            centre = np.asarray(-sign * rotation.T @ translation.ravel(), dtype=np.float64)
            inverse = inverse_depths(rays, seen, rotation, centre)
            ahead = (_homogeneous(rays) - inverse[:, None] * centre) @ rotation[2]
            share = float(np.mean((inverse > 0) & (ahead > 0)))
            if best is None or share > best[2]:
                best = (np.asarray(rotation), np.asarray(centre), share)
    assert best is not None
    return best


def _homogeneous(px: Float64) -> Float64:
    return np.concatenate([px, np.ones((len(px), 1))], axis=1)
