"""Bundle adjustment of one camera and N projectors that look at the same points.

Correspondences are measured at whole camera pixels, so all noise is in the projector coordinates: a point is one
number, its inverse depth along the camera ray. The Schur complement over the points is therefore a division.

Camera parameters: log f, cx, cy, k1. Projector parameters: log f, cx, cy, k1, rotation (3), centre (3). What else a
camera's lens has (k2, p1, p2, pixels that are not square) stays as it was measured. Projectors have square pixels.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeVar

import numpy as np

from controller.core import channels
from controller.core.arrays import Float64, Mask
from controller.optics.calibrate.geometry.normal_equations import CAMERA as CAMERA_PARAMETERS
from controller.optics.calibrate.geometry.normal_equations import LENS as LENS_PARAMETERS
from controller.optics.calibrate.geometry.normal_equations import PROJECTOR as PROJECTOR_PARAMETERS
from controller.optics.calibrate.geometry.normal_equations import (
    accumulate,
    bending,
    differentiate,
    project,
    reduced,
    solve_positive,
    undistort,
)

__all__ = [
    "CAMERA_PARAMETERS",
    "LENS_PARAMETERS",
    "PROJECTOR_PARAMETERS",
    "Adjusted",
    "AdjustmentProblem",
    "AdjustmentState",
    "adjust",
]

GAUGE_SIGMA = 1e-3
_CAUCHY = 2.4


@dataclass(frozen=True, slots=True)
class AdjustmentProblem:
    """What was seen, and what is known in advance.

    ``camera_px`` (points, 2); ``projector_px`` (points, N, 2), any value where not ``seen`` (points, N) bool;
    ``camera_prior`` (4,) or (8,) as in ``undistort``, ``camera_sigma`` (4,); ``projector_prior``, ``projector_sigma``
    (N, 4) of log f, cx, cy, k1;
    ``noise_px``: standard deviation of one projector coordinate, beyond 2.4 of which the Cauchy loss turns flat
    """

    camera_px: Float64
    projector_px: Float64
    seen: Mask
    camera_prior: Float64
    camera_sigma: Float64
    projector_prior: Float64
    projector_sigma: Float64
    noise_px: float = 1.0


@dataclass(frozen=True, slots=True)
class AdjustmentState:
    """``camera`` as in the problem; ``intrinsics`` (N, 4); ``rotations`` (N, 3, 3) camera to projector;
    ``centres`` (N, 3); ``inverse_depth`` (points,)."""

    camera: Float64
    intrinsics: Float64
    rotations: Float64
    centres: Float64
    inverse_depth: Float64


@dataclass(frozen=True, slots=True)
class Linearised:
    """``residual_px`` (points, N, 2) and its derivatives, 0 where not seen: by the camera (points, N, 2, 4), by the
    projector's own parameters (points, N, 2, 10), by the inverse depth (points, N, 2)."""

    residual_px: Float64
    by_camera: Float64
    by_projector: Float64
    by_depth: Float64


@dataclass(frozen=True, slots=True)
class Adjusted:
    """``cost``: half the robust chi-square plus priors; ``covariance`` (4 + 10 N, 4 + 10 N), gauge: baselines of rms 1;
    ``depth_sensitivity`` (points, 4 + 10 N): change of each inverse depth with the parameters."""

    state: AdjustmentState
    cost: float
    covariance: Float64
    depth_sensitivity: Float64


def undistorted(lens: Float64, px: Float64) -> Float64:
    """(points, 2) x, y at depth 1 of pixels (points, 2) of the camera or a projector; ``lens`` as in ``undistort``."""
    return undistort(np.ascontiguousarray(lens), np.ascontiguousarray(px))


def camera_rays(camera: Float64, px: Float64) -> tuple[Float64, Float64]:
    """Undistorted x, y at depth 1 of (points, 2) camera pixels, and their derivatives (points, 2, 4) by the camera."""
    k1, k2, p1, p2, log_aspect = np.append(camera[3:], np.zeros(8 - len(camera)))
    focal = np.exp(camera[0] + np.array([0.0, log_aspect]))
    xy = undistorted(camera, px)
    _, _, a, b, c = bending(xy[:, 0], xy[:, 1], k1, k2, p1, p2)
    backward = np.stack([c, -b, -b, a], axis=1).reshape(-1, 2, 2) / (a * c - b * b)[:, None, None]
    by_camera = np.empty((len(px), 2, CAMERA_PARAMETERS))
    by_camera[:, :, 0] = -np.einsum("pij,pj->pi", backward, (px - camera[1:3]) / focal)
    by_camera[:, :, 1:3] = -backward / focal
    by_camera[:, :, 3] = -np.einsum("pij,pj->pi", backward, xy) * np.sum(xy * xy, axis=1)[:, None]
    return xy, by_camera


