"""From correspondences to a few complete starting points for the global bundle adjustment.

Each camera-projector pair says something by itself: its fundamental matrix gives several candidates for the projector.
A whole stage is chained from them by the ratios of their depths at shared camera pixels. None is dropped for costing a
little more: a depth-reversed one can look better in one pair.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from controller.core import channels
from controller.core.arrays import Float64, Mask
from controller.optics.calibrate.geometry import bundle_adjustment as ba
from controller.optics.calibrate.values import Correspondence

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
    """A projector that may explain one fundamental matrix: baseline of length 1."""

    focal_px: float
    principal_px: tuple[float, float]
    rotation: Float64
    centre: Float64


def fundamental(camera_px: Float64, projector_px: Float64) -> tuple[Float64, Mask] | None:
    """F with (projector, 1)' F (camera, 1) = 0 by MAGSAC++, and the inliers; None where there is none.

    ``camera_px`` (points, 2) should be scaled so that its pixels are about as large as the projector's.
    """
    matrix, inliers = _sought(camera_px, projector_px)
    if matrix is None or matrix.shape != (3, 3) or inliers is None or int(inliers.sum()) < _FEWEST:
        return None
    return matrix.astype(np.float64), inliers.ravel().astype(bool)


def _sought(camera_px: Float64, projector_px: Float64) -> tuple[Any, Any]:
    """What OpenCV finds; None where it finds nothing.

    Its MAGSAC++ (4.14) stops with an internal error when a random sample gives no model, on sound points, too; with
    another sample it continues. Where none helps, RANSAC, which has no such fault, says what there is.
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
        rotation, centre = _pose(essential, rays, (projector_px - principal) / own_f)
        starts.append(PairStart(float(own_f), principal, rotation, centre))
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


def _pose(essential: Float64, rays: Float64, seen: Float64) -> tuple[Float64, Float64]:
    """Rotation and centre by the one of four decompositions with the most points in front of both."""
    first, second, translation = cv2.decomposeEssentialMat(essential)
    poses: list[tuple[float, Float64, Float64]] = []
    for rotation in (first.astype(np.float64), second.astype(np.float64)):
        for sign in (1.0, -1.0):
            centre = np.asarray(-sign * rotation.T @ translation.ravel(), dtype=np.float64)
            inverse = inverse_depths(rays, seen, rotation, centre)
            ahead = (_homogeneous(rays) - inverse[:, None] * centre) @ rotation[2]
            poses.append((float(np.mean((inverse > 0) & (ahead > 0))), rotation, centre))
    _, rotation, centre = max(poses, key=lambda pose: pose[0])
    return rotation, centre


def _homogeneous(px: Float64) -> Float64:
    return np.concatenate([px, np.ones((len(px), 1))], axis=1)


_CANDIDATES = 6
_KEPT = 4
_PAIR_POINTS = 400
_FEWEST_SHARED = 30


@dataclass(frozen=True, slots=True)
class Pair:
    """One projector by itself: ``candidates`` each with its depths at every sampled pixel, cheapest first.

    ``noise_px`` and ``parallax_px`` tell a flat scene from a deep one; ``inliers`` (points,)
    """

    candidates: tuple[tuple[ba.AdjustmentState, float], ...]
    noise_px: float
    parallax_px: float
    inliers: Mask


def sample_pixels(correspondences: Sequence[Correspondence], most: int) -> tuple[Float64, Float64, Mask]:
    """Camera pixels that at least two projectors see, the same ones in whatever order the projectors come.

    Returns ``camera_px`` (points, 2), ``projector_px`` (points, N, 2), ``seen`` (points, N).
    """
    valid = np.stack([c.valid & channels.finite(c.projector_px) for c in correspondences])
    shared = valid.sum(axis=0) >= 2
    chosen = np.zeros(shared.shape, dtype=np.bool_)
    for own in valid:
        inner = own & shared
        inner[1:-1, 1:-1] &= own[:-2, 1:-1] & own[2:, 1:-1] & own[1:-1, :-2] & own[1:-1, 2:]
        pixels = np.flatnonzero(inner)
        share = most // len(valid)
        if len(pixels) > share:
            pixels = np.random.default_rng(7).choice(pixels, share, replace=False)
        chosen.ravel()[pixels] = True
    rows, columns = np.nonzero(chosen)
    observed = np.stack([c.projector_px[rows, columns] for c in correspondences], axis=1).astype(np.float64)
    seen = valid[:, rows, columns].T.copy()
    observed[~seen] = 0.0
    return np.stack([columns, rows], axis=1).astype(np.float64), observed, seen


