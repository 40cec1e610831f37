"""One bundle adjustment over all views: where each camera stands, with the projectors that they share.

Each view has its own points, on the rays of its camera; the projectors are the same for all of them. So a view's
equations are those of ``bundle_adjustment``, for projectors in its camera's frame, and these follow from poses in the
first camera's frame by the chain rule. Views need not overlap: two projectors that both see join them, also in size.
Poses that were measured in the room are observations, too; how the room lies in the first camera's frame is adjusted.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Final

import cv2
import numpy as np

from controller.config.models import PoseTable
from controller.core import channels
from controller.core.arrays import Float64, Mask
from controller.core.errors import CalibrationError
from controller.optics.calibrate.geometry import bundle_adjustment as ba
from controller.optics.calibrate.geometry import pose_initialisation
from controller.optics.calibrate.geometry.normal_equations import reduced, solve_positive
from controller.optics.calibrate.geometry.self_calibration import LARGEST_SHAPE_SIGMA, noise_of, shape_sigma
from controller.optics.calibrate.geometry.surface_points import AdjustedStage, object_points
from controller.optics.calibrate.geometry.values import (
    MOST_SIGMAS,
    CameraPrior,
    Reconstruction,
    camera_lens,
    parameter_names,
    projector_lenses,
)
from controller.optics.calibrate.mesh_alignment import Pose
from controller.optics.calibrate.values import Correspondence, Geometry, Pinhole

SAMPLES: Final = 4000
"""Points of each view."""
FEWEST_POINTS: Final = 200
"""With which a view sees a projector."""
LINKS: Final = 2
"""Projectors that two views have to see together."""
POSE: Final = 6
"""Parameters of a view's place: turn and centre."""
ROOM: Final = 7
"""Parameters of the room's frame: turn, shift, and the logarithm of the metres in a unit."""
ANYWHERE: Final = 1e3
"""Standard deviation of a step of them, for what no measured pose tells."""


@dataclass(frozen=True, slots=True)
class SeenStage:
    """What one view saw, and where its own geometry puts camera and projectors.

    ``correspondences``: one a projector of the stage, without a valid pixel where the view does not see it
    ``poses``: of the projectors that it sees, by number, in its camera's frame
    """

    name: str
    correspondences: Sequence[Correspondence]
    camera_size: tuple[int, int]
    prior: CameraPrior
    poses: Mapping[int, Pinhole]


@dataclass(frozen=True, slots=True)
class JoinedView:
    """``pose``: from the first camera's frame to this one's; ``reconstruction``: of this view, in its camera's frame,
    with all projectors of the stage."""

    pose: Pose
    reconstruction: Reconstruction


@dataclass(frozen=True, slots=True)
class _Room:
    """``measured``: poses in the room by a device's number; and how the first camera's frame lies in theirs."""

    measured: Mapping[int, PoseTable]
    turn: Float64
    shift_m: Float64
    log_metres: float

    def moved(self, step: Float64) -> _Room:
        turn = _turns(step[:3])[0] @ self.turn
        return replace(self, turn=turn, shift_m=self.shift_m + step[3:6], log_metres=self.log_metres + float(step[6]))

    def terms(self, places: _Places) -> Iterator[tuple[int, Float64, Float64]]:
        """Of each measured position: whose it is, the residual in sigmas, and its derivatives."""
        to_room = math.exp(self.log_metres) * self.turn
        for number, own in self.measured.items():
            centre, column = places.device(number)
            x, y, z = there = to_room @ centre
            row = np.zeros((3, places.columns))
            row[:, -ROOM:] = np.column_stack([[[0, z, -y], [-z, 0, x], [y, -x, 0]], np.eye(3), there])
            if column is not None:
                row[:, column : column + 3] = to_room
            yield number, (there + self.shift_m - own.position_m) / own.sigma_m, row / own.sigma_m


