"""One bundle adjustment over several cameras and projectors around an object, against where they stand."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from controller.config.models import PoseTable
from controller.core.arrays import Float64
from controller.core.errors import CalibrationError
from controller.optics.calibrate.geometry.self_calibration import first_poses, reconstruct
from controller.optics.calibrate.geometry.values import CameraPrior
from controller.optics.calibrate.geometry.view_poses import JoinedView, SeenStage, join_views
from controller.optics.calibrate.metapixels.from_dots import project
from controller.optics.calibrate.values import Correspondence, Pinhole

CAMERA, PROJECTOR = (160, 120), (320, 240)
BALLS = ((0.0, 0.0, 0.0, 0.3), (0.15, -0.2, 0.1, 0.2), (-0.2, 0.15, -0.15, 0.18))


def looking_at_the_middle(degrees: float, away: float, height: float, size: tuple[int, int], focal: float) -> Pinhole:
    angle = np.deg2rad(degrees)
    stand = np.array([away * np.sin(angle), height, -away * np.cos(angle)])
    ahead = -stand / np.linalg.norm(stand)
    right = np.cross([0.0, 1, 0], ahead)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(ahead, right), ahead])
    matrix = np.array([[focal, 0, (size[0] - 1) / 2], [0, focal, (size[1] - 1) / 2], [0, 0, 1]])
    return Pinhole(matrix, np.zeros(4), rotation, -rotation @ stand, size)


def centre(pinhole: Pinhole) -> Float64:
    return np.asarray(-pinhole.rotation.T @ pinhole.translation_m)


def surface(camera: Pinhole) -> tuple[Float64, Float64]:
    """Where each pixel meets the object, and its normal; NaN beside it."""
    x, y = np.meshgrid(np.arange(CAMERA[0]), np.arange(CAMERA[1]))
    rays = np.stack([x, y, np.ones_like(x)], -1) @ np.linalg.inv(camera.matrix).T @ camera.rotation
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    start, nearest = centre(camera), np.full(x.shape, np.inf)
    normals = np.full(rays.shape, np.nan)
    for *middle, radius in BALLS:
        towards = start - np.array(middle)
        along = (rays * towards).sum(axis=2)
        inside = along**2 - towards @ towards + radius**2
        depth = np.where(inside > 0, -along - np.sqrt(np.maximum(inside, 0)), np.inf)
        mine = depth < nearest
        nearest[mine] = depth[mine]
        normals[mine] = ((start + rays * depth[..., None] - np.array(middle)) / radius)[mine]
    points = np.where(
        np.isfinite(nearest)[..., None], start + rays * np.where(np.isfinite(nearest), nearest, 0)[..., None], np.nan
    )
    return points, normals


def seen_stage(
    name: str, camera: Pinhole, projectors: Sequence[Pinhole], lit: Sequence[int], noise: float
) -> SeenStage:
    """What a camera sees of the projectors ``lit``; its own geometry is in other units, and not exact."""
    random = np.random.default_rng(len(name) + len(lit))
    points, normals = surface(camera)
    found, poses, unit = [], {}, random.uniform(0.5, 2)
    for n, own in enumerate(projectors):
        px, _ = project(own, np.nan_to_num(points).reshape(-1, 3))
        towards = centre(own) - points
        facing = (towards * normals).sum(axis=2) > 0.3 * np.linalg.norm(towards, axis=2)
        px = px.reshape(*points.shape[:2], 2)
        valid = facing & (px > 0).all(axis=2) & (px < np.array(own.size_px) - 1).all(axis=2) & (n in lit)
        px = np.where(valid[..., None], px + random.normal(0, noise, px.shape), np.nan).astype(np.float32)
        found.append(Correspondence(px.astype(np.float32), valid.astype(np.float32), valid))
        if n in lit:
            rotation = own.rotation @ camera.rotation.T
            turned = Rotation.from_rotvec(random.normal(0, 0.004, 3)).as_matrix() @ rotation
            stand = camera.rotation @ (centre(own) - centre(camera)) * unit * random.normal(1, 0.004, 3)
            matrix = own.matrix * np.array([[1.01], [1.01], [1]])
            matrix[2] = (0, 0, 1)
            poses[n] = replace(own, matrix=matrix, rotation=turned, translation_m=-turned @ stand)
    return SeenStage(name, found, CAMERA, CameraPrior(230.0, 0.005), poses)


def stage(noise: float = 0.05) -> tuple[list[Pinhole], list[Pinhole], list[SeenStage]]:
    """Three cameras around the object, and four projectors, of which each sees two or three."""
    cameras = [looking_at_the_middle(degrees, 1.6, -0.1 * n, CAMERA, 230.0) for n, degrees in enumerate((0, 75, -70))]
    projectors = [
        looking_at_the_middle(degrees, 1.9, height, PROJECTOR, 520.0)
        for degrees, height in ((-100, -0.4), (-35, -0.2), (35, -0.5), (100, -0.1))
    ]
    lit = ((1, 2), (1, 2, 3), (0, 1, 2))
    views = [seen_stage(name, camera, projectors, some, noise)
             for name, camera, some in zip(("front", "right", "left"), cameras, lit, strict=True)]  # fmt: skip
    return cameras, projectors, views


def joined(views: Sequence[SeenStage]) -> list[JoinedView]:
    return join_views(views, ["a", "b", "c", "d"], [PROJECTOR] * 4)


def test_views_stand_where_they_stand_and_their_points_meet() -> None:
    cameras, projectors, views = stage()
    distance = float(np.nanmin(np.linalg.norm(surface(cameras[1])[0] - centre(cameras[1]), axis=2)))
    views[1] = replace(views[1], prior=replace(views[1].prior, distance_m=distance, distance_rel_sigma=0.001))
    found = joined(views)
    first = cameras[0]
    for camera, one in zip(cameras, found, strict=True):
        turn = camera.rotation @ first.rotation.T
        assert np.degrees(Rotation.from_matrix(one.pose.rotation @ turn.T).magnitude()) < 0.3
        stand = first.rotation @ (centre(camera) - centre(first))
        assert np.linalg.norm(-one.pose.rotation.T @ one.pose.shift_m - stand) < 0.02
        geometry = one.reconstruction.geometry
        assert geometry.scale_known
        assert geometry.reprojection_rms_px < 0.1
        # in the first camera's frame every view's points lie on the object
        points = (geometry.points_m - one.pose.shift_m) @ one.pose.rotation @ first.rotation + centre(first)
        off = np.abs(np.linalg.norm(points - surface(camera)[0], axis=2))
        assert np.nanmedian(off) < 0.012
        # all projectors are known in every view's frame, also those that it does not see
        for own, pose in zip(projectors, geometry.projectors, strict=True):
            there = camera.rotation @ (centre(own) - centre(camera))
            assert np.linalg.norm(centre(pose) - there) < 0.05
    uncertain = np.sqrt(np.diag(found[1].reconstruction.covariance))
    assert np.isfinite(uncertain).all()
    assert (uncertain[:4] > 0).all()


def test_all_views_together_fit_as_well_as_scipys_least_squares() -> None:
    """The same observations, free poses and points, by another optimiser from where this one ended."""
    from scipy.optimize import least_squares

    _, _, views = stage(noise=0.3)
    found = joined(views)
    rms = [one.reconstruction.geometry.reprojection_rms_px for one in found]
    geometry = found[1].reconstruction.geometry
    # a projector moved by itself fits no better
    own = views[1].correspondences[3]
    some = np.argwhere(own.valid & np.isfinite(geometry.points_m[..., 0]))[::7]
    points = geometry.points_m[tuple(some.T)].astype(np.float64)
    px = own.projector_px[tuple(some.T)].astype(np.float64)

    def off(step: Float64) -> Float64:
        pose = geometry.projectors[3]
        turn = Rotation.from_rotvec(step[:3]).as_matrix() @ pose.rotation
        return np.asarray(
            (project(replace(pose, rotation=turn, translation_m=pose.translation_m + step[3:]), points)[0] - px).ravel()
        )

    best = least_squares(off, np.zeros(6), loss="linear")
    assert np.sqrt(np.mean(off(np.zeros(6)) ** 2)) < 1.05 * np.sqrt(np.mean(best.fun**2))
    assert max(rms) < 0.45


def test_a_view_whose_own_shape_is_uncertain_is_joined_by_what_others_know() -> None:
    """One projector stands almost in its camera's place, and the other two light different sides of the object."""
    cameras, projectors, _ = stage()
    projectors.append(looking_at_the_middle(75, 1.612, -0.1, PROJECTOR, 520.0))
    sees, sizes = (1, 4, 3), [PROJECTOR] * 5
    right = replace(seen_stage("right", cameras[1], projectors, sees, 1.2), prior=CameraPrior(230.0, 1.0))
    seen = [right.correspondences[n] for n in sees], CAMERA, sizes[:3], right.prior
    with pytest.raises(CalibrationError) as alone:
        reconstruct(*seen)
    assert alone.value.code == "geometry-uncertain"
    front = seen_stage("front", cameras[0], projectors, (1, 2, 3, 4), 0.05)
    started = replace(right, poses=dict(zip(sees, first_poses(*seen), strict=True)))
    left = seen_stage("left", cameras[2], projectors, (0, 1, 2), 0.05)
    found = join_views([front, started, left], ["a", "b", "c", "d", "e"], sizes)
    turn = cameras[1].rotation @ cameras[0].rotation.T
    assert np.degrees(Rotation.from_matrix(found[1].pose.rotation @ turn.T).magnitude()) < 0.3
    assert found[1].reconstruction.shape_rel_sigma < 0.001


