"""Self-calibrating geometry of a camera and N >= 2 projectors from correspondences alone (paper 4.1).

No board in the scene: the camera's focal length is roughly known, projectors are not, and their lenses are shifted.
Where correspondences give no geometry, the data tells what is wrong with the object, the lens or the captures.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from controller.core import channels
from controller.core.arrays import Float64, Mask
from controller.core.errors import CalibrationError, UsageError
from controller.optics.calibrate.geometry import bundle_adjustment as ba
from controller.optics.calibrate.geometry import pose_initialisation
from controller.optics.calibrate.geometry.surface_points import AdjustedStage, object_points, pinhole
from controller.optics.calibrate.geometry.values import (
    CameraPrior,
    Reconstruction,
    camera_lens,
    parameter_names,
    projector_lenses,
)
from controller.optics.calibrate.values import Correspondence, Pinhole

JUMP_PX = 2.0
"""Neighbouring camera pixels that see places this much farther apart on the projector's image than is usual."""
BROKEN_SHARE = 0.4
"""Of camera pixels beside a gap or a jump, from which on the surface itself explains what does not fit."""
_FACTORS = (2.0, 0.5, 4.0, 0.25, 8.0, 0.125)
_ANY_FOCAL_SIGMA = 0.3


def inconsistent(own: Correspondence, what: str) -> CalibrationError:
    """The error for correspondences of which too few fit one position; ``what`` says which, and ends the sentence.

    Captures between which something moved keep the surface in one piece; lace, leaves or hair do not.
    """
    broken = broken_share(own)
    if broken > BROKEN_SHARE:
        return CalibrationError(
            "surface-broken-up",
            what=f"{what[:-1]}: {broken:.0%} of the object's camera pixels lie beside a gap or an edge, as in lace.",
            remedy="Cover what is full of holes or hair-thin, or bring the camera nearer."
            " If the surface is in one piece, the pictures do not belong together: capture again.",
        )
    return CalibrationError(
        "correspondences-inconsistent",
        what=what,
        remedy="Check that nothing moved and no picture lagged behind its pattern, then capture again.",
    )


def broken_share(own: Correspondence) -> float:
    """The share of decoded camera pixels with a neighbour, right or below, that is not, or sees a far-off place."""
    if not own.valid.any():
        return 0.0
    beside = jumps(own)
    for axis in (0, 1):
        one, other = _neighbours(axis)
        beside[one] |= own.valid[one] & ~own.valid[other]
    return float(beside[own.valid].mean())


def jumps(own: Correspondence) -> Mask:
    """Decoded camera pixels (rows, columns) whose neighbour, right or below, sees a far-off place: depth edges."""
    found = np.zeros(own.valid.shape, np.bool_)
    for axis in (0, 1):
        one, other = _neighbours(axis)
        step = channels.length(own.projector_px[other] - own.projector_px[one])
        both = own.valid[one] & own.valid[other]
        usual = float(np.median(step[both])) if both.any() else 0.0
        found[one] |= both & (np.nan_to_num(step) > usual + JUMP_PX)
    return found


def _neighbours(axis: int) -> tuple[tuple[slice, ...], tuple[slice, ...]]:
    ahead, behind = [slice(None)] * 2, [slice(None)] * 2
    ahead[axis], behind[axis] = slice(1, None), slice(None, -1)
    return tuple(behind), tuple(ahead)