def residuals(problem: AdjustmentProblem, state: AdjustmentState) -> Float64:
    """(points, N, 2) projected less measured projector pixels, 0 where not seen, very large behind a projector."""
    return _projected(problem, state, undistorted(state.camera, problem.camera_px))


def linearise(problem: AdjustmentProblem, state: AdjustmentState) -> Linearised:
    """Residuals and analytic derivatives; those of points behind a projector are 0."""
    xy, xy_by_camera = camera_rays(state.camera, problem.camera_px)
    seen = np.ascontiguousarray(problem.seen)
    return Linearised(_projected(problem, state, xy), *differentiate(xy, xy_by_camera, *_placed(state), seen))


def _projected(problem: AdjustmentProblem, state: AdjustmentState, xy: Float64) -> Float64:
    return project(xy, *_placed(state), np.ascontiguousarray(problem.projector_px), np.ascontiguousarray(problem.seen))


def _placed(state: AdjustmentState) -> tuple[Float64, Float64, Float64, Float64]:
    """Inverse depths, intrinsics, rotations and rotated centres, in the order in memory that was compiled ahead."""
    turned = np.einsum("nij,nj->ni", state.rotations, state.centres)
    depth, own, turns, turned = map(
        np.ascontiguousarray, (state.inverse_depth, state.intrinsics, state.rotations, turned)
    )
    return depth, own, turns, turned


def stepped(state: AdjustmentState, parameters: Float64, inverse_depth: Float64) -> AdjustmentState:
    """The state moved by (4 + 10 N,) and (points,); rotations by the exponential map."""
    import cv2

    own = parameters[CAMERA_PARAMETERS:].reshape(-1, PROJECTOR_PARAMETERS)
    camera = state.camera.copy()
    camera[:CAMERA_PARAMETERS] += parameters[:CAMERA_PARAMETERS]
    turns = np.array([cv2.Rodrigues(row[LENS_PARAMETERS : LENS_PARAMETERS + 3].copy())[0] for row in own])
    return AdjustmentState(
        camera,
        state.intrinsics + own[:, :LENS_PARAMETERS],
        turns @ state.rotations,
        state.centres + own[:, LENS_PARAMETERS + 3 :],
        state.inverse_depth + inverse_depth,
    )


def cost_of(problem: AdjustmentProblem, state: AdjustmentState) -> float:
    """Half of: Cauchy loss in noise units, priors, and the gauge that holds the rms baseline at 1."""
    own = _prior_terms(problem, state)
    return data_cost(problem, state) + 0.5 * float(own @ own)


def data_cost(problem: AdjustmentProblem, state: AdjustmentState) -> float:
    """Half of the Cauchy loss in noise units."""
    squared = channels.total(residuals(problem, state) ** 2) / problem.noise_px**2
    return 0.5 * _CAUCHY**2 * float(np.sum(np.log1p(squared[problem.seen] / _CAUCHY**2)))


def adjust(
    problem: AdjustmentProblem, state: AdjustmentState, *, iterations: int = 40, tolerance: float = 1e-8
) -> Adjusted:
    """Levenberg-Marquardt with the Schur complement over the points.

    ``tolerance``: stops when an iteration lowers the cost by a smaller share.
    """

    def proposals(now: AdjustmentState) -> Callable[[float], AdjustmentState]:
        normal = _normal_equations(problem, now)
        return lambda damping: stepped(now, *_solve(normal, damping))

    state, cost = descended(
        normalised(state), partial(cost_of, problem), proposals, iterations=iterations, tolerance=tolerance
    )
    normal = _normal_equations(problem, state)
    information = reduced(normal.parameters, normal.cross, normal.depth)
    return Adjusted(state, cost, covariance_of(information, normal.parameters), normal.depth_sensitivity)


State = TypeVar("State")


def descended(
    state: State,
    cost_of: Callable[[State], float],
    proposals: Callable[[State], Callable[[float], State]],
    *,
    iterations: int,
    tolerance: float,
) -> tuple[State, float]:
    """Levenberg-Marquardt: the last state and its cost. ``proposals``: of a state, the next one by damping."""
    cost, damping = cost_of(state), 1e-3
    for _ in range(iterations):
        proposed = proposals(state)
        before = cost
        while damping < 1e9:
            proposal = proposed(damping)
            proposed_cost = cost_of(proposal)
            if proposed_cost < cost:
                state, cost, damping = proposal, proposed_cost, max(damping * 0.2, 1e-9)
                break
            damping *= 6.0
        if before - cost < tolerance * before + 1e-9:
            break
    return state, cost