@dataclass(frozen=True, slots=True)
class _Places:
    """``lenses`` of each view's camera, ``turns`` (views, 3, 3) from the first camera's frame to each, ``stands``
    (views, 3) their centres; ``intrinsics``, ``rotations``, ``centres``: of the projectors in the first one's frame;
    ``depths``: of each view's points."""

    lenses: tuple[Float64, ...]
    turns: Float64
    stands: Float64
    intrinsics: Float64
    rotations: Float64
    centres: Float64
    depths: tuple[Float64, ...]
    room: _Room

    def device(self, number: int) -> tuple[Float64, int | None]:
        """Centre of a camera, or after these of a projector, and its first column; the first camera has none."""
        views = len(self.lenses)
        if number < views:
            return self.stands[number], ba.CAMERA_PARAMETERS * views + POSE * number - 3 if number else None
        n = number - views
        return self.centres[n], self.first + ba.PROJECTOR_PARAMETERS * n + ba.LENS_PARAMETERS + 3

    @property
    def first(self) -> int:
        """The column with which those of the projectors begin."""
        return ba.CAMERA_PARAMETERS * len(self.lenses) + POSE * (len(self.lenses) - 1)

    @property
    def columns(self) -> int:
        return self.first + ba.PROJECTOR_PARAMETERS * len(self.intrinsics) + ROOM

    def seen_by(self, v: int) -> ba.AdjustmentState:
        """The stage in the frame of a view's camera."""
        rotations = self.rotations @ self.turns[v].T
        centres = (self.centres - self.stands[v]) @ self.turns[v].T
        return ba.AdjustmentState(self.lenses[v], self.intrinsics, rotations, centres, self.depths[v])

    def moved(self, step: Float64, depths: Sequence[Float64]) -> _Places:
        """After a step of all parameters: lenses and places of the cameras, projectors, room."""
        views = len(self.lenses)
        lenses = step[: ba.CAMERA_PARAMETERS * views].reshape(views, -1)
        places = step[lenses.size : self.first].reshape(-1, POSE)
        own = step[self.first : -ROOM].reshape(-1, ba.PROJECTOR_PARAMETERS)
        cameras = []
        for lens, change in zip(self.lenses, lenses, strict=True):
            camera = lens.copy()
            camera[: ba.CAMERA_PARAMETERS] += change
            cameras.append(camera)
        turned = [turn @ before for turn, before in zip(_turns(places[:, :3]), self.turns[1:], strict=True)]
        return _Places(
            tuple(cameras),
            np.stack([self.turns[0], *turned]),
            np.concatenate([self.stands[:1], self.stands[1:] + places[:, 3:]]),
            self.intrinsics + own[:, : ba.LENS_PARAMETERS],
            _turns(own[:, ba.LENS_PARAMETERS : ba.LENS_PARAMETERS + 3]) @ self.rotations,
            self.centres + own[:, ba.LENS_PARAMETERS + 3 :],
            tuple(before + change for before, change in zip(self.depths, depths, strict=True)),
            self.room.moved(step[-ROOM:]),
        )

    def scaled(self, factor: float) -> _Places:
        """The same in a unit that is so many times as small."""
        depths = tuple(depth / factor for depth in self.depths)
        return replace(self, stands=self.stands * factor, centres=self.centres * factor, depths=depths)

    def baseline(self) -> float:
        """Mean square of the projectors' distances from the first camera."""
        return float(np.vdot(self.centres, self.centres)) / len(self.centres)


