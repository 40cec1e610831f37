"""A flat object, or one of a few flat parts: planes in the camera's frame, and where the projectors stand before them.

Homographies say where each projector's pixels lie on a plane. They leave open how the plane is turned: for any turn
there are projectors that explain them. Usual lenses, a camera that looks at the plane from the front, and measured
distances between points of the picture decide; ``covariance`` says how well they do.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import cv2
import numpy as np
import numpy.typing as npt

from controller.core import channels
from controller.core.arrays import Float64, FloatImage, Mask, strips
from controller.core.errors import CalibrationError
from controller.optics.calibrate.geometry import bundle_adjustment as ba
from controller.optics.calibrate.geometry.surface_points import camera_pinhole, pinhole, ray_map
from controller.optics.calibrate.geometry.values import (
    CameraPrior,
    Reconstruction,
    camera_lens,
    metres_per_unit,
    parameter_names,
    projector_lenses,
)
from controller.optics.calibrate.values import Correspondence, Geometry

Labels = npt.NDArray[np.int8]

MOST_PLANES: Final = 4
LEAST_PLANE: Final = 0.08
"""Share of what the projectors light that a plane holds."""
LEAST_FLAT: Final = 0.7
"""Share of what the projectors light that all planes hold together."""
THICK: Final = 0.005
"""Farthest from a plane, in widths of the projector's picture."""
THIN: Final = 0.00125
"""The same where several thick planes would fit a curve."""
SAMPLES: Final = 2500
FEWEST: Final = 30
_TURNED: Final = math.tan(math.radians(15.0))
"""How far from the camera's view a plane usually is turned."""
_APART: Final = 0.3
"""How far planes usually differ, in inverse depths of the first at the middle of the picture, and in its slopes."""
_LEAST_NOISE_PX: Final = 0.05
_EACH: Final = 120
"""Points of a plane and a projector that the adjustment uses."""
_LARGEST_SIGMA: Final = 0.15
_NEARER: Final = np.array([0.5, 1.0, 1.0, 1.0])
"""A plane leaves more to what is usual of lenses, so that the rarest count less than in a search for any."""
_GAUGE_SIGMA: Final = 1e-3
_ANY_UNIT: Final = 100.0
_LEAST_INVERSE: Final = 1e-4
_ITERATIONS: Final = 60
_FARTHEST: Final = 1.2
"""A plane is turned by less than its arc tangent, about each axis."""
_COARSE: Final = 0.02
_SOUND_PX: Final = 2.0


@dataclass(frozen=True, slots=True)
class _Seen:
    """Some of the camera's pixels, in no order.

    ``camera_px`` (points, 2); ``rays`` (points, 3) of depth 1; ``px`` (points, N, 2); ``seen`` (points, N); ``label``
    (points,): the plane, -1 for none
    """

    camera_px: Float64
    rays: Float64
    px: Float64
    seen: Mask
    label: Labels


@dataclass(frozen=True, slots=True)
class _Problem:
    """``seen``: a few points of each projector; ``label`` (points,) and ``rays`` (points, 3) of the same.

    ``ends`` (distances, 2, 3) rays of measured distances with their planes ``ends_on`` (distances, 2), and ``logs``
    (distances, 2) of each length in metres: its logarithm, and how sure that is; ``nearest`` likewise, or None
    """

    seen: ba.AdjustmentProblem
    rays: Float64
    label: Labels
    planes: int
    ends: Float64
    ends_on: Labels
    logs: Float64
    nearest: tuple[float, float] | None


@dataclass(frozen=True, slots=True)
class _State:
    """``planes`` (K, 3), whose product with a ray is the inverse depth; ``log_unit``: logarithm of its metres."""

    stage: ba.AdjustmentState
    planes: Float64
    log_unit: float