def test_a_view_that_shares_one_projector_is_named() -> None:
    cameras, projectors, views = stage()
    views[2] = seen_stage("left", cameras[2], projectors, (0, 1), 0.05)
    views[1] = seen_stage("right", cameras[1], projectors, (2, 3), 0.05)
    with pytest.raises(CalibrationError) as refused:
        joined(views)
    assert refused.value.code == "views-not-linked"
    assert "right" in refused.value.what or "left" in refused.value.what
    assert "projector" in refused.value.what


def test_distances_that_contradict_each_other_are_refused() -> None:
    _, _, views = stage()
    for v, metres in ((0, 1.3), (1, 1.5)):
        views[v] = replace(views[v], prior=replace(views[v].prior, distance_m=metres, distance_rel_sigma=0.005))
    with pytest.raises(CalibrationError) as refused:
        joined(views)
    assert refused.value.code == "distances-contradict"


TO_ROOM = Rotation.from_euler("xyz", (0.3, -1.1, 2.0))
"""How the frame in which poses were measured is turned; it lies elsewhere, too."""


def measured(device: Pinhole, off_m: Sequence[float] | Float64 = (0, 0, 0), sigma_m: float = 0.001) -> PoseTable:
    """Its true place in the room, moved by ``off_m``."""
    x, y, z = TO_ROOM.apply(centre(device)) + np.array((4.0, -2.0, 1.0)) + off_m
    return PoseTable(position_m=(x, y, z), sigma_m=sigma_m)


