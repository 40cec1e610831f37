"""The bundle adjustment against COLMAP's (pycolmap): the same observations, the same stage."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest

from controller.core.arrays import Float64
from controller.optics.calibrate.geometry import bundle_adjustment as ba

pycolmap: Any = pytest.importorskip("pycolmap")

NOISE_PX = 0.05
STIFFNESS = 200.0
"""COLMAP weighs all pixels alike, and ours takes camera pixels as exact: so the camera's picture is made larger."""


def stage(seed: int, points: int = 500) -> tuple[ba.AdjustmentProblem, ba.AdjustmentState]:
    """A camera, three projectors around it with lens shift, a bumpy surface, projected by OpenCV."""
    rng = np.random.default_rng(seed)
    camera = np.array([np.log(900.0), 390.0, 262.0, -0.05])
    px = rng.uniform([60, 40], [710, 480], (points, 2))
    matrix = np.array([[900.0, 0, 390.0], [0, 900.0, 262.0], [0, 0, 1]])
    flat = cv2.undistortPointsIter(px[:, None], matrix, np.array([-0.05, 0, 0, 0]), None, None, (3, 99, 1e-12))  # type: ignore[call-overload]
    xy = flat[:, 0]
    depth = 1.0 + 0.08 * np.sin(9 * xy[:, 0] + 1) * np.cos(11 * xy[:, 1]) + 0.5 * np.sum(xy**2, axis=1)
    world = np.concatenate([xy, np.ones((points, 1))], axis=1) * depth[:, None]
    rotations, centres, intrinsics, seen = [], [], [], []
    for centre in ((-0.55, -0.1, 0.1), (0.6, -0.05, 0.05), (0.05, -0.6, 0.1)):
        z = np.array([0.0, 0.0, 1.05]) - centre
        z /= np.linalg.norm(z)
        x = np.cross([0.0, 1.0, 0.0], z)
        x /= np.linalg.norm(x)
        rotation = cv2.Rodrigues(rng.normal(0, 0.03, 3))[0] @ np.stack([x, np.cross(z, x), z])
        lens = np.array([rng.uniform(480, 560), 140.0, 215.0, rng.uniform(-0.06, 0.06)])
        K = np.array([[lens[0], 0, lens[1]], [0, lens[0], lens[2]], [0, 0, 1]])
        bend = np.array([lens[3], 0, 0, 0])
        own, _ = cv2.projectPoints(world, cv2.Rodrigues(rotation)[0], -rotation @ centre, K, bend)
        rotations.append(rotation)
        centres.append(centre)
        intrinsics.append([np.log(lens[0]), *lens[1:]])
        seen.append(own[:, 0] + rng.normal(0, NOISE_PX, (points, 2)))
    state = ba.AdjustmentState(camera, np.array(intrinsics), np.array(rotations), np.array(centres), 1.0 / depth)
    problem = ba.AdjustmentProblem(
        camera_px=px,
        projector_px=np.stack(seen, axis=1),
        seen=rng.random((points, 3)) < 0.9,
        camera_prior=camera,
        camera_sigma=np.array([1e-7, 1e-5, 1e-5, 1e-8]),
        projector_prior=np.array(intrinsics),
        projector_sigma=np.tile([1e3, 1e6, 1e6, 1e3], (3, 1)),
        noise_px=NOISE_PX,
    )
    several = problem.seen.sum(axis=1) >= 2
    problem = replace(
        problem, camera_px=px[several], projector_px=problem.projector_px[several], seen=problem.seen[several]
    )
    return problem, ba.normalised(replace(state, inverse_depth=state.inverse_depth[several]))


def start_of(state: ba.AdjustmentState, seed: int) -> ba.AdjustmentState:
    rng = np.random.default_rng(seed)
    step = np.zeros(34)
    for n in range(3):
        step[4 + 10 * n : 14 + 10 * n] = rng.normal(0, [0.02, 2, 4, 0.02, 0.01, 0.01, 0.01, 0.02, 0.02, 0.02])
    return ba.stepped(state, step, rng.normal(0, 0.01, len(state.inverse_depth)) * state.inverse_depth)