def join_views(
    views: Sequence[SeenStage],
    projector_names: Sequence[str],
    projector_sizes: Sequence[tuple[int, int]],
    poses: Sequence[PoseTable | None] = (),
) -> list[JoinedView]:
    """Adjust all views together, the first one's camera being the origin. ``poses``: what was measured of projectors.

    Raises CalibrationError("views-not-linked", "distances-contradict", "pose-contradicted", "geometry-uncertain"), and
    as ``metres_per_unit``.
    """
    problems = [_problem(view, projector_sizes) for view in views]
    everything = [max(int(problem.seen.sum()), 1) for problem in problems]
    places = _started(views, problems, projector_names, projector_sizes)
    for _ in range(2):
        places, _, _ = _adjusted(problems, places)
        problems, places = _trimmed(problems, places)
    measured = {number: own for number, own in enumerate((*(view.prior.pose for view in views), *poses)) if own}
    if len(measured) > 1:  # one alone tells nothing
        places = _in_room(measured, places)
    free = places
    places, normals, covariance = _adjusted(problems, places)
    if max((float(np.linalg.norm(off)) for _, off, _ in places.room.terms(places)), default=0.0) > MOST_SIGMAS:
        raise _contradicted(free, [*(f"The camera of {view.name}" for view in views), *projector_names])
    stages, points = [], []
    for v, (view, problem, normal) in enumerate(zip(views, problems, normals, strict=True)):
        state, own = places.seen_by(v), _chain(places, v)
        adjusted = ba.Adjusted(state, 0.0, own @ covariance @ own.T, normal.depth_sensitivity)
        stage = AdjustedStage(
            state, problem.noise_px, shape_sigma(problem, adjusted), view.camera_size, projector_sizes
        )
        if stage.shape_rel_sigma > LARGEST_SHAPE_SIGMA:
            raise CalibrationError(
                "geometry-uncertain",
                what=f"With all views, the shape in {view.name} is known only to {stage.shape_rel_sigma:.1%} of its "
                "distance.",
                remedy="Let it see more projectors that other views see, too, or move it nearer to them.",
            )
        stages.append((stage, adjusted))
        points.append(object_points(stage, view.correspondences, view.prior))
    scales = {f"view {view.name}": (one.unit_m, one.unit_rel_sigma) for view, one in zip(views, points, strict=True)}
    if places.room.measured:
        scales["the poses in stage.toml"] = math.exp(places.room.log_metres), float(covariance[-1, -1] ** 0.5)
    unit_m, rel_sigma = _unit(scales)
    found = []
    for v, (own_points, (stage, adjusted), problem) in enumerate(zip(points, stages, problems, strict=True)):
        scale = np.ones(len(adjusted.covariance))
        scale[ba.CAMERA_PARAMETERS :].reshape(-1, ba.PROJECTOR_PARAMETERS)[:, ba.LENS_PARAMETERS + 3 :] = unit_m
        reconstruction = Reconstruction(
            geometry=_resized(own_points.geometry, unit_m / own_points.unit_m, known=math.isfinite(rel_sigma)),
            covariance=adjusted.covariance * np.outer(scale, scale),
            parameter_names=parameter_names(len(projector_sizes)),
            noise_px=stage.noise_px,
            shape_rel_sigma=stage.shape_rel_sigma,
            scale_rel_sigma=rel_sigma,
            margin=math.inf,
            inlier_share=float(problem.seen.sum()) / everything[v],
            sigma_m=own_points.sigma_m * np.float32(unit_m / own_points.unit_m),
        )
        turn = places.turns[v]
        found.append(JoinedView(Pose(1.0, turn, -turn @ places.stands[v] * unit_m), reconstruction))
    return found


def _problem(view: SeenStage, sizes: Sequence[tuple[int, int]]) -> ba.AdjustmentProblem:
    sampled = pose_initialisation.sample_pixels(view.correspondences, SAMPLES)
    return ba.AdjustmentProblem(*sampled, *camera_lens(view.prior, view.camera_size), *projector_lenses(sizes))