def no_position(
    problem: ba.AdjustmentProblem, sizes_px: Sequence[tuple[int, int]], missing: Sequence[int]
) -> CalibrationError:
    """The error where no position was found for the projectors ``missing``: the focal length, if another one gives any.

    ``problem`` with every projector's correspondences; ``sizes_px``: (width, height) of each projector.
    """
    first = missing[0] + 1
    focal = float(np.exp(problem.camera_prior[0]))
    for factor in _FACTORS:
        prior, sigma = problem.camera_prior.copy(), problem.camera_sigma.copy()
        prior[0], sigma[0] = np.log(factor * focal), _ANY_FOCAL_SIGMA
        other = replace(problem, camera_prior=prior, camera_sigma=sigma)
        pairs = (pose_initialisation.solve_pair(other, n, sizes_px[n]) for n in missing)
        if all(pair is not None and pair.candidates for pair in pairs):
            return CalibrationError(
                "camera-prior-contradicted",
                what=f"With a focal length of {focal:.0f} px no position of projector {first} explains the pictures;"
                f" with a {'longer' if factor > 1 else 'shorter'} one there is.",
                remedy="Check focal_length_px, or the file that intrinsics names, and that pictures are not cropped.",
            )
    return CalibrationError(
        "geometry-uncertain",
        what=f"No position with the object in front of it was found for projector {first}.",
        remedy="Let each projector see more of the object's depth, or move it farther from the camera's view axis.",
    )


_SAMPLES = 4000
_TRIAL_POINTS = 600
_FEWEST_POINTS = 200
LARGEST_SHAPE_SIGMA: Final = 0.02
_LARGEST_PRIOR_SIGMAS = 5.0
_CLEAR_MARGIN = 12.0  # of the halved chi-square between the best stage and any other, on _TRIAL_POINTS


def reconstruct(
    correspondences: Sequence[Correspondence],
    camera_size: tuple[int, int],
    projector_sizes: Sequence[tuple[int, int]],
    prior: CameraPrior,
    *,
    progress: Callable[[float], None] | None = None,
) -> Reconstruction:
    """Recover poses, intrinsics and the object from what each camera pixel sees of each projector.

    Parameters
    ----------
    correspondences : one per projector, each of the camera's (rows, columns)
    camera_size, projector_sizes : (width, height) in pixels
    progress : called with the share done, 0 to 1

    Raises
    ------
    UsageError  "correspondence-wrong-size", "camera-intrinsics-wrong-size"
    CalibrationError  "one-projector", "overlap-too-small", "scene-flat", "correspondences-inconsistent",
        "surface-broken-up", "camera-prior-contradicted", "geometry-uncertain",
        "distance-point-unknown", "distances-contradict" (see ``metres_per_unit``),
        "geometry-ambiguous" (two shapes explain the pictures equally well, e.g. one with its depth reversed)
    """
    report = progress or (lambda share: None)
    problem, adjusted, kept_share, margin, pairs = _placed(correspondences, camera_size, projector_sizes, prior, report)
    uncertainty = shape_sigma(problem, adjusted)
    _refuse_if_uncertain(uncertainty, margin, pairs)
    stage = AdjustedStage(adjusted.state, problem.noise_px, uncertainty, camera_size, projector_sizes)
    points = object_points(stage, correspondences, prior)
    report(1.0)
    return Reconstruction(
        geometry=points.geometry,
        covariance=_in_metres(adjusted.covariance, points.unit_m, len(projector_sizes)),
        parameter_names=parameter_names(len(projector_sizes)),
        noise_px=problem.noise_px,
        shape_rel_sigma=uncertainty,
        scale_rel_sigma=points.unit_rel_sigma,
        margin=margin,
        inlier_share=kept_share,
        sigma_m=points.sigma_m,
    )


def first_poses(
    correspondences: Sequence[Correspondence],
    camera_size: tuple[int, int],
    projector_sizes: Sequence[tuple[int, int]],
    prior: CameraPrior,
) -> list[Pinhole]:
    """Where ``reconstruct`` puts the projectors, in any unit; also where it finds the shape too uncertain.

    With what other views see, that may become certain (``view_poses``). Raises CalibrationError as ``reconstruct``.
    """
    seen = correspondences, camera_size, projector_sizes, prior
    _, adjusted, _, margin, pairs = _placed(*seen, lambda share: None)
    _refuse_if_uncertain(0.0, margin, pairs)
    state = adjusted.state
    places = zip(state.intrinsics, state.rotations, state.centres, projector_sizes, strict=True)
    return [pinhole(*place) for place in places]


