"""Stages on which a geometry can go wrong: each is right or refused with its reason, never quietly wrong."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from controller.core.errors import CalibrationError, UsageError
from controller.optics.calibrate.geometry.self_calibration import reconstruct
from controller.optics.calibrate.geometry.values import CameraPrior, MeasuredDistance, metres_per_unit
from controller.optics.calibrate.values import Correspondence

pytestmark = pytest.mark.slow

Array = npt.NDArray[np.float64]
CAMERA, PROJECTOR, FOCAL = (330, 220), (280, 210), 540.0
PLACES = ((-0.55, -0.1, 0.05), (0.55, -0.05, 0.0), (0.05, -0.55, 0.05))


def scene(
    *, relief_m: float = 0.06, noise_px: float = 0.05, projectors: int = 3, seed: int = 0, near: float = 1.0
) -> tuple[list[Correspondence], Array]:
    """What the camera's pixels see of projectors with lens shift; and the true points (rows, columns, 3).

    ``near``: of the projectors' distances from the camera; small ones give little parallax.
    """
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid((np.arange(CAMERA[0]) - 164.5) / FOCAL, (np.arange(CAMERA[1]) - 109.5) / FOCAL)
    bumps = np.sin(17 * x + 1) * np.cos(21 * y) + 4.0 * (x**2 + y**2) + 0.4 * np.sin(39 * y - 2 * x)
    depth = 1.0 + 0.08 * y + relief_m * bumps
    points = np.stack([x, y, np.ones_like(x)], axis=2) * depth[..., None]
    found = []
    for place in PLACES[:projectors]:
        centre = near * np.array(place)
        forward = np.array([0.0, 0.0, 1.03]) - centre
        forward /= np.linalg.norm(forward)
        right = np.cross([0.0, 1.0, 0.0], forward)
        right /= np.linalg.norm(right)
        down = np.cross(forward, right)
        focal, shift = rng.uniform(1.5, 1.8) * PROJECTOR[0], 1.05 * PROJECTOR[1]
        # the optical axis points below the picture, so the device is tilted up to fill it
        tilt = np.arctan((shift - PROJECTOR[1] / 2) / focal)
        turn = np.array([[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]])
        local = (points - centre) @ (turn @ np.stack([right, down, forward])).T
        px = focal * local[..., :2] / local[..., 2:] + ((PROJECTOR[0] - 1) / 2, shift)
        px = px + rng.normal(0, noise_px, px.shape)
        valid = np.all((px > 0) & (px < np.array(PROJECTOR) - 1), axis=2)
        px[~valid] = np.nan
        found.append(Correspondence(px.astype(np.float32), valid.astype(np.float32), valid))
    return found, points


def solved(found: list[Correspondence], prior: CameraPrior) -> Array:
    result = reconstruct(found, CAMERA, [PROJECTOR] * len(found), prior)
    return np.asarray(result.geometry.points_m, dtype=np.float64)


def shape_error(points: Array, true: Array) -> float:
    """Rms distance over the object's own distance, scale and pose apart."""
    known = np.isfinite(points[..., 2])
    a, b = points[known], true[known]
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    u, s, vt = np.linalg.svd(b.T @ a)
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    scale = np.sum(s * np.diag(flip)) / np.sum(a * a)
    return float(np.sqrt(np.mean(np.sum((scale * a @ (u @ flip @ vt).T - b) ** 2, axis=1))))


def outcome(found: list[Correspondence], true: Array, prior: CameraPrior) -> tuple[str, float]:
    """("", shape error), or (why it was refused, 0)."""
    try:
        return "", shape_error(solved(found, prior), true)
    except CalibrationError as refused:
        return refused.code, 0.0


BOARD = CameraPrior(FOCAL, 0.001, (164.5, 109.5), 1.0, distortion_sigma=0.005)
ROUGH = CameraPrior(FOCAL, 0.03)
REFUSALS = ("scene-flat", "geometry-uncertain", "geometry-ambiguous", "camera-prior-contradicted")


def test_with_a_measured_lens_three_projectors_give_the_shape() -> None:
    code, error = outcome(*scene(), BOARD)
    assert (code, error < 3e-4) == ("", True)


@pytest.mark.parametrize("prior", [BOARD, ROUGH], ids=["board", "exif"])
@pytest.mark.parametrize("relief_m", [0.0, 0.0005])
def test_a_flat_scene_is_named_as_flat(relief_m: float, prior: CameraPrior) -> None:
    assert outcome(*scene(relief_m=relief_m), prior)[0] == "scene-flat"


def test_too_little_overlap_is_named_with_the_projector() -> None:
    found, _ = scene()
    halves = [np.arange(CAMERA[0]) < 110, np.arange(CAMERA[0]) > 220, np.arange(CAMERA[0]) < 110]
    parted = []
    for own, half in zip(found, halves, strict=True):
        valid = own.valid & half
        parted.append(Correspondence(np.where(valid[..., None], own.projector_px, np.nan), own.modulation, valid))
    with pytest.raises(CalibrationError, match="Projector 2") as refused:
        solved(parted, BOARD)
    assert refused.value.code == "overlap-too-small"


@pytest.mark.parametrize("prior", [BOARD, ROUGH], ids=["board", "exif"])
def test_one_projector_is_refused_whatever_the_prior(prior: CameraPrior) -> None:
    found, true = scene(projectors=1)
    assert outcome(found, true, prior)[0] == "one-projector"


@pytest.mark.parametrize("seed", range(2))
def test_two_projectors_with_a_measured_lens_are_enough(seed: int) -> None:
    code, error = outcome(*scene(projectors=2, seed=seed), BOARD)
    assert (code, error < 5e-4) == ("", True)