def test_measured_poses_give_the_size_and_make_places_better() -> None:
    cameras, projectors, views = stage(noise=2.0)
    sizes, names = [PROJECTOR] * 4, ["a", "b", "c", "d"]

    def off_m(found: Sequence[JoinedView]) -> float:
        """The largest error of how far two devices are apart."""
        own = [-one.pose.rotation.T @ one.pose.shift_m for one in found]
        own += [centre(pose) for pose in found[0].reconstruction.geometry.projectors]
        true = [centre(one) for one in (*cameras, *projectors)]
        pairs = list(itertools.combinations(range(len(true)), 2))
        return max(abs(float(np.linalg.norm(own[a] - own[b]) - np.linalg.norm(true[a] - true[b]))) for a, b in pairs)

    distance = float(np.nanmin(np.linalg.norm(surface(cameras[0])[0] - centre(cameras[0]), axis=2)))
    without = [replace(views[0], prior=replace(views[0].prior, distance_m=distance, distance_rel_sigma=1e-4))]
    alone = off_m(join_views([*without, *views[1:]], names, sizes))
    for v in (0, 1, 2):
        views[v] = replace(views[v], prior=replace(views[v].prior, pose=measured(cameras[v])))
    found = join_views(views, names, sizes, [measured(own) for own in projectors])
    assert all(one.reconstruction.geometry.scale_known for one in found)
    assert found[0].reconstruction.scale_rel_sigma < 0.002
    assert off_m(found) < min(0.004, alone / 3)