def _placed(
    correspondences: Sequence[Correspondence],
    camera_size: tuple[int, int],
    projector_sizes: Sequence[tuple[int, int]],
    prior: CameraPrior,
    report: Callable[[float], None],
) -> tuple[ba.AdjustmentProblem, ba.Adjusted, float, float, list[pose_initialisation.Pair]]:
    """The stage that fits best, the share of correspondences that were kept, and the margin over any other."""
    _check(correspondences, camera_size, projector_sizes, prior)
    problem = _problem(correspondences, camera_size, projector_sizes, prior)
    problem, pairs = _solve_pairs(problem, correspondences, projector_sizes, lambda share: report(0.4 * share))
    trial, margin = _best_stage(problem, pairs)
    report(0.6)
    problem, adjusted, kept_share = _refine(problem, correspondences, trial)
    report(0.8)
    _refuse_if_contradicted(problem, adjusted.state)
    return problem, adjusted, kept_share, margin, pairs


def _check(
    correspondences: Sequence[Correspondence],
    camera_size: tuple[int, int],
    projector_sizes: Sequence[tuple[int, int]],
    prior: CameraPrior,
) -> None:
    if prior.size_px is not None and prior.size_px != camera_size:
        raise UsageError(
            "camera-intrinsics-wrong-size",
            what=f"The camera's focal length was measured in pictures of {_size(prior.size_px)} pixels, and these have"
            f" {_size(camera_size)}.",
            remedy="Photograph the board with the camera settings of the stage, and calibrate the camera again.",
        )
    expected = (camera_size[1], camera_size[0])
    for n, own in enumerate(correspondences):
        if own.valid.shape != expected or own.projector_px.shape != (*expected, 2) or n >= len(projector_sizes):
            raise UsageError(
                "correspondence-wrong-size",
                what=f"Correspondences of projector {n + 1} are for {_size(own.valid.shape[::-1])} pixels,"
                f" not the camera's {_size(camera_size)}.",
                remedy="Decode all projectors from pictures of the same camera, one size for each projector.",
            )
    if len(correspondences) < 2:
        raise one_projector()


def one_projector() -> CalibrationError:
    """The error where a single projector would have to show the shape."""
    return CalibrationError(
        "one-projector",
        what="One projector and one camera do not determine the shape: a depth-reversed one fits as well.",
        remedy="Use at least two projectors whose light overlaps on the object, or set shape under [object] in"
        " stage.toml to unknown or plane.",
    )


def _problem(
    correspondences: Sequence[Correspondence],
    camera_size: tuple[int, int],
    projector_sizes: Sequence[tuple[int, int]],
    prior: CameraPrior,
) -> ba.AdjustmentProblem:
    camera_px, projector_px, seen = pose_initialisation.sample_pixels(correspondences, _SAMPLES)
    for n, count in enumerate(seen.sum(axis=0)):
        if count < _FEWEST_POINTS:
            raise CalibrationError(
                "overlap-too-small",
                what=f"Projector {n + 1} shares only {count} camera pixels with the others; {_FEWEST_POINTS} are "
                "needed.",
                remedy="Check that it is on, and turn it so that its light overlaps the others' on the object.",
            )
    return ba.AdjustmentProblem(
        camera_px, projector_px, seen, *camera_lens(prior, camera_size), *projector_lenses(projector_sizes)
    )