def _started(
    views: Sequence[SeenStage],
    problems: Sequence[ba.AdjustmentProblem],
    names: Sequence[str],
    sizes: Sequence[tuple[int, int]],
) -> _Places:
    """Views put together one after the other, by the projectors that they share with those before."""
    where: dict[int, tuple[Float64, Float64]] = {0: (np.eye(3), np.zeros(3))}
    standing = {n: (own.rotation, _centre(own)) for n, own in views[0].poses.items()}
    scales = {0: 1.0}
    while len(where) < len(views):
        waiting = [v for v in range(len(views)) if v not in where]
        v = max(waiting, key=lambda one: len(standing.keys() & views[one].poses.keys()))
        shared = sorted(standing.keys() & views[v].poses.keys())
        if len(shared) < LINKS:
            raise _not_linked(views[v].name, [views[one].name for one in where], [names[n] for n in shared])
        own_poses = [(own.rotation, _centre(own)) for own in (views[v].poses[n] for n in shared)]
        turn, stand, scales[v] = _placed([standing[n] for n in shared], own_poses)
        where[v] = turn, stand
        for n, own in views[v].poses.items():
            if n not in standing:
                standing[n] = own.rotation @ turn, turn.T @ _centre(own) / scales[v] + stand
    intrinsics, _ = projector_lenses(sizes)
    for n in range(len(sizes)):
        if n not in standing:
            raise CalibrationError(
                "views-not-linked",
                what=f"No view sees enough of projector {names[n]} to place it.",
                remedy="Turn it to where a camera sees its light together with that of another projector.",
            )
        own = next(view.poses[n] for view in views if n in view.poses)
        intrinsics[n] = [math.log(own.matrix[0, 0]), *own.matrix[:2, 2], own.distortion[0]]
    order = range(len(sizes))
    places = _Places(
        tuple(problem.camera_prior for problem in problems),
        np.stack([where[v][0] for v in range(len(views))]),
        np.stack([where[v][1] for v in range(len(views))]),
        intrinsics,
        np.stack([standing[n][0] for n in order]),
        np.stack([standing[n][1] for n in order]),
        tuple(np.ones(len(problem.seen)) for problem in problems),
        _Room({}, np.eye(3), np.zeros(3), 0.0),
    )
    places = places.scaled(places.baseline() ** -0.5)
    depths = [pose_initialisation.triangulated(one, places.seen_by(v)) for v, one in enumerate(problems)]
    return replace(places, depths=tuple(np.nan_to_num(depth, nan=1.0) for depth in depths))


def _in_room(measured: Mapping[int, PoseTable], places: _Places) -> _Places:
    """The same in the room where the measured devices are nearest to them."""
    no_turn = np.zeros((3, 3))
    there = [(no_turn, np.array(own.position_m)) for own in measured.values()]
    turn, stand, scale = _placed(there, [(no_turn, places.device(number)[0]) for number in measured])
    return replace(places, room=_Room(measured, turn.T, stand, -math.log(scale)))


def _contradicted(free: _Places, names: Sequence[str]) -> CalibrationError:
    """Names the pose without which the others fit the ``free`` places, of the photographs alone, best."""
    measured = free.room.measured

    def rest(without: int) -> float:
        others = _in_room({number: own for number, own in measured.items() if number != without}, free)
        return sum(float(off @ off) for _, off, _ in others.room.terms(others))

    return CalibrationError(
        "pose-contradicted",
        what=f"{names[min(measured, key=rest)]} does not stand as its pose in stage.toml says: photographs and the "
        "other poses contradict it.",
        remedy="Measure its position again, or give a larger sigma_m.",
    )


def _placed(
    there: Sequence[tuple[Float64, Float64]], own: Sequence[tuple[Float64, Float64]]
) -> tuple[Float64, Float64, float]:
    """Turn, centre and relative size of a frame, from turns and centres of devices in another one and its own."""
    seen, centres = (np.stack([centre for _, centre in devices]) for devices in (own, there))
    apart, apart_there = seen - seen.mean(axis=0), centres - centres.mean(axis=0)
    size, size_there = (max(float(np.linalg.norm(one)), 1e-12) for one in (apart, apart_there))
    turned = sum(turn.T @ rotation for (turn, _), (rotation, _) in zip(own, there, strict=True))
    left, _, right = np.linalg.svd(apart.T @ apart_there / (size * size_there) + turned)
    turn = left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right
    scale = size / size_there
    return np.asarray(turn), np.asarray(centres.mean(axis=0) - turn.T @ seen.mean(axis=0) / scale), scale


def _centre(pinhole: Pinhole) -> Float64:
    return np.asarray(-pinhole.rotation.T @ pinhole.translation_m)


def _turns(vectors: Float64) -> Float64:
    turns = [cv2.Rodrigues(vector)[0] for vector in vectors.reshape(-1, 3)]
    return np.stack(turns) if turns else np.zeros((0, 3, 3))


