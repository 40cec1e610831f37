"""The comparison of a plan with a stage: exact where the stage is as planned, and off where it is not."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from controller.core.arrays import Float64, Mask
from controller.optics.calibrate.values import Geometry, Metapixels, PhaseMap, Pinhole, ProjectorCalibration, Radiometry
from controller.optics.plan.optics import lit_by, pixels_of
from controller.optics.plan.target_object import AFTER_M, TargetObject
from controller.optics.plan.values import Placement, Surface
from lab.emulated.stands import read
from lab.study.experiments.placement.experiment import CAMERA_M, STANDS, at_size, planned, planned_object, set_up
from lab.study.experiments.placement.measuring import compare_placement, seen_by, seen_by_camera

SIZE = (280, 210)


@pytest.fixture(scope="module")
def plan(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, TargetObject, list[Placement]]:
    mesh = tmp_path_factory.mktemp("planned") / "object.ply"
    planned_object(mesh, 1)
    target_object, best, _ = planned(mesh)
    return mesh, target_object, [at_size(one.placement, SIZE) for one in best.candidates]


def measured(at: Placement, target_object: TargetObject) -> tuple[ProjectorCalibration, Mask]:
    """What a faultless calibration by a camera of 240x180 pixels finds of a projector that stands at ``at``."""
    y, x = np.meshgrid(np.linspace(-0.16, 0.16, 180), np.linspace(-0.2, 0.2, 240), indexing="ij")
    ray = np.stack((x.ravel(), y.ravel() + 0.155, np.ones(x.size)), axis=1)
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    distance, normals = target_object.hit(CAMERA_M[0], ray)
    hit = distance < AFTER_M
    towards = -np.sign(np.sum(normals[hit] * ray[hit], axis=1))[:, None]
    surface = Surface(CAMERA_M[0] + distance[hit, None] * ray[hit], normals[hit] * towards, np.ones(int(hit.sum())))
    lit = lit_by(at, surface, target_object)
    at_px, _ = pixels_of(at, surface.points_m)

    def picture(values: Float64, channels: int) -> Float64:
        out = np.full((x.size, channels), np.nan)
        out[np.flatnonzero(hit)[lit.reached]] = values[lit.reached].reshape(-1, channels)
        return out.reshape(*x.shape, channels)

    variance = 0.5**2 + 1 / 12
    spread = np.tile(np.array([variance, 0.0, variance], np.float32), (SIZE[1], SIZE[0], 1))
    empty = Metapixels(spread[..., :2], spread, np.ones(spread.shape[:2], bool))
    white = np.nan_to_num(np.repeat(picture(lit.lux, 1), 3, axis=2)).astype(np.float32)
    map_px = picture(at_px, 2).astype(np.float32)
    linear = Radiometry(np.tile(np.linspace(0, 1, 256), (3, 1)), np.eye(3))
    return ProjectorCalibration("p", empty, linear, white, PhaseMap(map_px, spread)), np.isfinite(map_px[..., 0])


def test_a_stage_that_is_as_planned_agrees_with_the_plan(plan: tuple[Path, TargetObject, list[Placement]]) -> None:
    _, target_object, (first, second, _) = plan
    points = seen_by(first, *measured(first, target_object), target_object)
    found = compare_placement(second, *measured(second, target_object), points, target_object, 75.0)
    assert np.isfinite(found.off_px).mean() > 0.2
    assert np.nanmax(found.off_px) < 0.01
    assert found.iou > 0.99
    size = found.size_mm[1] / found.size_mm[0]
    assert abs(np.nanmedian(size) - 1) < 0.01
    assert np.nanquantile(np.abs(size - 1), 0.9) < 0.06
    np.testing.assert_allclose(np.nanmedian(found.light[1] / found.light[0]), 1.0, rtol=1e-3)
    assert np.nanmedian(np.abs(found.blur_px[1] - np.hypot(0.5, np.sqrt(1 / 12)))) < 1e-6


def test_where_the_camera_looks_is_found_though_no_projector_stands_as_planned(
    plan: tuple[Path, TargetObject, list[Placement]],
) -> None:
    _, target_object, (first, *_) = plan
    away = dataclasses.replace(
        first, rotation=Rotation.from_euler("yx", (0.6, -0.5), degrees=True).as_matrix() @ first.rotation
    )
    wrong = seen_by(first, *measured(away, target_object), target_object)
    right = seen_by(away, *measured(away, target_object), target_object)
    # as a calibration finds it: from the camera, turned, and at any scale
    turn = Rotation.from_rotvec([0.1, -0.15, 0.02]).as_matrix()
    own = (0.8 * (right.points_m - CAMERA_M[0]) @ turn.T).astype(np.float32)
    camera = Pinhole(np.eye(3), np.zeros(2), np.eye(3), np.zeros(3), (240, 180))
    found = seen_by_camera(Geometry(camera, (), own, own, 0.0, False), wrong, target_object)
    known = np.isfinite(right.points_m[..., 0]) & np.isfinite(found.points_m[..., 0])
    assert known.sum() > 0.98 * np.isfinite(right.points_m[..., 0]).sum()
    before, after = (np.nanmedian(np.linalg.norm(one.points_m - right.points_m, axis=2)) for one in (wrong, found))
    assert before > 5e-3
    assert after < 2e-4
    assert (np.sum(found.normals * right.normals, axis=2)[known] > 0.99).mean() > 0.98


def test_a_projector_that_stands_elsewhere_or_is_zoomed_otherwise_is_told(
    plan: tuple[Path, TargetObject, list[Placement]],
) -> None:
    _, target_object, (first, second, _) = plan
    points = seen_by(first, *measured(first, target_object), target_object)
    turn = Rotation.from_euler("y", 2.0, degrees=True).as_matrix()
    turned = compare_placement(
        second,
        *measured(dataclasses.replace(second, rotation=turn @ second.rotation), target_object),
        points,
        target_object,
        75.0,
    )
    assert np.nanmedian(turned.off_px) == pytest.approx(np.deg2rad(2) * second.focal_px, rel=0.1)
    wider = dataclasses.replace(second, focal_px=1.1 * second.focal_px)
    zoomed = compare_placement(second, *measured(wider, target_object), points, target_object, 75.0)
    assert np.nanmedian(zoomed.size_mm[1] / zoomed.size_mm[0]) == pytest.approx(1 / 1.1, rel=0.02)


def test_the_bench_is_set_up_near_the_plan_and_never_exactly_so(
    plan: tuple[Path, TargetObject, list[Placement]],
) -> None:
    mesh, _, placements = plan
    stands = read(mesh.parent, STANDS)
    assert len(stands) == len(placements)
    for stand, placement in zip(stands, placements, strict=True):
        lens = stand.lens(SIZE)
        assert lens.focal_px == pytest.approx(placement.focal_px, rel=0.0101)
        assert lens.focal_px != pytest.approx(placement.focal_px, rel=1e-5)
        off = np.abs(np.asarray(stand.position_m) - placement.position_m)
        assert 1e-4 < off.max() <= 0.010
        turn = Rotation.from_rotvec(stand.rotation_vector) * Rotation.from_matrix(placement.rotation).inv()
        assert 0.02 < np.rad2deg(turn.magnitude()) < 0.9


def test_each_seed_is_another_stage_and_the_same_one_each_time() -> None:
    stand = {"name": "one", "position_m": [0.0, 0.0, -1.0], "rotation_vector": [0.0, 0.0, 0.0], "throw_ratio": 2.0,
             "centre_share": [0.5, 1.0], "focus_m": 1.0, "lumens": 3000.0, "pupil_m": 0.03}  # fmt: skip
    one, again, other = (set_up(stand, np.random.default_rng([seed, 4])) for seed in (1, 1, 2))
    assert one == again
    assert one != other
    assert one["name"] == "one"