def reconstruct_planes(
    correspondences: Sequence[Correspondence],
    camera_size: tuple[int, int],
    projector_sizes: Sequence[tuple[int, int]],
    prior: CameraPrior,
    *,
    most: int = MOST_PLANES,
    thick: float = THICK,
) -> Reconstruction:
    """At most ``most`` planes that hold what the projectors light; the rest as ``self_calibration.reconstruct``.

    ``thick``: how far from its plane a point may be seen, in widths of the projector's picture.

    Raises CalibrationError("not-flat", "geometry-uncertain"), and as ``metres_per_unit``.
    """
    camera = camera_lens(prior, camera_size)[0]
    sizes = np.array(projector_sizes, np.float64)
    rays = ray_map(camera, camera_size)
    limits_px = thick * sizes[:, 0]
    points = _labelled(_sampled(correspondences, rays), limits_px, most)
    problem = _problem(points, prior, camera, projector_sizes)
    state, covariance = _adjusted(problem)
    planes = state.planes
    label, residual = _dense_labels(correspondences, rays, state, limits_px)
    lit = np.logical_or.reduce([own.valid for own in correspondences])
    share = np.count_nonzero(label >= 0) / max(1, int(np.count_nonzero(lit)))
    if share < LEAST_FLAT:
        raise _not_flat(share)
    # the last one where there is none
    towards = np.append(planes, np.full((1, 3), np.nan), axis=0).astype(np.float32)[label]
    directions = np.concatenate([rays, np.ones((*rays.shape[:2], 1), np.float32)], axis=2)
    inverse = channels.total(towards * directions)
    local = np.asarray(directions / inverse[..., None], np.float32)
    unit_m, unit_rel_sigma = metres_per_unit(local, prior.distance_m, prior.distance_rel_sigma, prior.distances)
    count = 10 * len(sizes)
    relative = _relative_sigma(directions, inverse, label, covariance[count:-1, count:-1])
    sigma = float(np.sqrt(np.nanmean(np.square(relative))))
    if sigma > _LARGEST_SIGMA:
        raise CalibrationError(
            "geometry-uncertain",
            what=f"How the planes stand is known only to {sigma:.0%} of their distance.",
            remedy="Measure distances on the object ([[object.distances]] in stage.toml), or use another projector.",
        )
    whole = np.zeros((len(parameter_names(len(sizes))),) * 2)
    scale = np.tile([1.0] * 7 + [unit_m] * 3, len(sizes))
    whole[4:, 4:] = covariance[:count, :count] * np.outer(scale, scale)
    known = label >= 0
    geometry = Geometry(
        camera=camera_pinhole(camera, camera_size),
        projectors=tuple(
            pinhole(lens, turn, centre * unit_m, size)
            for lens, turn, centre, size in zip(
                state.stage.intrinsics, state.stage.rotations, state.stage.centres, projector_sizes, strict=True
            )
        ),
        points_m=local * np.float32(unit_m),
        normals=np.asarray(-towards / channels.length(towards)[..., None], np.float32),
        reprojection_rms_px=float(np.sqrt(np.mean(np.square(residual[known], dtype=np.float64)))),
        scale_known=prior.distance_m is not None or bool(prior.distances),
    )
    return Reconstruction(
        geometry=geometry,
        covariance=whole,
        parameter_names=parameter_names(len(sizes)),
        noise_px=problem.seen.noise_px,
        shape_rel_sigma=sigma,
        scale_rel_sigma=unit_rel_sigma,
        margin=math.inf,
        inlier_share=float(share),
        sigma_m=relative * channels.length(geometry.points_m),
    )


def _not_flat(share: float) -> CalibrationError:
    return CalibrationError(
        "not-flat",
        what=f"The object is not flat: only {share:.0%} of what the projectors light lies on planes.",
        remedy='Set shape under [object] in stage.toml to "auto", and calibrate again.',
    )


def _sampled(correspondences: Sequence[Correspondence], rays: FloatImage) -> _Seen:
    valid = np.stack([own.valid & channels.finite(own.projector_px) for own in correspondences])
    pixels = np.flatnonzero(valid.any(axis=0))
    pixels = np.random.default_rng(7).permutation(pixels)[:SAMPLES]
    rows, columns = np.unravel_index(pixels, valid.shape[1:])
    seen = valid[:, rows, columns].T.copy()
    px = np.stack([own.projector_px[rows, columns] for own in correspondences], axis=1).astype(np.float64)
    px[~seen] = 0.0
    directions = np.concatenate([rays[rows, columns], np.ones((len(rows), 1))], axis=1).astype(np.float64)
    camera_px = np.stack([columns, rows], axis=1).astype(np.float64)
    return _Seen(camera_px, directions, px, seen, np.full(len(rows), -1, np.int8))


