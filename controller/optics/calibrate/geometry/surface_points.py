"""The object at every camera pixel, in metres, once the poses are known.

Inverse depths are noisy, so each point is read from a curved patch through its neighbourhood. A plane would shave the
object's curvature off: on the emulated stage planes of 7 pixels cost 0.3 mm, where the measurement itself is good to
0.05 mm.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numba
import numpy as np

from controller.core import channels
from controller.core.arrays import Float64, FloatImage, Mask
from controller.core.errors import CalibrationError
from controller.core.jit import compiled
from controller.optics.calibrate.geometry import bundle_adjustment as ba
from controller.optics.calibrate.geometry.triangulation import fit_planes, inverse_depth_map, projector_rays
from controller.optics.calibrate.geometry.values import CameraPrior, metres_per_unit
from controller.optics.calibrate.values import Correspondence, Geometry, Pinhole

SAME_SURFACE: Final = 0.02
"""Relative step of inverse depth beyond which a neighbour lies on another surface."""
STEEPEST: Final = 10.0
"""Relative step of inverse depth over two pixels, in pixel widths: beyond it (79 degrees from head-on) both pixels may
see two surfaces at once."""
SMOOTHING_PX: Final = 2
"""Points come from patches with sides of 2 * 2 + 1 pixels, normals from planes one pixel wider on each side."""
TERMS: Final = 6
LANES: Final = 256
"""Pixels of a row whose patches are fitted together."""


def whole_pixels(inverse: FloatImage, focal_px: float) -> Mask:
    """(rows, columns): neither the pixel nor any of the eight around it sees an edge of the object.

    A pixel at an edge mixes two surfaces, and optics and colour pattern carry that on to the next. A single wrong or
    missing pixel is not an edge, but not whole either. ``inverse`` (rows, columns) float32 is NaN where unknown.
    """
    square, step = np.ones((3, 3), np.uint8), STEEPEST / focal_px
    filled = np.where(np.isfinite(inverse), inverse, np.float32(0))
    steady = cv2.medianBlur(filled, 3)
    edge = cv2.dilate(steady, square) - cv2.erode(steady, square) > step * steady
    whole = cv2.dilate(edge.astype(np.uint8), square) == 0
    return np.asarray(whole & (filled > 0) & (np.abs(filled - steady) <= step * filled))


@compiled(parallel=True)
def fit_patches(inverse: FloatImage, whole: Mask, radius: int) -> FloatImage:
    """Fit a polynomial of second degree to the inverse depths around each pixel, robustly, within one surface.

    Parameters
    ----------
    inverse : (rows, columns) float32, NaN where unknown
    whole : (rows, columns) bool, the pixels to fit to (``whole_pixels``); the others are only replaced by the fit
    radius : the neighbourhood is (2 radius + 1) pixels square, at least 2

    Returns
    -------
    (rows, columns) float32: the patch's value at each pixel; NaN where fewer than twelve whole pixels of its surface
    are in reach or its own value is far off the patch
    """
    rows, columns = inverse.shape
    smooth = np.full((rows, columns), np.nan, dtype=np.float32)
    for row in numba.prange(rows):
        for first in range(0, columns, LANES):
            last = min(first + LANES, columns)
            if np.any(inverse[row, first:last] > 0):
                _patches_at(inverse, whole, radius, row, first, smooth[row, first:last])
    return smooth


@compiled()
def _patches_at(inverse: FloatImage, whole: Mask, radius: int, row: int, first: int, smooth: FloatImage) -> None:
    """The patches' values at neighbouring pixels of a row, from column ``first``, into ``smooth`` (pixels,)."""
    here = inverse[row, first : first + smooth.size]
    patch, spread = np.zeros((TERMS, here.size)), np.full(here.size, np.inf)
    count, good = np.zeros(here.size), here > 0
    matrix, right = np.empty((TERMS, TERMS, here.size)), np.empty((TERMS, here.size))
    for _ in range(2):
        _equations(inverse, whole, radius, row, first, patch, spread, matrix, right)
        _solve(matrix, right, good)
        patch[:] = right
        _spread(inverse, whole, radius, row, first, patch, spread, count)
    for k in range(here.size):
        value, limit = patch[0, k], 5.0 * np.sqrt(spread[k]) + 1e-6 * here[k]
        if good[k] and count[k] >= 2 * TERMS and value > -here[k] and abs(value) <= limit:
            smooth[k] = here[k] + value


@compiled()
def _equations(
    inverse: FloatImage,
    whole: Mask,
    radius: int,
    row: int,
    first: int,
    patch: Float64,
    spread: Float64,
    matrix: Float64,
    right: Float64,
) -> None:
    """Normal equations of patches; neighbours far from the ``patch`` before count less, all alike if ``spread`` is inf.

    ``patch``, ``right`` (TERMS, pixels); ``spread`` (pixels,); ``matrix`` (TERMS, TERMS, pixels), whose lower half is
    filled. The innermost loops run along a row, so that they use vectors.
    """
    off, value, weight = np.empty(spread.size), np.empty(spread.size), np.empty(spread.size)
    matrix[:], right[:] = 0.0, 0.0
    for i in range(max(0, row - radius), min(inverse.shape[0], row + radius + 1)):
        for shift in range(-radius, radius + 1):
            terms = _terms(shift / radius, (i - row) / radius)
            _compare(inverse[row], inverse[i], whole[i], first, shift, value, weight)
            off[:] = value
            _leave(off, patch, terms)
            for p in range(off.size):
                weight[p] /= 1.0 + off[p] * off[p] / (4.0 * spread[p] + 1e-20)
                value[p] *= weight[p]
            _add(right, value, terms, 1.0)
            for k in range(TERMS):
                _add(matrix[k], weight, terms[: k + 1], terms[k])