def _chain(places: _Places, v: int) -> Float64:
    """(4 + 10 N, P): change of the parameters in a view's frame by those of all."""
    views, projectors = len(places.lenses), len(places.intrinsics)
    own = np.zeros((ba.CAMERA_PARAMETERS + ba.PROJECTOR_PARAMETERS * projectors, places.columns))
    lens = ba.CAMERA_PARAMETERS * v
    own[: ba.CAMERA_PARAMETERS, lens : lens + ba.CAMERA_PARAMETERS] = np.eye(ba.CAMERA_PARAMETERS)
    state, turn = places.seen_by(v), places.turns[v]
    place = ba.CAMERA_PARAMETERS * views + POSE * (v - 1)
    for n in range(projectors):
        row = ba.CAMERA_PARAMETERS + ba.PROJECTOR_PARAMETERS * n
        column = places.first + ba.PROJECTOR_PARAMETERS * n
        middle, last = ba.LENS_PARAMETERS, ba.LENS_PARAMETERS + 3
        own[row : row + last, column : column + last] = np.eye(last)
        own[row + last : row + last + 3, column + last : column + last + 3] = turn
        if v:
            x, y, z = state.centres[n]
            own[row + middle : row + last, place : place + 3] = -state.rotations[n]
            own[row + last : row + last + 3, place : place + 3] = [[0, z, -y], [-z, 0, x], [y, -x, 0]]
            own[row + last : row + last + 3, place + 3 : place + 6] = -turn
    return own


def _priors(problems: Sequence[ba.AdjustmentProblem], places: _Places) -> tuple[Float64, Float64]:
    """Residuals in sigmas of room, lenses and gauge, and their derivatives by all parameters."""
    projectors = len(places.intrinsics)
    identity = np.eye(places.columns)
    terms, rows = [np.zeros(ROOM)], [identity[-ROOM:] / ANYWHERE]
    for _, term, row in places.room.terms(places):
        terms.append(term)
        rows.append(row)
    for v, (problem, lens) in enumerate(zip(problems, places.lenses, strict=True)):
        columns = slice(ba.CAMERA_PARAMETERS * v, ba.CAMERA_PARAMETERS * (v + 1))
        terms.append((lens - problem.camera_prior)[: ba.CAMERA_PARAMETERS] / problem.camera_sigma)
        rows.append(identity[columns] / problem.camera_sigma[:, None])
    gauge = np.zeros(len(identity))
    for n in range(projectors):
        start = places.first + ba.PROJECTOR_PARAMETERS * n
        sigma = problems[0].projector_sigma[n]
        terms.append((places.intrinsics[n] - problems[0].projector_prior[n]) / sigma)
        rows.append(identity[start : start + ba.LENS_PARAMETERS] / sigma[:, None])
        centre = slice(start + ba.LENS_PARAMETERS + 3, start + ba.PROJECTOR_PARAMETERS)
        gauge[centre] = 2 * places.centres[n] / (projectors * ba.GAUGE_SIGMA)
    terms.append(np.array([(places.baseline() - 1) / ba.GAUGE_SIGMA]))
    return np.concatenate(terms), np.concatenate([*rows, gauge[None]])


def _adjusted(problems: Sequence[ba.AdjustmentProblem], places: _Places) -> tuple[_Places, list[ba.Normal], Float64]:
    """The best places, each view's equations there, and the covariance of all parameters."""

    def cost_of(now: _Places) -> float:
        terms, _ = _priors(problems, now)
        data = sum(ba.data_cost(problem, now.seen_by(v)) for v, problem in enumerate(problems))
        return data + 0.5 * float(terms @ terms)

    places, _ = ba.descended(places, cost_of, partial(_proposals, problems), iterations=60, tolerance=1e-9)
    normals = [ba.data_equations(problem, places.seen_by(v)) for v, problem in enumerate(problems)]
    whole, information = _summed(problems, places, normals, 0.0)[:2]
    return places, normals, ba.covariance_of(information, whole)