def _labelled(points: _Seen, limits_px: Float64, most: int) -> _Seen:
    """Planes by the homographies of the projector that lights most of what is left, carried on by the others."""
    label = points.label.copy()
    least = max(FEWEST, round(LEAST_PLANE * len(label)))
    lit = np.zeros(points.seen.shape[1], np.bool_)
    for _ in range(most):
        free = label < 0
        first = int((points.seen & free[:, None]).sum(axis=0).argmax())
        member = _on_homography(points, first, free & points.seen[:, first], limits_px[first])
        if np.count_nonzero(member) < least:
            break
        for n in range(points.seen.shape[1]):
            both = member & points.seen[:, n]
            if n != first and np.count_nonzero(both) >= FEWEST:
                matrix, _ = cv2.findHomography(points.rays[both, :2], points.px[both, n], cv2.RANSAC, limits_px[n])
                beyond = free & points.seen[:, n] & ~points.seen[:, first]
                member |= beyond & (_off_px(matrix, points, n) < limits_px[n])
        lights = (points.seen & member[:, None]).sum(axis=0) >= FEWEST
        # Nothing says how a plane stands to others with which it shares no projector: it counts as one with the first.
        apart = not (lights & lit).any()
        label[member] = 0 if apart else label.max() + 1
        lit |= lights
    if (label >= 0).mean() < LEAST_FLAT:
        raise _not_flat(float((label >= 0).mean()))
    return replace(points, label=label)


def _on_homography(points: _Seen, n: int, use: Mask, limit_px: float) -> Mask:
    found = np.zeros(len(use), np.bool_)
    if np.count_nonzero(use) >= FEWEST:
        matrix, fits = cv2.findHomography(points.rays[use, :2], points.px[use, n], cv2.RANSAC, limit_px)
        if matrix is not None:
            found[use] = fits.ravel().astype(bool)
    return found


def _off_px(matrix: Any, points: _Seen, n: int) -> Float64:
    if matrix is None:
        return np.full(len(points.rays), np.inf)
    mapped = points.rays @ np.asarray(matrix, np.float64).T
    return np.asarray(np.linalg.norm(mapped[:, :2] / mapped[:, 2:] - points.px[:, n], axis=1))


def _problem(points: _Seen, prior: CameraPrior, camera: Float64, sizes: Sequence[tuple[int, int]]) -> _Problem:
    ends = np.array([[own.from_px, own.to_px] for own in prior.distances], np.float64).reshape(-1, 2)
    directions = np.concatenate([ba.undistorted(camera, ends), np.ones((len(ends), 1))], axis=1)
    on = points.label >= 0
    nearest = [int(np.argmin(np.where(on, np.linalg.norm(points.rays - own, axis=1), np.inf))) for own in directions]
    logs = [(math.log(own.distance_m), own.sigma_m / own.distance_m) for own in prior.distances]
    few = _few(points)
    used = few.any(axis=1)
    usual, sigmas = projector_lenses(sizes)
    lenses = camera, np.ones(4), usual, _NEARER * sigmas
    seen = ba.AdjustmentProblem(points.camera_px[used], points.px[used], few[used], *lenses, _noise_px(points))
    return _Problem(
        seen, points.rays[used], points.label[used], int(points.label.max()) + 1, directions.reshape(-1, 2, 3),
        points.label[nearest].reshape(-1, 2), np.array(logs).reshape(-1, 2),
        None if prior.distance_m is None else (math.log(prior.distance_m), prior.distance_rel_sigma),
    )  # fmt: skip


def _few(points: _Seen) -> Mask:
    """(points, N): at most ``_EACH`` of each plane and projector; the points stand in no order of the picture."""
    used = np.zeros(points.seen.shape, np.bool_)
    for plane in range(int(points.label.max()) + 1):
        for n in range(points.seen.shape[1]):
            used[np.flatnonzero((points.label == plane) & points.seen[:, n])[:_EACH], n] = True
    return used


def _noise_px(points: _Seen) -> float:
    """Standard deviation of one coordinate about the homographies."""
    off = []
    for plane in range(int(points.label.max()) + 1):
        for n in range(points.seen.shape[1]):
            use = (points.label == plane) & points.seen[:, n]
            if np.count_nonzero(use) >= FEWEST:
                matrix, _ = cv2.findHomography(points.rays[use, :2], points.px[use, n], cv2.LMEDS)
                off.append(_off_px(matrix, points, n)[use])
    return max(float(np.median(np.concatenate(off))) / 1.177, _LEAST_NOISE_PX)