@compiled()
def _terms(dx: float, dy: float) -> Float64:
    return np.array([1.0, dx, dy, dx * dx, dx * dy, dy * dy])


@compiled()
def _compare(
    here: FloatImage, other: FloatImage, whole: Mask, first: int, shift: int, value: Float64, weight: Float64
) -> None:
    """What the neighbours beside a row's pixels differ by; 0 with no weight where they are not whole, lie on another
    surface, or outside the picture."""
    value[:], weight[:] = 0.0, 0.0
    a, e = max(0, -first - shift), min(value.size, here.size - first - shift)
    if a < e:
        at, there = slice(first + a, first + e), slice(first + a + shift, first + e + shift)
        _differ(here[at], other[there], whole[there], value[a:e], weight[a:e])


@compiled()
def _differ(here: FloatImage, other: FloatImage, whole: Mask, value: Float64, weight: Float64) -> None:
    for p in range(value.size):
        difference = other[p] - here[p]
        use = whole[p] & (abs(difference) < SAME_SURFACE * here[p])
        value[p], weight[p] = difference if use else 0.0, 1.0 if use else 0.0


@compiled()
def _add(totals: Float64, values: Float64, terms: Float64, factor: float) -> None:
    """Add values (pixels,) times each term to its row of ``totals``."""
    for k in range(terms.size):
        if terms[k] != 0:
            for p in range(values.size):
                totals[k, p] += factor * terms[k] * values[p]


@compiled()
def _leave(off: Float64, patch: Float64, terms: Float64) -> None:
    """Take the patches from values."""
    for k in range(terms.size):
        if terms[k] != 0:
            for p in range(off.size):
                off[p] -= patch[k, p] * terms[k]


@compiled()
def _spread(
    inverse: FloatImage, whole: Mask, radius: int, row: int, first: int, patch: Float64, spread: Float64, count: Float64
) -> None:
    """Mean squared distance of the neighbours from patches, and how many they are; arrays as in ``_equations``."""
    off, weight = np.empty(spread.size), np.empty(spread.size)
    spread[:], count[:] = 0.0, 0.0
    for i in range(max(0, row - radius), min(inverse.shape[0], row + radius + 1)):
        for shift in range(-radius, radius + 1):
            _compare(inverse[row], inverse[i], whole[i], first, shift, off, weight)
            _leave(off, patch, _terms(shift / radius, (i - row) / radius))
            for p in range(off.size):
                spread[p] += weight[p] * off[p] * off[p]
                count[p] += weight[p]
    for k in range(spread.size):
        spread[k] /= max(count[k], 1.0)


@compiled()
def _solve(matrix: Float64, right: Float64, good: Mask) -> None:
    """Solve in place by Cholesky from the lower halves; not ``good`` where the neighbours do not fix a patch."""
    for i in range(TERMS):
        for j in range(i + 1):
            for k in range(j):
                _subtract(matrix[i, j], matrix[i, k], matrix[j, k])
            if i == j:
                for p in range(good.size):
                    good[p] &= matrix[i, i, p] > 1e-4
                matrix[i, i] = np.sqrt(matrix[i, i])
            else:
                _divide(matrix[i, j], matrix[j, j])
    for i in range(TERMS):
        for k in range(i):
            _subtract(right[i], matrix[i, k], right[k])
        _divide(right[i], matrix[i, i])
    for i in range(TERMS - 1, -1, -1):
        for k in range(i + 1, TERMS):
            _subtract(right[i], matrix[k, i], right[k])
        _divide(right[i], matrix[i, i])


@compiled()
def _subtract(total: Float64, one: Float64, other: Float64) -> None:
    for k in range(total.size):
        total[k] -= one[k] * other[k]


@compiled()
def _divide(total: Float64, by: Float64) -> None:
    for k in range(total.size):
        total[k] /= by[k]


LEAST_NOISE_PX: Final = 0.03
"""Projectors that disagree by less than a few times this still agree, however good the rest of the fit is."""


@dataclass(frozen=True, slots=True)
class ObjectPoints:
    """The object, metres per unit of the adjusted state with its relative deviation, and how sure each point is.

    ``sigma_m`` (rows, columns) float32: standard deviation of a point along the camera's ray, NaN where unknown
    """

    geometry: Geometry
    unit_m: float
    unit_rel_sigma: float
    sigma_m: FloatImage