def _solve_pairs(
    problem: ba.AdjustmentProblem,
    correspondences: Sequence[Correspondence],
    projector_sizes: Sequence[tuple[int, int]],
    report: Callable[[float], None],
) -> tuple[ba.AdjustmentProblem, list[pose_initialisation.Pair]]:
    """Candidates for every projector; the problem without the correspondences that no epipolar geometry fits."""
    pairs, seen = [], problem.seen.copy()
    for n, size in enumerate(projector_sizes):
        pair = pose_initialisation.solve_pair(problem, n, size)
        if pair is None or pair.inliers.sum() < 0.5 * problem.seen[:, n].sum():
            raise inconsistent(correspondences[n], f"What the camera saw of projector {n + 1} fits no position of it.")
        pairs.append(pair)
        seen[:, n] = pair.inliers
        report((n + 1) / len(projector_sizes))
    if all(pair.parallax_px < max(4.0 * pair.noise_px, 0.5) for pair in pairs):
        raise _flat(max(pair.parallax_px for pair in pairs))
    if not all(pair.candidates for pair in pairs):
        missing = [n for n, pair in enumerate(pairs) if not pair.candidates]
        raise no_position(problem, projector_sizes, missing)
    noise = float(np.median([pair.noise_px for pair in pairs]))
    joined = seen.sum(axis=1) >= 2
    pairs = [replace(pair, inliers=pair.inliers[joined]) for pair in pairs]
    problem = replace(problem, seen=seen, noise_px=max(noise, 0.02))
    return pose_initialisation.restricted(problem, joined, range(len(pairs))), pairs


def _size(size_px: Sequence[int]) -> str:
    return " x ".join(map(str, size_px))


def _flat(parallax_px: float) -> CalibrationError:
    return CalibrationError(
        "scene-flat",
        what=f"The scene is flat: its depth shifts the projectors' pixels by only {parallax_px:.1f} px.",
        remedy="Add something with depth to the scene while calibrating, or look at the object from another side.",
    )