def solve_pair(problem: ba.AdjustmentProblem, index: int, size_px: tuple[int, int]) -> Pair | None:
    """Candidates for one projector from its correspondences alone; None where no epipolar geometry fits them."""
    seen = np.flatnonzero(problem.seen[:, index])
    observed = problem.projector_px[seen, index]
    focal, middle = float(np.exp(problem.camera_prior[0])), problem.camera_prior[1:3]
    rays = ba.undistorted(problem.camera_prior, problem.camera_px[seen])
    camera_px = focal * rays + middle  # as a lens without distortion puts them
    # MAGSAC measures in both images with one threshold: bring the camera's pixels to the projector's size
    shrink = float(np.sqrt(_spread(observed) / max(_spread(camera_px), 1e-9)))
    fit = fundamental(camera_px * shrink, observed)
    if fit is None:
        return None
    matrix, fits = fit[0] @ np.diag([shrink, shrink, 1.0]), fit[1]
    noise = 1.4826 * float(np.median(epipolar_distance_px(matrix, camera_px[fits], observed[fits])))
    inliers = np.zeros(len(problem.seen), dtype=np.bool_)
    inliers[seen[fits]] = True
    camera_matrix = np.array([[focal, 0, middle[0]], [0, focal, middle[1]], [0, 0, 1.0]], dtype=np.float64)
    starts = candidates(matrix, rays[fits], camera_matrix, observed[fits], size_px, _CANDIDATES)
    chosen = seen[fits][:: max(1, int(fits.sum()) // _PAIR_POINTS)]
    small = replace(restricted(problem, chosen, [index]), noise_px=max(noise, 0.02))
    solved = []
    for start in starts:
        adjusted = ba.adjust(small, _from_start(small, start), tolerance=1e-5)
        ahead = float(np.mean(adjusted.state.inverse_depth > 0))
        if ahead > 0.95:
            solved.append((adjusted.state, adjusted.cost))
    parallax = parallax_px(camera_px[fits], observed[fits])
    kept = tuple(_distinct(sorted(solved, key=lambda pair: pair[1]))[:_KEPT])
    return Pair(kept, noise, parallax, inliers)


def chain(problem: ba.AdjustmentProblem, pairs: Sequence[Pair]) -> list[ba.AdjustmentState]:
    """Complete stages, one for every candidate of every pair, completed by the candidates that agree with it best."""
    depths = [[_depths(problem, n, state) for state, _ in pair.candidates] for n, pair in enumerate(pairs)]
    picks: set[tuple[int, ...]] = set()
    hypotheses = []
    for base, pair in enumerate(pairs):
        for candidate in range(len(pair.candidates)):
            chained = _complete(depths, base, candidate)
            if chained is None or tuple(chained[0]) in picks:
                continue
            picks.add(tuple(chained[0]))
            hypotheses.append(_assembled(pairs, *chained, depths))
    return hypotheses


def restricted(
    problem: ba.AdjustmentProblem, points: npt.NDArray[np.intp] | Mask, projectors: Sequence[int]
) -> ba.AdjustmentProblem:
    """The same problem with some of its points and projectors."""
    n = list(projectors)
    return replace(
        problem,
        camera_px=problem.camera_px[points],
        projector_px=problem.projector_px[points][:, n],
        seen=problem.seen[points][:, n],
        projector_prior=problem.projector_prior[n],
        projector_sigma=problem.projector_sigma[n],
    )


def triangulated(problem: ba.AdjustmentProblem, state: ba.AdjustmentState) -> Float64:
    """(points,) inverse depths from all projectors that see each point; NaN where none does."""
    xy = ba.undistorted(state.camera, problem.camera_px)
    total, weight = np.zeros(len(xy)), np.zeros(len(xy))
    for n in range(problem.seen.shape[1]):
        rays = ba.undistorted(state.intrinsics[n], problem.projector_px[:, n])
        by_projector = inverse_depths(xy, rays, state.rotations[n], state.centres[n])
        usable = np.where(problem.seen[:, n], np.sum(state.centres[n] ** 2), 0.0)
        total, weight = total + usable * by_projector, weight + usable
    return np.asarray(np.where(weight > 0, total / np.maximum(weight, 1e-300), np.nan))


def _from_start(problem: ba.AdjustmentProblem, start: PairStart) -> ba.AdjustmentState:
    intrinsics = np.array([[np.log(start.focal_px), *start.principal_px, 0.0]])
    empty = np.ones(len(problem.camera_px))
    state = ba.AdjustmentState(problem.camera_prior, intrinsics, start.rotation[None], start.centre[None], empty)
    return replace(state, inverse_depth=triangulated(problem, state))


def _depths(problem: ba.AdjustmentProblem, index: int, state: ba.AdjustmentState) -> Float64:
    one = restricted(problem, np.ones(len(problem.seen), dtype=np.bool_), [index])
    inverse = triangulated(one, state)
    return np.asarray(np.where(inverse > 0, inverse, np.nan))


def _distinct(solved: list[tuple[ba.AdjustmentState, float]]) -> list[tuple[ba.AdjustmentState, float]]:
    """One of each group that differs by less than 1 % in focal length and 0.02 in pose."""
    kept: list[tuple[ba.AdjustmentState, float]] = []
    for state, cost in solved:
        same = (
            abs(state.intrinsics[0, 0] - other.intrinsics[0, 0]) < 0.01
            and float(np.abs(state.centres - other.centres).max()) < 0.02
            and float(np.abs(state.rotations - other.rotations).max()) < 0.02
            for other, _ in kept
        )
        if not any(same):
            kept.append((state, cost))
    return kept


def _complete(depths: list[list[Float64]], base: int, candidate: int) -> tuple[list[int], list[float]] | None:
    """Candidate and scale for every projector, joined where most pixels are shared; None if not connected."""
    picks, scales = [-1] * len(depths), [1.0] * len(depths)
    picks[base] = candidate
    known = depths[base][candidate].copy()
    while -1 in picks:
        joins = [_closest(options, known) for n, options in enumerate(depths) if picks[n] < 0]
        waiting = [n for n, pick in enumerate(picks) if pick < 0]
        shared, middle, k, n = max((*join, n) for join, n in zip(joins, waiting, strict=True))
        if shared < _FEWEST_SHARED:
            return None
        picks[n], scales[n] = k, float(np.exp(middle))
        known = np.where(np.isfinite(known), known, depths[n][k] / scales[n])
    return picks, scales


def _closest(options: list[Float64], known: Float64) -> tuple[int, float, int]:
    """Points shared, middle log ratio of depths, and index of the candidate whose ratios to ``known`` differ least."""
    best, lowest = (0, 0.0, -1), np.inf
    for k, own in enumerate(options):
        ratio = np.log(own / known)
        ratio = ratio[np.isfinite(ratio)]
        if len(ratio) < _FEWEST_SHARED:
            continue
        middle = float(np.median(ratio))
        disorder = float(np.median(np.abs(ratio - middle)))
        if disorder < lowest:
            best, lowest = (len(ratio), middle, k), disorder
    return best


def _assembled(
    pairs: Sequence[Pair], picks: list[int], scales: list[float], depths: list[list[Float64]]
) -> ba.AdjustmentState:
    states = [pair.candidates[k][0] for pair, k in zip(pairs, picks, strict=True)]
    # a candidate's inverse depths are scales[n] times too large, so its baseline is too small by as much
    scaled = np.array([own[k] / s for own, k, s in zip(depths, picks, scales, strict=True)])
    known = np.isfinite(scaled)
    inverse = np.where(known, scaled, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
    typical = float(np.median(inverse[known.any(axis=0)]))
    return ba.AdjustmentState(
        np.mean([s.camera for s in states], axis=0),
        np.concatenate([s.intrinsics for s in states]),
        np.concatenate([s.rotations for s in states]),
        np.concatenate([s.centres * scale for s, scale in zip(states, scales, strict=True)]),
        np.where(known.any(axis=0), inverse, typical),
    )


def _spread(px: Float64) -> float:
    return float(np.sum(np.var(px, axis=0)))