def covariance_of(information: Float64, parameters: Float64) -> Float64:
    """The inverse (P, P) of the information without points, scaled by the diagonal of that with them."""
    scale = 1.0 / np.sqrt(np.diag(parameters))
    covariance = np.linalg.pinv(information * np.outer(scale, scale), rcond=1e-14, hermitian=True)
    return np.asarray(covariance * np.outer(scale, scale))


def normalised(state: AdjustmentState) -> AdjustmentState:
    """The same stage with baselines of rms length 1, which the data cannot tell from any other scale."""
    scale = float(np.sqrt(np.mean(np.sum(state.centres**2, axis=1))))
    return replace(state, centres=state.centres / scale, inverse_depth=state.inverse_depth * scale)


@dataclass(frozen=True, slots=True)
class Normal:
    """Gauss-Newton blocks: parameters (P, P), cross (points, P), depth (points,) and the gradients."""

    parameters: Float64
    cross: Float64
    depth: Float64
    gradient: Float64
    depth_gradient: Float64

    @property
    def depth_sensitivity(self) -> Float64:
        """As of ``Adjusted``."""
        return np.asarray(-self.cross / np.where(self.depth > 0, self.depth, np.inf)[:, None])


def _prior_terms(problem: AdjustmentProblem, state: AdjustmentState) -> Float64:
    """Residuals in sigmas of priors and gauge."""
    camera = (state.camera - problem.camera_prior)[:CAMERA_PARAMETERS] / problem.camera_sigma
    own = (state.intrinsics - problem.projector_prior) / problem.projector_sigma
    gauge = (np.vdot(state.centres, state.centres) / len(state.centres) - 1.0) / GAUGE_SIGMA
    return np.concatenate([camera, own.ravel(), [gauge]])


def _prior_jacobian(problem: AdjustmentProblem, state: AdjustmentState) -> Float64:
    """Of the prior terms, by the parameters."""
    projectors = len(state.intrinsics)
    size = CAMERA_PARAMETERS + PROJECTOR_PARAMETERS * projectors
    jacobian = np.zeros((CAMERA_PARAMETERS + LENS_PARAMETERS * projectors + 1, size))
    jacobian[np.arange(4), np.arange(4)] = 1.0 / problem.camera_sigma
    for n in range(projectors):
        start = CAMERA_PARAMETERS + PROJECTOR_PARAMETERS * n
        rows = CAMERA_PARAMETERS + LENS_PARAMETERS * n + np.arange(LENS_PARAMETERS)
        jacobian[rows, start + np.arange(LENS_PARAMETERS)] = 1.0 / problem.projector_sigma[n]
        jacobian[-1, start + LENS_PARAMETERS + 3 : start + PROJECTOR_PARAMETERS] = (
            2.0 * state.centres[n] / (projectors * GAUGE_SIGMA)
        )
    return jacobian


def _normal_equations(problem: AdjustmentProblem, state: AdjustmentState) -> Normal:
    normal = data_equations(problem, state)
    prior, jacobian = _prior_terms(problem, state), _prior_jacobian(problem, state)
    return replace(
        normal, parameters=normal.parameters + jacobian.T @ jacobian, gradient=normal.gradient + jacobian.T @ prior
    )


def data_equations(problem: AdjustmentProblem, state: AdjustmentState) -> Normal:
    """Of the correspondences alone."""
    linear = linearise(problem, state)
    squared = channels.total(linear.residual_px**2) / (problem.noise_px * _CAUCHY) ** 2
    weight = problem.seen / (1.0 + squared) / problem.noise_px**2
    return Normal(*accumulate(linear.by_camera, linear.by_projector, linear.by_depth, linear.residual_px, weight))


def _solve(normal: Normal, damping: float) -> tuple[Float64, Float64]:
    depth = normal.depth * (1.0 + damping) + 1e-12
    damped = normal.parameters + damping * np.diag(np.diag(normal.parameters))
    right = np.sum(normal.cross * (normal.depth_gradient / depth)[:, None], axis=0) - normal.gradient
    step = solve_positive(reduced(damped, normal.cross, depth), right)
    return step, -(normal.depth_gradient + np.sum(normal.cross * step, axis=1)) / depth
