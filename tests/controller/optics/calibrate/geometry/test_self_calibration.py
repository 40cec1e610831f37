"""The geometry against a stage simulated here: a bumpy surface, ray by ray, and pinholes written out again."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from controller.core.errors import CalibrationError, UsageError, WorkError
from controller.optics.calibrate.geometry.self_calibration import reconstruct
from controller.optics.calibrate.geometry.values import CameraPrior, Reconstruction, parameter_names
from controller.optics.calibrate.metapixels.from_dots import project
from controller.optics.calibrate.values import Correspondence

pytestmark = pytest.mark.slow

Array = npt.NDArray[np.float64]
CAMERA = (388, 260)
PROJECTOR = (280, 210)


@dataclass(frozen=True)
class Stage:
    """A true stage: camera focal length, points (rows, columns, 3), projectors as (K, R, centre)."""

    focal_px: float
    points: Array
    projectors: list[tuple[Array, Array, Array]]
    correspondences: list[Correspondence]
    projector_px: tuple[int, int] = PROJECTOR


def turn(axis: int, angle: float) -> Array:
    i, j = [(1, 2), (2, 0), (0, 1)][axis]
    out = np.eye(3)
    out[i, i] = out[j, j] = np.cos(angle)
    out[j, i], out[i, j] = np.sin(angle), -np.sin(angle)
    return out


def looking_at(centre: Array, target: Array, roll: float) -> Array:
    z = (target - centre) / np.linalg.norm(target - centre)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    return np.asarray(turn(2, roll) @ np.stack([x, np.cross(z, x), z]), dtype=np.float64)


def opencv_lens(lens: CameraPrior) -> tuple[Array, Array]:
    k2, p1, p2, log_aspect = lens.other_terms
    assert lens.principal_point_px is not None
    x, y = lens.principal_point_px
    matrix = np.array([[lens.focal_length_px, 0, x], [0, lens.focal_length_px * np.exp(log_aspect), y], [0, 0, 1]])
    return matrix, np.array([lens.distortion_k1, k2, p1, p2])


def make_stage(
    seed: int,
    *,
    projectors: int = 3,
    noise_px: float = 0.2,
    outliers: float = 0.03,
    relief_m: float = 0.1,
    camera: tuple[int, int] = CAMERA,
    k1: float = -0.04,
    focal_error: float = 0.01,
    lens: tuple[float, float] = (0.0, 0.0),
    projector_px: tuple[int, int] = PROJECTOR,
    camera_lens: CameraPrior | None = None,
) -> Stage:
    """``lens``: k1 and k2 of every projector, about its principal point; ``camera_lens`` instead of the usual one."""
    rng = np.random.default_rng(seed)
    width, height = camera
    focal = 1.55 * width
    column, row = np.meshgrid(np.arange(width), np.arange(height))
    distorted = np.stack([column - (width - 1) / 2 - 1.5, row - (height - 1) / 2 + 1.0], axis=2) / focal
    xy = distorted
    for _ in range(20):
        xy = distorted / (1 + k1 * np.sum(xy**2, axis=2, keepdims=True))
    if camera_lens is not None:
        focal = camera_lens.focal_length_px
        matrix, terms = opencv_lens(camera_lens)
        seen = np.stack([column, row], axis=2).reshape(-1, 1, 2).astype(float)
        until = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 300, 1e-13)
        flat = cv2.undistortPointsIter(seen, matrix, terms, np.eye(3), np.eye(3), until)
        xy = np.asarray(flat, np.float64).reshape(height, width, 2)
    waves = rng.uniform(8, 22, (5, 2)) * rng.choice([-1, 1], (5, 2))
    phases = rng.uniform(0, 6.28, 5)

    def surface(x: Array, y: Array) -> Array:
        bumps: Array = np.zeros_like(x)
        for (a, b), c in zip(waves, phases, strict=True):
            bumps += np.sin(a * x + b * y + c) / np.hypot(a, b)
        return np.asarray(1.0 + relief_m * (bumps * 2.0 + 12.0 * (x**2 + 0.5 * y**2)))

    depth = np.ones((height, width))
    for _ in range(10):
        depth = 0.5 * depth + 0.5 * surface(depth * xy[..., 0], depth * xy[..., 1])
    for _ in range(5):  # near by now: Newton's steps, each by the slope along the ray
        at, ahead = (surface(reach * xy[..., 0], reach * xy[..., 1]) for reach in (depth, depth + 1e-6))
        depth += (at - depth) / (1 - (ahead - at) / 1e-6)
    points = depth[..., None] * np.concatenate([xy, np.ones((height, width, 1))], axis=2)
    inside = (points[..., 0] / 0.26) ** 2 + (points[..., 1] / 0.18) ** 2 < 1
    target = np.median(points[inside], axis=0)
    true, found = [], []
    for angle, lift in list(zip((-28, 30, 4), (8, 4, 27), strict=True))[:projectors]:
        a, b = np.deg2rad(angle + rng.uniform(-4, 4)), np.deg2rad(lift + rng.uniform(-4, 4))
        reach = rng.uniform(1.05, 1.25)
        centre = target + reach * np.array([np.sin(a) * np.cos(b), -np.sin(b), -np.cos(a) * np.cos(b)])
        w, h = projector_px
        f = rng.uniform(1.7, 2.1) * w
        K = np.array([[f, 0, (w - 1) / 2 + rng.normal(0, 0.005 * w)], [0, f, 1.05 * h + rng.normal(0, 2)], [0, 0, 1]])
        R = turn(0, np.arctan((K[1, 2] - h / 2) / f)) @ looking_at(centre, target, rng.normal(0, 0.05))
        seen = (points - centre) @ R.T
        flat = seen / seen[..., 2:]
        r2 = np.sum(flat[..., :2] ** 2, axis=2, keepdims=True)
        flat[..., :2] *= 1 + lens[0] * r2 + lens[1] * r2**2
        px = flat @ K.T
        px = px[..., :2] + rng.normal(0, noise_px, (height, width, 2))
        valid = inside & np.all((px > 0) & (px < np.array([w - 1, h - 1])), axis=2) & (seen[..., 2] > 0)
        wrong = rng.random((height, width)) < outliers
        px[wrong] = rng.uniform(0, 1, (int(wrong.sum()), 2)) * (w, h)
        px[~valid] = np.nan
        found.append(Correspondence(px.astype(np.float32), valid.astype(np.float32), valid))
        true.append((K, R, centre))
    return Stage(focal * (1 + rng.normal(0, focal_error)), points, true, found, projector_px)


def solve(stage: Stage, *, distance_m: float | None = None, focal_rel_sigma: float = 0.01) -> Reconstruction:
    rows, columns = stage.correspondences[0].valid.shape
    prior = CameraPrior(stage.focal_px, focal_rel_sigma, distance_m=distance_m)
    return reconstruct(stage.correspondences, (columns, rows), [stage.projector_px] * len(stage.projectors), prior)


def fitted(ours: Array, truth: Array) -> tuple[Array, float, Array, Array]:
    """Ours moved, turned and scaled onto the truth (Umeyama), and the scale, rotation and shift that do it."""
    a, b = ours - ours.mean(axis=0), truth - truth.mean(axis=0)
    u, s, vt = np.linalg.svd(b.T @ a)
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = u @ flip @ vt
    scale = float(np.sum(s * np.diag(flip)) / np.sum(a * a))
    shift = truth.mean(axis=0) - scale * rotation @ ours.mean(axis=0)
    return scale * ours @ rotation.T + shift, scale, rotation, shift


def shape_error_m(stage: Stage, found: Reconstruction) -> float:
    points = found.geometry.points_m.astype(np.float64)
    known = np.isfinite(points[..., 2])
    moved, *_ = fitted(points[known], stage.points[known])
    return float(np.sqrt(np.mean(np.sum((moved - stage.points[known]) ** 2, axis=1))))


@pytest.fixture(scope="module")
def stage() -> Stage:
    return make_stage(11, noise_px=0.2)


@pytest.fixture(scope="module")
def found(stage: Stage) -> Reconstruction:
    return solve(stage, distance_m=1.3)


def test_shape_poses_and_lenses_come_out_of_noisy_correspondences(stage: Stage, found: Reconstruction) -> None:
    points = found.geometry.points_m.astype(np.float64)
    known = np.isfinite(points[..., 2])
    lit = np.any([c.valid for c in stage.correspondences], axis=0)
    assert known.sum() > 0.95 * lit.sum()  # all but two pixels along the border
    assert shape_error_m(stage, found) < 4e-4
    assert found.geometry.reprojection_rms_px < 0.2
    assert found.noise_px == pytest.approx(0.2, rel=0.1)
    _, scale, rotation, shift = fitted(points[known], stage.points[known])
    for own, (K, R, centre) in zip(found.geometry.projectors, stage.projectors, strict=True):
        ours = scale * rotation @ (-own.rotation.T @ own.translation_m) + shift
        assert np.linalg.norm(ours - centre) < 0.01
        assert np.degrees(np.arccos(0.5 * np.trace(own.rotation @ rotation.T @ R.T) - 0.5)) < 0.5
        assert own.matrix[0, 0] == pytest.approx(K[0, 0], rel=0.015)
        assert own.matrix[0, 0] == own.matrix[1, 1]


def test_the_found_pinholes_project_the_found_points_where_they_were_seen(stage: Stage, found: Reconstruction) -> None:
    points = found.geometry.points_m.astype(np.float64)
    for own, seen in zip(found.geometry.projectors, stage.correspondences, strict=True):
        q = points @ own.rotation.T + own.translation_m
        px = (q @ own.matrix.T)[..., :2] / q[..., 2:]
        off = np.linalg.norm(px - seen.projector_px, axis=2)
        assert np.nanmedian(off) < 0.3


def test_a_measured_distance_sets_the_scale(stage: Stage, found: Reconstruction) -> None:
    distance = np.linalg.norm(found.geometry.points_m, axis=2)
    assert found.geometry.scale_known
    assert np.nanquantile(distance, 0.001) == pytest.approx(1.3, rel=1e-4)
    assert found.scale_rel_sigma == 0.01


def test_normals_are_the_surfaces_and_point_to_the_camera(stage: Stage, found: Reconstruction) -> None:
    across = np.gradient(stage.points, axis=1)
    down = np.gradient(stage.points, axis=0)
    truth = np.cross(down, across)
    truth /= np.linalg.norm(truth, axis=2, keepdims=True)
    known = np.isfinite(found.geometry.normals[..., 0])
    cosine = np.sum(found.geometry.normals * truth, axis=2)[known]
    assert np.degrees(np.arccos(np.median(cosine))) < 4.0
    assert np.all(np.sum(found.geometry.normals * found.geometry.points_m, axis=2)[known] < 0)
    np.testing.assert_allclose(np.linalg.norm(found.geometry.normals[known], axis=1), 1.0, rtol=1e-5)


def test_the_covariance_names_its_rows_and_predicts_the_error(stage: Stage, found: Reconstruction) -> None:
    names = parameter_names(3)
    assert found.parameter_names == names
    assert found.covariance.shape == (len(names), len(names)) == (34, 34)
    sigma = dict(zip(names, np.sqrt(np.diag(found.covariance)), strict=True))
    assert sigma["camera.log_focal"] < 0.0101
    for n, (own, (K, _, _)) in enumerate(zip(found.geometry.projectors, stage.projectors, strict=True)):
        assert abs(np.log(own.matrix[0, 0] / K[0, 0])) < 4 * sigma[f"projector{n}.log_focal"]
        assert abs(own.matrix[1, 2] - K[1, 2]) < 4 * sigma[f"projector{n}.cy_px"]
    assert found.shape_rel_sigma < 5e-4


def test_projectors_in_another_order_give_the_same_stage(stage: Stage, found: Reconstruction) -> None:
    order = [2, 0, 1]
    turned = replace(
        stage,
        projectors=[stage.projectors[n] for n in order],
        correspondences=[stage.correspondences[n] for n in order],
    )
    again = solve(turned, distance_m=1.3)
    np.testing.assert_allclose(again.geometry.points_m, found.geometry.points_m, atol=2e-5)
    for n, own in zip(order, again.geometry.projectors, strict=True):
        np.testing.assert_allclose(own.matrix, found.geometry.projectors[n].matrix, rtol=1e-3, atol=0.05)
        np.testing.assert_allclose(own.translation_m, found.geometry.projectors[n].translation_m, atol=1e-3)


@pytest.mark.parametrize(
    ("k1", "terms"),
    [(-0.9, (1.0, 0.0, 0.0, 0.0)), (-0.05, (0.0, 0.02, -0.03, 0.0)), (-0.05, (0.0, 0.0, 0.0, np.log(1380 / 1300)))],
)
def test_a_camera_lens_with_more_terms_costs_no_shape(k1: float, terms: tuple[float, float, float, float]) -> None:
    wide = CameraPrior(
        1.55 * CAMERA[0], 0.001, (0.5 * CAMERA[0] + 2.0, 0.5 * CAMERA[1] - 3.0), 0.5, 0.005,
        distortion_k1=k1, other_terms=terms,
    )  # fmt: skip
    stage = make_stage(5, camera_lens=wide)
    found = reconstruct(stage.correspondences, CAMERA, [stage.projector_px] * 3, wide)
    assert shape_error_m(stage, found) < 4e-4
    seen = found.geometry.camera
    matrix, distortion = opencv_lens(wide)
    rays = stage.points[np.isfinite(found.geometry.points_m[..., 2])]
    theirs, ours = (
        cv2.projectPoints(rays, np.zeros(3), np.zeros(3), *one)[0].reshape(-1, 2)
        for one in ((matrix, distortion), (seen.matrix, seen.distortion))
    )
    assert np.max(np.abs(theirs - ours)) < 1.0


BENT = [(0.02, -0.005), (-0.04, 0.01), (0.06, 0.0), (-0.06, 0.0)]
"""k1 and k2 of projectors; with the last two the corners lie 5 px of 280 off."""


@pytest.mark.parametrize("lens", BENT)
def test_bent_pictures_of_projectors_cost_neither_shape_nor_poses(lens: tuple[float, float]) -> None:
    stage = make_stage(11, lens=lens)
    found = solve(stage)
    points = found.geometry.points_m.astype(np.float64)
    known = np.isfinite(points[..., 2])
    assert shape_error_m(stage, found) < 4e-4
    assert found.geometry.reprojection_rms_px < 0.2
    assert found.noise_px == pytest.approx(0.2, rel=0.1)
    sigma = dict(zip(found.parameter_names, np.sqrt(np.diag(found.covariance)), strict=True))
    _, scale, rotation, shift = fitted(points[known], stage.points[known])
    for n, (own, (K, R, centre)) in enumerate(zip(found.geometry.projectors, stage.projectors, strict=True)):
        ours = scale * rotation @ (-own.rotation.T @ own.translation_m) + shift
        assert np.linalg.norm(ours - centre) < 0.01
        assert np.degrees(np.arccos(0.5 * np.trace(own.rotation @ rotation.T @ R.T) - 0.5)) < 0.5
        assert own.matrix[0, 0] == pytest.approx(K[0, 0], rel=0.015)
        assert sigma[f"projector{n}.k1"] < 0.01
        # one term stands for both: k1 + k2 r2, which is at most 0.3 with this lens shift
        assert abs(own.distortion[0] - lens[0]) < 4 * sigma[f"projector{n}.k1"] + 0.3 * abs(lens[1])


@pytest.mark.parametrize("projectors", [2, 3])
@pytest.mark.parametrize("lens", [(0.06, 0.0), (-0.06, 0.0), (-0.06, 0.015)])
def test_pictures_of_full_hd_are_bent_by_tens_of_pixels(lens: tuple[float, float], projectors: int) -> None:
    stage = make_stage(12, lens=lens, projectors=projectors, projector_px=(1920, 1440), noise_px=0.3)
    found = solve(stage)
    assert found.inlier_share > 0.9
    assert shape_error_m(stage, found) < 4e-4


@pytest.mark.parametrize("lens", BENT)
@pytest.mark.parametrize("projectors", [2, 3])
def test_a_flat_scene_is_refused_whatever_the_projectors_lenses(lens: tuple[float, float], projectors: int) -> None:
    with pytest.raises(CalibrationError) as refused:
        solve(make_stage(1, relief_m=0.0, lens=lens, projectors=projectors))
    assert refused.value.code in ("scene-flat", "geometry-uncertain", "geometry-ambiguous")


def test_the_found_lenses_bend_the_found_points_to_where_they_were_seen() -> None:
    stage = make_stage(11, lens=(-0.06, 0.0))
    found = solve(stage)
    for own, seen in zip(found.geometry.projectors, stage.correspondences, strict=True):
        px, _ = project(own, found.geometry.points_m.astype(np.float64))
        assert np.nanmedian(np.linalg.norm(px - seen.projector_px, axis=2)) < 0.3


@pytest.mark.parametrize("seed", range(3))
def test_two_projectors_are_enough(seed: int) -> None:
    stage = make_stage(seed, projectors=2, noise_px=0.15)
    assert shape_error_m(stage, solve(stage)) < 5e-4


@pytest.mark.parametrize("seed", [20, 21])
def test_little_depth_still_converges_to_the_right_shape(seed: int) -> None:
    stage = make_stage(seed, relief_m=0.03, noise_px=0.1)
    assert shape_error_m(stage, solve(stage)) < 4e-4


@pytest.mark.parametrize("seed", [1, 4, 5])
def test_a_nearly_flat_scene_is_right_or_refused_but_never_quietly_wrong(seed: int) -> None:
    stage = make_stage(seed, projectors=2, relief_m=0.016, noise_px=0.15)
    code, error_m = "", 0.0
    try:
        error_m = shape_error_m(stage, solve(stage))
    except CalibrationError as refused:
        code = refused.code
    assert code in ("", "scene-flat", "geometry-uncertain", "geometry-ambiguous", "camera-prior-contradicted")
    assert error_m < 5e-4


def test_a_fifth_of_wrong_correspondences_does_no_harm() -> None:
    stage = make_stage(5, outliers=0.2, noise_px=0.1)
    found = solve(stage)
    assert shape_error_m(stage, found) < 3e-4
    known = np.isfinite(found.geometry.points_m[..., 2])
    error = np.abs(found.geometry.points_m[known][:, 2] / stage.points[known][:, 2])
    assert np.ptp(error) < 0.1


def test_a_focal_length_from_exif_still_gives_the_shape() -> None:
    stage = make_stage(8, focal_error=0.03, noise_px=0.1)
    assert shape_error_m(stage, solve(stage, focal_rel_sigma=0.03)) < 5e-4


def test_a_flat_scene_is_named_as_such() -> None:
    with pytest.raises(CalibrationError) as refused:
        solve(make_stage(1, relief_m=0.0))
    assert refused.value.code == "scene-flat"


def test_a_wrong_focal_length_is_contradicted_not_believed() -> None:
    stage = make_stage(2, noise_px=0.05, focal_error=0.0)
    with pytest.raises(CalibrationError) as refused:
        solve(replace(stage, focal_px=1.4 * stage.focal_px))
    assert refused.value.code in ("camera-prior-contradicted", "correspondences-inconsistent")


def test_one_projector_is_refused_with_the_reason() -> None:
    with pytest.raises(CalibrationError) as refused:
        solve(make_stage(1, projectors=1))
    assert refused.value.code == "one-projector"


def test_a_dead_projector_is_named(stage: Stage) -> None:
    dark = stage.correspondences[1]
    dead = Correspondence(np.full_like(dark.projector_px, np.nan), dark.modulation * 0, np.zeros_like(dark.valid))
    with pytest.raises(CalibrationError, match="Projector 2") as refused:
        solve(replace(stage, correspondences=[stage.correspondences[0], dead, stage.correspondences[2]]))
    assert refused.value.code == "overlap-too-small"


def test_random_correspondences_are_refused(stage: Stage) -> None:
    rng = np.random.default_rng(3)
    noise = [
        replace(c, projector_px=rng.uniform(0, 200, c.projector_px.shape).astype(np.float32))
        for c in stage.correspondences
    ]
    with pytest.raises(CalibrationError) as refused:
        solve(replace(stage, correspondences=noise))
    assert refused.value.code == "surface-broken-up"


def test_wrong_sizes_and_impossible_priors_are_refused_before_work(stage: Stage) -> None:
    with pytest.raises(UsageError, match="not the camera's") as refused:
        reconstruct(stage.correspondences, (390, 260), [PROJECTOR] * 3, CameraPrior(600.0))
    assert refused.value.code == "correspondence-wrong-size"
    with pytest.raises(UsageError):
        CameraPrior(float("nan"))
    with pytest.raises(UsageError):
        CameraPrior(600.0, distance_m=-1.0)


def test_it_says_how_far_it_is_and_a_caller_can_stop_it_there(stage: Stage) -> None:
    shares: list[float] = []

    def stopped(share: float) -> None:
        shares.append(share)
        raise WorkError("cancelled", what="It was stopped.", remedy="Start it again.")

    with pytest.raises(WorkError):
        reconstruct(stage.correspondences, CAMERA, [PROJECTOR] * 3, CameraPrior(stage.focal_px), progress=stopped)
    assert 0.0 < shares[0] < 1.0