def _usual(problem: _Problem, lenses: Float64, planes: Float64, log_unit: float) -> Float64:
    """What is usual or was measured, in standard deviations."""
    parts = [
        ((lenses - problem.seen.projector_prior) / problem.seen.projector_sigma).ravel(),
        planes[0, :2] / planes[0, 2] / _TURNED,
        ((planes[1:] - planes[0]) / _APART).ravel(),
        np.array([(planes[0, 2] - 1) / _GAUGE_SIGMA, log_unit / _ANY_UNIT]),
    ]
    measured = _measured(problem, planes)
    return np.concatenate([*parts, (measured[:, 0] + log_unit) / measured[:, 1]])


def _terms(problem: _Problem, state: _State) -> tuple[Float64, Float64]:
    """All residuals in standard deviations, and their derivatives by projectors (10 N), planes (3 K) and unit."""
    linear, count = ba.linearise(problem.seen, state.stage), len(state.stage.intrinsics)
    size = 10 * count + 3 * problem.planes + 1
    parts, slopes = [], []
    for n in range(count):
        use = problem.seen.seen[:, n]
        block = np.zeros((np.count_nonzero(use), 2, size))
        block[:, :, 10 * n : 10 * n + 10] = linear.by_projector[use, n]
        by_plane = linear.by_depth[use, n][:, :, None] * problem.rays[use][:, None]
        for plane in range(problem.planes):
            here = problem.label[use] == plane
            block[here, :, 10 * count + 3 * plane : 10 * count + 3 * plane + 3] = by_plane[here]
        parts.append(linear.residual_px[use, n].ravel() / problem.seen.noise_px)
        slopes.append(block.reshape(-1, size) / problem.seen.noise_px)
    values = state.stage.intrinsics, state.planes, np.array([state.log_unit])
    usual = _usual(problem, *values[:2], state.log_unit)
    slope = np.zeros((len(usual), size))
    lens_at = [10 * n + k for n in range(count) for k in range(4)]
    for number, at in enumerate([*lens_at, *range(10 * count, size)]):
        flat = np.concatenate([part.ravel() for part in values])
        step = 1e-6 * max(1.0, abs(float(flat[number])))
        flat[number] += step
        lenses, rest = flat[: 4 * count].reshape(-1, 4), flat[4 * count :]
        slope[:, at] = (_usual(problem, lenses, rest[:-1].reshape(-1, 3), float(rest[-1])) - usual) / step
    return np.concatenate([*parts, usual]), np.concatenate([*slopes, slope])


def _stepped(problem: _Problem, state: _State, step: Float64) -> _State:
    count = len(state.stage.intrinsics)
    moved = np.concatenate([np.zeros(ba.CAMERA_PARAMETERS), step[: 10 * count]])
    planes = state.planes + step[10 * count : -1].reshape(-1, 3)
    stage = ba.stepped(state.stage, moved, np.zeros(len(problem.rays)))
    return _State(_on_planes(problem, stage, planes), planes, state.log_unit + float(step[-1]))


def _on_planes(problem: _Problem, stage: ba.AdjustmentState, planes: Float64) -> ba.AdjustmentState:
    inverse = np.einsum("pi,pi->p", problem.rays, planes[problem.label])
    return replace(stage, inverse_depth=np.maximum(inverse, _LEAST_INVERSE))


def _cost(problem: _Problem, state: _State) -> float:
    data = channels.total(ba.residuals(problem.seen, state.stage)[problem.seen.seen] ** 2)
    usual = _usual(problem, state.stage.intrinsics, state.planes, state.log_unit)
    return 0.5 * float(data.sum() / problem.seen.noise_px**2 + usual @ usual)


def _adjusted(problem: _Problem) -> tuple[_State, Float64]:
    """By Levenberg and Marquardt, and the covariance of the steps."""
    state = _start(problem)
    cost, damping = _cost(problem, state), 1e-3
    for _ in range(_ITERATIONS):
        residual, slope = _terms(problem, state)
        information, gradient = slope.T @ slope, slope.T @ residual
        before = cost
        while damping < 1e9:
            step = np.asarray(np.linalg.solve(information + np.diag(damping * np.diag(information) + 1e-12), -gradient))
            proposal = _stepped(problem, state, step)
            if (proposed := _cost(problem, proposal)) < cost:
                state, cost, damping = proposal, proposed, max(damping * 0.2, 1e-9)
                break
            damping *= 6.0
        if before - cost < 1e-5:
            break
    _, slope = _terms(problem, state)
    scale = 1.0 / np.maximum(np.linalg.norm(slope, axis=0), 1e-12)
    covariance = np.linalg.pinv((slope * scale).T @ (slope * scale), hermitian=True)
    return state, covariance * np.outer(scale, scale)