@dataclass(frozen=True, slots=True)
class AdjustedStage:
    """Camera and projectors as the bundle adjustment leaves them.

    ``noise_px`` standard deviation of one projector coordinate
    ``shape_rel_sigma`` expected rms error of the points by wrong parameters, as a share of their distance, scale apart
    ``camera_size``, ``projector_sizes`` (width, height) of the pictures
    """

    state: ba.AdjustmentState
    noise_px: float
    shape_rel_sigma: float
    camera_size: tuple[int, int]
    projector_sizes: Sequence[tuple[int, int]]


def object_points(stage: AdjustedStage, correspondences: Sequence[Correspondence], prior: CameraPrior) -> ObjectPoints:
    """Triangulate every camera pixel and set the scale by what ``prior`` says was measured.

    Without a measured distance the nearest object point is put at 1 m. Pixels whose projectors disagree, and pixels
    off the surface around them, stay unknown. ``reprojection_rms_px`` is over all others. ``sigma_m`` holds the noise
    of the correspondences, not lessened by smoothing, since neighbours err together, and the parameters' part.

    Raises CalibrationError as ``metres_per_unit``, and "geometry-uncertain".
    """
    state = stage.state
    rays = ray_map(state.camera, stage.camera_size)
    seen = np.stack([c.valid & channels.finite(c.projector_px) for c in correspondences])
    slopes = projector_rays(np.stack([c.projector_px for c in correspondences]), np.ascontiguousarray(state.intrinsics))
    noise_px = max(stage.noise_px, LEAST_NOISE_PX)
    raw, residual, leverage = inverse_depth_map(
        rays,
        slopes,
        seen,
        np.exp(state.intrinsics[:, 0]),
        np.ascontiguousarray(state.rotations),
        state.centres,
        noise_px,
    )
    raw = np.where(raw > 0, raw, np.float32(np.nan))
    smooth, normals = _surface(raw, rays, float(np.exp(state.camera[0])))
    known = np.isfinite(smooth)
    if not known.any():
        raise CalibrationError(
            "geometry-uncertain",
            what="No camera pixel lies on a smooth surface on which the projectors agree.",
            remedy="Check focus and exposure of the pattern pictures, then capture again.",
        )
    directions = np.concatenate([rays, np.ones((*rays.shape[:2], 1), dtype=np.float32)], axis=2)
    points: FloatImage = (directions / smooth[..., None]).astype(np.float32)
    unit_m, unit_rel_sigma = metres_per_unit(points, prior.distance_m, prior.distance_rel_sigma, prior.distances)
    relative = np.hypot(np.maximum(residual, noise_px) * leverage / smooth, np.float32(stage.shape_rel_sigma))
    geometry = Geometry(
        camera=camera_pinhole(state.camera, stage.camera_size),
        projectors=tuple(
            pinhole(state.intrinsics[n], state.rotations[n], state.centres[n] * unit_m, size)
            for n, size in enumerate(stage.projector_sizes)
        ),
        points_m=(points * unit_m).astype(np.float32),
        normals=normals,
        reprojection_rms_px=float(np.sqrt(np.mean(residual[known].astype(np.float64) ** 2))),
        scale_known=prior.distance_m is not None or bool(prior.distances),
    )
    sigma_m = (relative * channels.length(points) * unit_m).astype(np.float32)
    return ObjectPoints(geometry, unit_m, unit_rel_sigma, sigma_m)


def _surface(raw: FloatImage, rays: FloatImage, focal_px: float) -> tuple[FloatImage, FloatImage]:
    """Inverse depths from curved patches, and normals from planes one pixel wider; NaN unless both are known."""
    whole = whole_pixels(raw, focal_px)
    smooth = fit_patches(raw, whole, SMOOTHING_PX)
    _, normals = fit_planes(smooth, rays, SMOOTHING_PX + 1)
    smooth[~np.isfinite(normals[..., 0])] = np.nan
    return smooth, normals


def ray_map(camera: Float64, size: tuple[int, int]) -> FloatImage:
    """(rows, columns, 2) float32 undistorted x, y at depth 1 of every camera pixel."""
    width, height = size
    rays = np.empty((height, width, 2), np.float32)
    for row in range(height):
        rays[row] = ba.undistorted(camera, np.stack([np.arange(width), np.full(width, row)], axis=1, dtype=np.float64))
    return rays


def camera_pinhole(lens: Float64, size: tuple[int, int]) -> Pinhole:
    """The camera, which is the origin; ``lens`` as ``bundle_adjustment`` has it."""
    return pinhole(lens, np.eye(3), np.zeros(3), size)


def pinhole(lens: Float64, rotation: Float64, centre_m: Float64, size: tuple[int, int]) -> Pinhole:
    """A camera or projector of a ``lens`` as ``bundle_adjustment`` has it."""
    lens = np.append(lens, np.zeros(8 - len(lens)))
    fx, fy = np.exp(lens[0]), np.exp(lens[0] + lens[7])
    matrix = np.array([[fx, 0.0, lens[1]], [0.0, fy, lens[2]], [0.0, 0.0, 1.0]])
    return Pinhole(matrix, lens[3:7], rotation.copy(), -rotation @ centre_m, size)