def _best_stage(
    problem: ba.AdjustmentProblem, pairs: Sequence[pose_initialisation.Pair]
) -> tuple[ba.AdjustmentState, float]:
    """The cheapest of all chained stages, and its margin over any of another shape."""
    everyone = range(len(pairs))
    chosen = np.arange(0, len(problem.seen), max(1, len(problem.seen) // _TRIAL_POINTS))
    small = pose_initialisation.restricted(problem, chosen, everyone)
    starts = pose_initialisation.chain(small, pairs)
    if not starts:
        raise CalibrationError(
            "overlap-too-small",
            what="The projectors' light overlaps too little on the object to locate all of them together.",
            remedy="Turn the projectors so that each one's light overlaps another's.",
        )
    solved = [ba.adjust(small, start, tolerance=1e-5) for start in starts]
    solved = [s for s in solved if np.mean(s.state.inverse_depth > 0) > 0.95] or solved
    solved.sort(key=lambda s: s.cost)
    best = solved[0]
    others = [s.cost - best.cost for s in solved[1:] if _differs(s.state, best.state)]
    return best.state, min(others, default=float("inf"))


def _differs(one: ba.AdjustmentState, other: ba.AdjustmentState) -> bool:
    """Whether two stages are different shapes: their depths' ratio varies by more than 2 % over the points."""
    ratio = np.log(np.maximum(one.inverse_depth, 1e-9) / np.maximum(other.inverse_depth, 1e-9))
    return float(np.std(ratio)) > 0.02


def _refine(
    problem: ba.AdjustmentProblem, correspondences: Sequence[Correspondence], state: ba.AdjustmentState
) -> tuple[ba.AdjustmentProblem, ba.Adjusted, float]:
    """Adjust over all points, trim what does not fit, adjust again; the share of correspondences that were kept."""
    everything = int(problem.seen.sum())
    state = replace(state, inverse_depth=pose_initialisation.triangulated(problem, state))
    for _ in range(2):
        adjusted = ba.adjust(problem, state)
        distance = channels.length(ba.residuals(problem, adjusted.state))
        noise = noise_of(problem, distance)
        seen = problem.seen & (distance < 5.0 * noise)
        kept = np.asarray(seen.any(axis=1), np.bool_)
        state = replace(adjusted.state, inverse_depth=adjusted.state.inverse_depth[kept])
        problem = pose_initialisation.restricted(
            replace(problem, seen=seen, noise_px=noise), kept, range(seen.shape[1])
        )
    share = float(problem.seen.sum()) / everything
    if share < 0.5:
        worst = max(correspondences, key=broken_share)
        raise inconsistent(
            worst, f"Only {share:.0%} of what the camera saw fits one position of camera and projectors."
        )
    return problem, ba.adjust(problem, state), share


def noise_of(problem: ba.AdjustmentProblem, distance: Float64) -> float:
    """Standard deviation of one coordinate, from the median distance; the points' own freedom is allowed for."""
    measured = 2.0 * float(problem.seen.sum())
    free = measured - float(problem.seen.any(axis=1).sum()) - ba.PROJECTOR_PARAMETERS * distance.shape[1]
    median = float(np.median(distance[problem.seen]))
    # the median distance of two normal coordinates is 1.177 sigma
    return max(median / 1.177 * float(np.sqrt(measured / max(free, 1.0))), 1e-3)


def shape_sigma(problem: ba.AdjustmentProblem, adjusted: ba.Adjusted) -> float:
    """Rms error of the points by wrong parameters, relative to their distance, best moved, turned and scaled."""
    xy, rays = ba.camera_rays(adjusted.state.camera, problem.camera_px)
    z = 1.0 / adjusted.state.inverse_depth
    points = np.concatenate([xy, np.ones((len(xy), 1))], axis=1) * z[:, None]
    away = -adjusted.depth_sensitivity * z[:, None]
    motion = points[:, :, None] * away[:, None, :]
    motion[:, :2, : ba.CAMERA_PARAMETERS] += rays * z[:, None, None]
    wholes = [np.broadcast_to(axis, points.shape) for axis in np.eye(3)]
    wholes += [np.cross(axis, points) for axis in np.eye(3)] + [points]
    basis, _ = np.linalg.qr(np.stack([w.ravel() for w in wholes], axis=1))
    flat = motion.reshape(-1, motion.shape[2])
    flat = flat - basis @ (basis.T @ flat)
    variance = float(np.sum((flat @ adjusted.covariance) * flat))
    return float(np.sqrt(max(variance, 0.0) / float(np.sum(points**2))))


def _refuse_if_contradicted(problem: ba.AdjustmentProblem, state: ba.AdjustmentState) -> None:
    off = np.abs(state.camera - problem.camera_prior)[: ba.CAMERA_PARAMETERS] / problem.camera_sigma
    if float(off.max()) > _LARGEST_PRIOR_SIGMAS:
        raise CalibrationError(
            "camera-prior-contradicted",
            what=f"The best fit gives the camera a focal length of {np.exp(state.camera[0]):.0f} px, and the prior"
            f" {np.exp(problem.camera_prior[0]):.0f} px: {off.max():.0f} sigmas off in focal length, centre or k1.",
            remedy="Check focal_length_px, or the file that intrinsics names, and that pictures are not cropped.",
        )


def _refuse_if_uncertain(uncertainty: float, margin: float, pairs: Sequence[pose_initialisation.Pair]) -> None:
    parallax = max(pair.parallax_px for pair in pairs)
    if uncertainty > LARGEST_SHAPE_SIGMA and all(pair.parallax_px < 20.0 * pair.noise_px for pair in pairs):
        raise _flat(parallax)
    if margin < _CLEAR_MARGIN:
        raise CalibrationError(
            "geometry-ambiguous",
            what="Two different shapes, one with near and far exchanged, explain the pictures equally well.",
            remedy="Place the projectors farther apart, add one, or measure the camera's focal length with a "
            "ChArUco board.",
        )
    if uncertainty > LARGEST_SHAPE_SIGMA:
        raise CalibrationError(
            "geometry-uncertain",
            what=f"The object's shape is known only to {uncertainty:.1%} of its distance.",
            remedy="Place the projectors farther apart, or measure the camera's focal length with a ChArUco board.",
        )


def _in_metres(covariance: Float64, unit_m: float, projectors: int) -> Float64:
    scale = np.ones(len(covariance))
    own = scale[ba.CAMERA_PARAMETERS :].reshape(projectors, ba.PROJECTOR_PARAMETERS)
    own[:, ba.LENS_PARAMETERS + 3 :] = unit_m
    return covariance * np.outer(scale, scale)