def _start(problem: _Problem) -> _State:
    """Planes that all are turned alike, as far as is most usual, with the projectors that the homographies ask for.

    Data says nothing along this valley, which is bent, so that small steps from anywhere else end in it too early.
    """
    homographies = [_homography(problem, n) for n in range(len(problem.seen.projector_prior))]
    # With lengths as sure as a ruler says, the best turn would lie between those that are tried.
    problem = replace(problem, logs=np.column_stack([problem.logs[:, 0], np.hypot(problem.logs[:, 1], _COARSE)]))
    found, lowest = _turned(problem, homographies, 0.0, 0.0), math.inf
    for reach, steps in ((_FARTHEST, 25), (2 * _FARTHEST / 25, 15)):
        middle = found.planes[0]
        for x in np.linspace(middle[0] - reach, middle[0] + reach, steps):
            for y in np.linspace(middle[1] - reach, middle[1] + reach, steps):
                state = _turned(problem, homographies, float(x), float(y))
                usual = _usual(problem, state.stage.intrinsics, state.planes, state.log_unit)
                if (cost := float(usual @ usual)) < lowest:
                    found, lowest = state, cost
    return replace(found, stage=_on_planes(problem, found.stage, found.planes))


def _homography(problem: _Problem, n: int) -> Float64 | None:
    """(3, 3) from rays to the picture of projector ``n``, of the plane that it lights most."""
    own = problem.label[problem.seen.seen[:, n]]
    if len(own) < FEWEST:
        return None
    use = problem.seen.seen[:, n] & (problem.label == np.bincount(own).argmax())
    matrix, _ = cv2.findHomography(problem.rays[use, :2], problem.seen.projector_px[use, n], cv2.RANSAC, _SOUND_PX)
    return None if matrix is None else np.asarray(matrix, np.float64)


def _turned(problem: _Problem, homographies: Sequence[Float64 | None], x: float, y: float) -> _State:
    """The stage for planes (x, y, 1), with projectors whose axis lies in the middle column of their picture."""
    plane = np.array([x, y, 1.0])
    normal = plane / np.linalg.norm(plane)
    first = np.cross(normal, [0.0, 1.0, 0.0])
    first /= np.linalg.norm(first)
    frame = np.stack([first, np.cross(normal, first), normal / np.linalg.norm(plane)], axis=1)
    lenses, turns, centres = problem.seen.projector_prior.copy(), [], []
    for n, matrix in enumerate(homographies):
        turns.append(np.eye(3))
        centres.append(np.zeros(3))
        if matrix is None:
            continue
        # From coordinates on the plane to pixels beside the middle column: two equations, linear in cy and f2 + cy2
        (x1, x2, _), (y1, y2, _), (z1, z2, _) = on = np.array(
            [[1, 0, -lenses[n, 1]], [0, 1, 0], [0, 0, 1]]
        ) @ matrix @ frame  # fmt: skip
        left = np.array([[-(y1 * z2 + y2 * z1), z1 * z2], [-2 * (y1 * z1 - y2 * z2), z1 * z1 - z2 * z2]])
        right = -np.array([x1 * x2 + y1 * y2, x1 * x1 + y1 * y1 - x2 * x2 - y2 * y2])
        centre, square = np.linalg.lstsq(left, right, rcond=None)[0]
        lenses[n, 2] = centre
        lenses[n, 0] = 0.5 * math.log(max(square - centre * centre, 1.0))
        focal = math.exp(lenses[n, 0])
        local = np.array([[1 / focal, 0, 0], [0, 1 / focal, -centre / focal], [0, 0, 1]]) @ on
        local *= np.sign(local[2, 2]) / math.sqrt(np.linalg.norm(local[:, 0]) * np.linalg.norm(local[:, 1]))
        u, _, v = np.linalg.svd(np.column_stack([local[:, :2], np.cross(local[:, 0], local[:, 1])]))
        turns[n] = u @ v @ np.column_stack([frame[:, :2], normal]).T
        centres[n] = frame[:, 2] - turns[n].T @ local[:, 2]
    planes = np.tile(plane, (problem.planes, 1))
    stage = ba.AdjustmentState(
        problem.seen.camera_prior, lenses, np.stack(turns), np.stack(centres), np.ones(len(problem.rays))
    )
    measured = _measured(problem, planes)
    weight = float(np.sum(1 / measured[:, 1] ** 2))
    return _State(stage, planes, 0.0 if not weight else -float(np.sum(measured[:, 0] / measured[:, 1] ** 2)) / weight)