def by_colmap(problem: ba.AdjustmentProblem, start: ba.AdjustmentState) -> ba.AdjustmentState:
    focal, cx, cy, k1 = float(np.exp(start.camera[0])), *(float(v) for v in start.camera[1:])
    rays = np.concatenate([ba.undistorted(start.camera, problem.camera_px), np.ones((len(problem.seen), 1))], axis=1)
    whole = pycolmap.Reconstruction()
    lenses = [("SIMPLE_RADIAL", [STIFFNESS * focal, STIFFNESS * cx, STIFFNESS * cy, k1])]
    lenses += [("SIMPLE_RADIAL", [float(np.exp(f)), x, y, bend]) for f, x, y, bend in start.intrinsics]
    poses = [(np.eye(3), np.zeros(3)), *zip(start.rotations, start.centres, strict=True)]
    everything = np.ones(len(problem.seen), dtype=np.bool_)
    pixels = [(STIFFNESS * problem.camera_px, everything)]
    pixels += [(problem.projector_px[:, n], problem.seen[:, n]) for n in range(3)]
    tracks: list[list[tuple[int, int]]] = [[] for _ in problem.seen]
    for number, ((model, parameters), (turn, centre), (px, seen)) in enumerate(
        zip(lenses, poses, pixels, strict=True), start=1
    ):
        camera = pycolmap.Camera(model=model, width=10**6, height=10**6, params=parameters, camera_id=number)
        whole.add_camera_with_trivial_rig(camera)
        points = np.flatnonzero(seen)
        image = pycolmap.Image(name=str(number), keypoints=px[points], camera_id=number, image_id=number)
        pose = pycolmap.Rigid3d(np.hstack([turn, (-turn @ centre)[:, None]]))
        whole.add_image_with_trivial_frame(image, pose)
        for place, point in enumerate(points.tolist()):
            tracks[point].append((number, place))
    for index, track in enumerate(tracks):
        made = pycolmap.Track()
        for image_id, place in track:
            made.add_element(image_id, place)
        whole.add_point3D(rays[index] / start.inverse_depth[index], made)
    config = pycolmap.BundleAdjustmentConfig()
    for number in range(1, 5):
        config.add_image(number)
    config.set_constant_cam_intrinsics(1)
    config.set_constant_rig_from_world_pose(whole.images[1].frame_id)
    options = pycolmap.BundleAdjustmentOptions(refine_principal_point=True, print_summary=False)
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = 2.4 * NOISE_PX
    options.ceres.solver_options.max_num_iterations = 200
    options.ceres.solver_options.gradient_tolerance = 1e-10
    pycolmap.create_default_bundle_adjuster(options, config, whole).solve()
    found = [whole.images[number].cam_from_world() for number in (2, 3, 4)]
    turns = np.array([pose.rotation.matrix() for pose in found])
    centres = np.array([whole.images[number].projection_center() for number in (2, 3, 4)])
    intrinsics = [[np.log(p[0]), *p[1:]] for p in (whole.cameras[number].params for number in (2, 3, 4))]
    return ba.normalised(ba.AdjustmentState(start.camera, np.array(intrinsics), turns, centres, start.inverse_depth))


def parameters(one: ba.AdjustmentState, other: ba.AdjustmentState) -> Float64:
    """The projectors' parameters (30,) by which ``one`` differs from ``other``."""
    turns = [cv2.Rodrigues(a @ b.T)[0].ravel() for a, b in zip(one.rotations, other.rotations, strict=True)]
    return np.concatenate(
        [one.intrinsics - other.intrinsics, np.array(turns), one.centres - other.centres], axis=1
    ).ravel()


@pytest.mark.parametrize("seed", [1, 2])
def test_colmap_finds_the_same_stage_well_within_our_covariance(seed: int) -> None:
    problem, truth = stage(seed)
    start = start_of(truth, seed)
    ours = ba.adjust(problem, start, iterations=100, tolerance=1e-12)
    theirs = by_colmap(problem, start)
    sigma = np.sqrt(np.diag(ours.covariance))[4:]
    assert np.all(np.abs(parameters(ours.state, theirs)) < 0.1 * sigma)
    # and both are as far from the truth as the covariance says
    assert np.all(np.abs(parameters(ours.state, truth)) < 4.5 * sigma)