@pytest.mark.parametrize(
    ("near", "relief_m", "projectors"), [(0.15, 0.004, 2), (0.15, 0.012, 3), (0.4, 0.004, 3), (0.4, 0.012, 2)]
)
def test_little_depth_and_parallax_is_never_reversed_quietly(near: float, relief_m: float, projectors: int) -> None:
    found, true = scene(relief_m=relief_m, near=near, projectors=projectors, seed=4)
    code, error = outcome(found, true, ROUGH)
    assert code in ("", *REFUSALS)
    # a reversed relief would be off by its own height
    assert error < max(0.25 * relief_m, 5e-4)


@pytest.mark.parametrize(("factor", "sigma"), [(0.9, 0.001), (1.1, 0.01)])
def test_a_focal_length_that_is_ten_percent_off_is_contradicted(factor: float, sigma: float) -> None:
    found, _ = scene(seed=2)
    with pytest.raises(CalibrationError) as refused:
        solved(found, CameraPrior(factor * FOCAL, sigma, (164.5, 109.5), 1.0, distortion_sigma=0.005))
    assert refused.value.code in ("camera-prior-contradicted", "correspondences-inconsistent")


def test_a_lens_measured_at_another_picture_size_is_refused() -> None:
    found, _ = scene(projectors=2)
    with pytest.raises(UsageError) as refused:
        solved(found, CameraPrior(FOCAL, 0.001, size_px=(660, 440)))
    assert refused.value.code == "camera-intrinsics-wrong-size"


def plane() -> npt.NDArray[np.float32]:
    x, y = np.meshgrid((np.arange(40) - 20) / 100, (np.arange(30) - 15) / 100)
    return np.stack([x, y, np.ones_like(x)], axis=2).astype(np.float32)


def test_a_distance_between_two_points_of_the_picture_sets_the_scale() -> None:
    unit_m, sigma = metres_per_unit(plane(), None, 0.01, [MeasuredDistance((10, 15), (30, 15), 0.5, 0.001)])
    assert unit_m == pytest.approx(2.5, rel=1e-5)
    assert sigma == pytest.approx(0.002)


def test_the_surer_distance_counts_more() -> None:
    unit_m, sigma = metres_per_unit(plane(), 1.01, 0.01, [MeasuredDistance((10, 15), (30, 15), 0.2, 0.0002)])
    assert unit_m == pytest.approx(1.0001, abs=2e-4)
    assert sigma < 0.001


def test_contradicting_distances_are_refused_with_the_one_that_is_off() -> None:
    distances = [MeasuredDistance((10, 15), (30, 15), apart) for apart in (0.2, 0.2005)]
    with pytest.raises(CalibrationError, match=r"distance_m of the camera") as refused:
        metres_per_unit(plane(), 1.5, 0.01, distances)
    assert refused.value.code == "distances-contradict"


@pytest.mark.parametrize("px", [(3.0, 3.0), (80.0, 3.0)])
def test_a_distance_to_where_nothing_is_known_is_refused(px: tuple[float, float]) -> None:
    points = plane()
    points[:8, :8] = np.nan
    with pytest.raises(CalibrationError) as refused:
        metres_per_unit(points, None, 0.01, [MeasuredDistance(px, (30, 15), 0.2)])
    assert refused.value.code == "distance-point-unknown"
    with pytest.raises(UsageError):
        MeasuredDistance((1, 1), (2, 2), -1.0)


@pytest.mark.parametrize("factor", [0.1, 0.2])
def test_a_focal_length_that_is_far_too_short_is_blamed_and_not_the_depth(factor: float) -> None:
    found, _ = scene(seed=2)
    with pytest.raises(CalibrationError) as refused:
        solved(found, CameraPrior(factor * FOCAL, 0.005, (164.5, 109.5), 1.0, distortion_sigma=0.005))
    assert refused.value.code == "camera-prior-contradicted"
    assert "focal_length_px" in refused.value.remedy
    assert "depth" not in refused.value.remedy


def lace(own: Correspondence, rng: np.random.Generator) -> Correspondence:
    """Threads two camera pixels wide with holes between them, half of whose pixels see two surfaces at once."""
    rows, columns = own.valid.shape
    holes = (np.arange(rows)[:, None] // 2 % 2 == 1) & (np.arange(columns)[None] // 2 % 2 == 1)
    px, valid = own.projector_px.copy(), own.valid & ~holes
    mixed = rng.random(own.valid.shape) < 0.6
    px[mixed] = rng.uniform(0, 200, (int(mixed.sum()), 2))
    px[~valid] = np.nan
    return Correspondence(px.astype(np.float32), valid.astype(np.float32), valid)


def moved_between(own: Correspondence) -> Correspondence:
    """Rows that were photographed after the object had moved, beside columns from before."""
    px = own.projector_px.copy()
    later = np.roll(px, (9, 7), axis=(0, 1))
    px[..., 1] = later[..., 1] + 20 * np.sin(later[..., 0] / 9)
    return Correspondence(px, own.modulation, own.valid)


def test_lace_is_told_from_something_that_moved() -> None:
    found, _ = scene(seed=2)
    prior = CameraPrior(FOCAL, 0.01, (164.5, 109.5), 1.0, distortion_sigma=0.005)
    rng = np.random.default_rng(1)
    with pytest.raises(CalibrationError) as refused:
        solved([lace(one, rng) for one in found], prior)
    assert refused.value.code == "surface-broken-up"
    assert "moved" not in refused.value.remedy
    with pytest.raises(CalibrationError) as refused:
        solved([moved_between(one) for one in found], prior)
    assert refused.value.code == "correspondences-inconsistent"