def _measured(problem: _Problem, planes: Float64) -> Float64:
    """Of each measured length: the logarithm of our units over metres, and how sure it is."""
    rows = []
    if len(problem.ends):
        ends = problem.ends / np.einsum("eki,eki->ek", problem.ends, planes[problem.ends_on])[..., None]
        lengths = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1)
        rows += [(math.log(own) - log, sigma) for own, (log, sigma) in zip(lengths, problem.logs, strict=True)]
    if problem.nearest is not None:
        inverse = np.maximum(np.einsum("pi,pi->p", problem.rays, planes[problem.label]), _LEAST_INVERSE)
        nearest = float(np.min(np.linalg.norm(problem.rays, axis=1) / inverse))
        rows.append((math.log(nearest) - problem.nearest[0], problem.nearest[1]))
    return np.array(rows).reshape(-1, 2)


def _projected(rays: FloatImage, plane: Float64, stage: ba.AdjustmentState, n: int) -> FloatImage:
    """Places (rows, columns, 2) in projector ``n``'s picture of where rays meet a plane, in the rays' own precision."""
    log_focal, x, y, k1 = (np.float32(value) for value in stage.intrinsics[n])
    turn = stage.rotations[n]
    local = rays @ (turn - np.outer(turn @ stage.centres[n], plane)).T.astype(np.float32)
    flat = local[..., :2] / np.maximum(local[..., 2:], np.float32(_LEAST_INVERSE))
    bent = 1 + k1 * channels.total(flat * flat)[..., None]
    return np.asarray(np.exp(log_focal) * bent * flat + np.array([x, y]), np.float32)


def _dense_labels(
    correspondences: Sequence[Correspondence], rays: FloatImage, state: _State, limits_px: Float64
) -> tuple[Labels, FloatImage]:
    """The plane of each camera pixel, -1 for none, and how far off its projectors see it, in pixels."""
    shape = rays.shape[:2]
    label, least = np.full(shape, -1, np.int8), np.ones(shape, np.float32)
    residual = np.zeros(shape, np.float32)
    for rows in strips(shape[0]):
        directions = np.concatenate([rays[rows], np.ones((*rays[rows].shape[:2], 1), np.float32)], axis=2)
        for plane, values in enumerate(state.planes):
            inverse = directions @ values.astype(np.float32)
            square, off, count = (np.zeros(inverse.shape, np.float32) for _ in range(3))
            for n, own in enumerate(correspondences):
                seen = own.valid[rows] & channels.finite(own.projector_px[rows])
                apart = channels.length(_projected(directions, values, state.stage, n) - own.projector_px[rows])
                apart = np.where(seen, apart, np.float32(0))
                square, off, count = square + (apart / np.float32(limits_px[n])) ** 2, off + apart**2, count + seen
            mean = np.where((count > 0) & (inverse > 0), square / np.maximum(count, 1), np.float32(np.inf))
            better = mean < least[rows]
            label[rows][better], least[rows][better] = plane, mean[better]
            residual[rows][better] = np.sqrt(off[better] / count[better])
    return label, residual


def _relative_sigma(directions: FloatImage, inverse: FloatImage, label: Labels, covariance: Float64) -> FloatImage:
    """(rows, columns) float32: standard deviation of each depth as a share of it, NaN off the planes."""
    relative = np.full(label.shape, np.nan, np.float32)
    for plane in range(int(label.max(initial=-1)) + 1):
        own = covariance[3 * plane : 3 * plane + 3, 3 * plane : 3 * plane + 3]
        here = label == plane
        shares, axes = np.linalg.eigh(own)
        root = (axes * np.sqrt(np.maximum(shares, 0))).astype(np.float32)
        relative[here] = channels.length(directions[here] @ root) / inverse[here]
    return relative


__all__ = ["reconstruct_planes"]