def _proposals(problems: Sequence[ba.AdjustmentProblem], places: _Places) -> Callable[[float], _Places]:
    """The next places by a damping."""
    normals = [ba.data_equations(one, places.seen_by(v)) for v, one in enumerate(problems)]

    def proposed(damping: float) -> _Places:
        whole, information, right = _summed(problems, places, normals, damping)
        step = solve_positive(information + damping * np.diag(np.diag(whole)), right)
        depths = []
        for v, normal in enumerate(normals):
            own = _chain(places, v) @ step
            depths.append(-(normal.depth_gradient + normal.cross @ own) / (normal.depth * (1 + damping) + 1e-12))
        return places.moved(step, depths)

    return proposed


def _summed(
    problems: Sequence[ba.AdjustmentProblem], places: _Places, normals: Sequence[ba.Normal], damping: float
) -> tuple[Float64, Float64, Float64]:
    """All views' equations by all parameters (P, P), these without the points, and their right side (P,)."""
    terms, jacobian = _priors(problems, places)
    whole = jacobian.T @ jacobian
    information, right = whole.copy(), -jacobian.T @ terms
    for v, normal in enumerate(normals):
        own, depth = _chain(places, v), normal.depth * (1 + damping) + 1e-12 * (damping > 0)
        whole += own.T @ normal.parameters @ own
        information += own.T @ reduced(normal.parameters, normal.cross, depth) @ own
        share = np.divide(normal.depth_gradient, depth, out=np.zeros_like(depth), where=depth > 0)
        right += own.T @ (normal.cross.T @ share - normal.gradient)
    return whole, information, right


def _trimmed(problems: Sequence[ba.AdjustmentProblem], places: _Places) -> tuple[list[ba.AdjustmentProblem], _Places]:
    """Without what does not fit, and with each view's own noise."""
    kept_problems, depths = [], []
    for v, problem in enumerate(problems):
        distance = channels.length(ba.residuals(problem, places.seen_by(v)))
        noise = noise_of(problem, distance)
        seen: Mask = problem.seen & (distance < 5 * noise)
        kept = np.asarray(seen.any(axis=1), np.bool_)
        depths.append(places.depths[v][kept])
        everyone = range(seen.shape[1])
        kept_problems.append(
            pose_initialisation.restricted(replace(problem, seen=seen, noise_px=noise), kept, everyone)
        )
    return kept_problems, replace(places, depths=tuple(depths))


def _unit(scales: Mapping[str, tuple[float, float]]) -> tuple[float, float]:
    """Metres in one unit by all that was measured, and its relative deviation; of the first view where nothing was.

    ``scales``: both, by what was measured
    """
    sure = {name: one for name, one in scales.items() if one[1] < 1}
    if not sure:
        return next(iter(scales.values()))[0], math.inf
    logs = np.log([metres for metres, _ in sure.values()])
    sigmas = np.array([sigma for _, sigma in sure.values()])
    weights = 1 / sigmas**2
    mean = float((weights * logs).sum() / weights.sum())
    off = np.abs(logs - mean) / np.hypot(sigmas, 0.002)
    if off.max() > MOST_SIGMAS:
        worst = int(off.argmax())
        raise CalibrationError(
            "distances-contradict",
            what=f"What was measured in {list(sure)[worst]} contradicts the other distances: it is off by "
            f"{100 * abs(math.expm1(logs[worst] - mean)):.1f} %.",
            remedy="Measure again: distance_m from the front of each camera's lens to the nearest visible point, and "
            "the poses.",
        )
    return math.exp(mean), float(weights.sum() ** -0.5)


def _resized(geometry: Geometry, factor: float, *, known: bool) -> Geometry:
    projectors = tuple(replace(own, translation_m=own.translation_m * factor) for own in geometry.projectors)
    points_m = geometry.points_m * np.float32(factor)
    return replace(geometry, projectors=projectors, points_m=points_m, scale_known=known)


def _not_linked(view: str, others: Sequence[str], shared: Sequence[str]) -> CalibrationError:
    seen = f"share only the projector {shared[0]}" if shared else "share no projector"
    return CalibrationError(
        "views-not-linked",
        what=f"The view {view} and {', '.join(others)} {seen}, so it is not known how they stand to each other.",
        remedy="Turn projectors so that both see two of them, or add a view between.",
    )