@pytest.mark.slow
def test_poses_and_photographs_together_fit_as_well_as_scipys_least_squares() -> None:
    """One view, poses that are off by their sigma: with the lenses as found, scipy finds no better places."""
    from scipy.optimize import least_squares

    noise, sigma_m = 0.5, 0.01
    camera = looking_at_the_middle(0, 1.6, 0, CAMERA, 230.0)
    projectors = [looking_at_the_middle(degrees, 1.9, height, PROJECTOR, 520.0)
                  for degrees, height in ((-45, -0.2), (0, -0.8), (40, -0.3))]  # fmt: skip
    view = seen_stage("front", camera, projectors, (0, 1, 2), noise)
    part = np.zeros(CAMERA[::-1], np.bool_)
    part[48:66, 66:90] = True
    view = replace(view, correspondences=[replace(own, valid=own.valid & part) for own in view.correspondences])
    random = np.random.default_rng(3)
    poses = [measured(own, off_m=random.normal(0, sigma_m, 3), sigma_m=sigma_m) for own in projectors]
    found = join_views([view], ["a", "b", "c"], [PROJECTOR] * 3, poses)[0].reconstruction
    geometry, noise_px = found.geometry, found.noise_px
    seen = np.stack([own.valid for own in view.correspondences], 2)
    some = np.argwhere(seen.sum(axis=2) >= 2)
    seen, depth = seen[tuple(some.T)], np.nanmedian(geometry.points_m[..., 2])
    rays = np.column_stack([geometry.camera.rays(some[:, ::-1].astype(np.float64)), np.ones(len(some))])
    points = rays * depth
    px = np.stack([own.projector_px[tuple(some.T)] for own in view.correspondences], 1).astype(np.float64)
    middles = np.array([centre(own) for own in geometry.projectors])
    there = np.array([pose.position_m for pose in poses])
    room, _ = Rotation.align_vectors(there - there.mean(axis=0), middles - middles.mean(axis=0))

    def off(step: Float64) -> Float64:
        depths, own, frame = step[: len(points)], step[len(points) : -6].reshape(3, 6), step[-6:]
        at = points * np.exp(depths)[:, None]
        parts = []
        for n, pose in enumerate(geometry.projectors):
            turn = Rotation.from_rotvec(own[n, :3]).as_matrix() @ pose.rotation
            moved = replace(pose, rotation=turn, translation_m=-turn @ (middles[n] + own[n, 3:]))
            apart = ((project(moved, np.asarray(at, np.float64))[0] - px[:, n]) / noise_px)[seen[:, n]]
            # the same loss: what is far off counts less
            squared = np.maximum((apart**2).sum(axis=1, keepdims=True), 1e-12) / 2.4**2
            parts.append((apart * np.sqrt(np.log1p(squared) / squared)).ravel())
        turned = (Rotation.from_rotvec(frame[:3]) * room).apply(middles + own[:, 3:])
        parts.append(
            ((turned + frame[3:] + there.mean(axis=0) - room.apply(middles.mean(axis=0)) - there) / sigma_m).ravel()
        )
        return np.concatenate(parts)

    rows = np.concatenate([np.repeat(np.flatnonzero(seen[:, n]), 2) for n in range(3)])

    def by_step(step: Float64) -> Float64:
        """Numerically; each depth moves the rows of its own point."""
        now, found = off(step), np.zeros((len(rows) + 9, len(step)))
        found[np.arange(len(rows)), rows] = (off(step + np.r_[np.full(len(points), 1e-6), np.zeros(24)]) - now)[
            :-9
        ] / 1e-6
        for column in range(len(points), len(step)):
            found[:, column] = (off(step + 1e-6 * (np.arange(len(step)) == column)) - now) / 1e-6
        return found

    def least(free: int) -> float:
        """The least cost with the depths free, and so many others."""
        start = np.zeros(len(points) + 24)

        def whole(part: Float64) -> Float64:
            return np.concatenate([part, start[len(part) :]])

        def apart(part: Float64) -> Float64:
            return off(whole(part))

        def slope(part: Float64) -> Float64:
            return by_step(whole(part))[:, : len(part)]

        best = least_squares(apart, start[: len(points) + free], method="lm", x_scale="jac", jac=slope)
        return float(best.cost)

    assert least(0) - least(24) < 24 / 8, "a quarter of what 24 free values gain of noise alone"


def test_a_wrong_pose_is_named_and_one_that_is_not_certain_is_not() -> None:
    _, projectors, views = stage()
    poses = [measured(own) for own in projectors]
    poses[2] = measured(projectors[2], off_m=(0.05, 0, 0))
    with pytest.raises(CalibrationError) as refused:
        join_views(views, ["a", "b", "c", "d"], [PROJECTOR] * 4, poses)
    assert refused.value.code == "pose-contradicted"
    assert refused.value.what.startswith("c ")
    poses[2] = measured(projectors[2], off_m=(0.05, 0, 0), sigma_m=0.05)
    assert join_views(views, ["a", "b", "c", "d"], [PROJECTOR] * 4, poses)
