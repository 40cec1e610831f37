"""Which shape a calibration gives, on stages made here: planes, corners, curved objects and several of them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from controller.core.errors import CalibrationError
from controller.optics.calibrate.geometry.shape import AskedShape, FoundShape, find_shape, shape_sentence
from controller.optics.calibrate.geometry.values import CameraPrior, MeasuredDistance
from controller.optics.calibrate.metapixels.from_dots import project
from controller.optics.calibrate.values import Correspondence

Array = npt.NDArray[np.float64]
CAMERA, PROJECTOR = (160, 120), (280, 210)
FOCAL_PX = 240.0
PLACES_DEG = ((-27.0, 6.0), (29.0, 9.0), (3.0, 26.0))
REACH_M = 1.2


def rays() -> Array:
    column, row = np.meshgrid(np.arange(CAMERA[0]), np.arange(CAMERA[1]))
    x, y = (column - (CAMERA[0] - 1) / 2) / FOCAL_PX, (row - (CAMERA[1] - 1) / 2) / FOCAL_PX
    return np.stack([x, y, np.ones_like(x)], axis=2)


def panel(tilt_deg: tuple[float, float] = (0.0, 0.0), at_m: tuple[float, float, float] = (0, 0, 1)) -> Array:
    """(rows, columns) inverse depths of an endless plane through a point, turned about x and y."""
    a, b = np.deg2rad(tilt_deg)
    normal = np.array([np.sin(b), np.cos(b) * np.sin(a), -np.cos(b) * np.cos(a)])
    return np.asarray(rays() @ normal / (normal @ np.array(at_m)))


def stage_of(points: Array, lit: list[npt.NDArray[np.bool_]], noise_px: float = 0.05) -> list[Correspondence]:
    """What the camera sees of each projector on the points (rows, columns, 3), NaN where nothing is."""
    rng, found = np.random.default_rng(5), []
    target = np.nanmedian(points.reshape(-1, 3), axis=0)
    width, height = PROJECTOR
    for (right, above), own in zip(PLACES_DEG, lit, strict=False):
        a, b = np.deg2rad([right, above])
        centre = target + REACH_M * np.array([np.sin(a) * np.cos(b), -np.sin(b), -np.cos(a) * np.cos(b)])
        z = (target - centre) / np.linalg.norm(target - centre)
        x = np.cross([0.0, 1.0, 0.0], z) / np.linalg.norm(np.cross([0.0, 1.0, 0.0], z))
        local = (points - centre) @ np.stack([x, np.cross(z, x), z]).T
        px = 1.9 * width * local[..., :2] / local[..., 2:] + (0.5 * width, 0.5 * height)
        px += rng.normal(0, noise_px, px.shape)
        valid = own & np.isfinite(px).all(axis=2) & (px > 0).all(axis=2) & (px < np.array(PROJECTOR) - 1).all(axis=2)
        px[~valid] = np.nan
        found.append(Correspondence(px.astype(np.float32), valid.astype(np.float32), valid))
    return found


def points_of(*inverse_depths: Array) -> Array:
    return np.asarray(rays() / np.max(inverse_depths, axis=0)[..., None])


def everywhere(count: int) -> list[npt.NDArray[np.bool_]]:
    return [np.ones(CAMERA[::-1], np.bool_)] * count


def shape_of(
    stage: list[Correspondence], asked: AskedShape = "auto", distances: tuple[MeasuredDistance, ...] = ()
) -> FoundShape:
    prior = CameraPrior(FOCAL_PX, 0.002, distances=distances)
    return find_shape(asked, stage, CAMERA, [PROJECTOR] * len(stage), prior)


def halves() -> list[npt.NDArray[np.bool_]]:
    left = np.arange(CAMERA[0]) < CAMERA[0] // 2
    return [np.broadcast_to(side, CAMERA[::-1]) for side in (left, ~left)]


def ball(radius_m: float, at_m: tuple[float, float, float]) -> Array:
    """(rows, columns) inverse depths of a ball, 0 beside it."""
    along = rays() @ np.array(at_m)
    square = np.sum(rays() ** 2, axis=2)
    root = along**2 - square * (np.dot(at_m, at_m) - radius_m**2)
    return np.where(root > 0, square / (along - np.sqrt(np.maximum(root, 0))), 0.0)


def seen(inverse: Array) -> Array:
    with np.errstate(divide="ignore"):
        return np.asarray(np.where(inverse > 0, 1 / inverse, np.nan)[..., None] * rays())


def tube(radius_m: float) -> Array:
    square = rays()[..., 0] ** 2 + 1
    root = 1 - square * (1 - radius_m**2)
    return np.where((root > 0) & (np.abs(rays()[..., 1]) < 0.2), square / (1 - np.sqrt(np.maximum(root, 0))), 0.0)


def relief() -> Array:
    """5 mm deep."""
    x, y, _ = np.moveaxis(rays(), 2, 0)
    return np.asarray(panel((5, 12)) / (1 + 0.0025 * np.sin(40 * x) * np.sin(40 * y)))


def corner() -> Array:
    return np.maximum(panel((0, 35)), panel((0, -35)))


OBJECTS: dict[str, tuple[Callable[[], Array], int, str]] = {
    "painting before one projector": (lambda: panel((5, 12)), 1, "plane"),
    "relief before one projector": (relief, 1, "plane"),
    "corner before one projector": (corner, 1, "plane"),
    "ball before one projector": (lambda: ball(0.11, (0, 0, 1)), 1, "unknown"),
    "vase before one projector": (lambda: tube(0.09), 1, "unknown"),
    "two objects before one projector": (
        lambda: np.maximum(ball(0.06, (-0.12, 0, 1)), ball(0.06, (0.12, 0, 1.1))), 1, "unknown",
    ),
    "relief": (relief, 2, "plane"),
}  # fmt: skip
CURVED: dict[str, Callable[[], Array]] = {
    "corner": corner,
    "cylinder": lambda: tube(0.09),
    "sphere": lambda: ball(0.11, (0, 0, 1)),
    "two objects": lambda: np.maximum(ball(0.06, (-0.12, 0, 1)), ball(0.06, (0.12, 0, 1.1))),
}


@pytest.mark.parametrize("name", OBJECTS)
def test_the_shape_is_the_most_that_the_projectors_can_show(name: str) -> None:
    inverse, projectors, shape = OBJECTS[name]
    assert shape_of(stage_of(seen(inverse()), everywhere(projectors))).shape == shape


@pytest.mark.slow
@pytest.mark.parametrize("name", CURVED)
def test_two_projectors_measure_the_surface_of_everything_that_is_not_flat(name: str) -> None:
    points = seen(CURVED[name]())
    found = shape_of(stage_of(points, everywhere(2)))
    assert found.shape == "surface"
    assert found.reconstruction is not None
    ours = found.reconstruction.geometry.points_m
    known = np.isfinite(ours[..., 2]) & np.isfinite(points[..., 2])
    ratio = np.linalg.norm(ours[known], axis=1) / np.linalg.norm(points[known], axis=1)
    assert np.std(ratio) / np.mean(ratio) < 2e-3


@pytest.mark.parametrize(
    ("lit", "code"),
    [(everywhere(1), "one-projector"), (everywhere(2), "scene-flat"), (halves(), "overlap-too-small")],
)
def test_a_flat_stage_is_refused_only_where_a_surface_is_asked_for(lit: list[npt.NDArray[np.bool_]], code: str) -> None:
    stage = stage_of(points_of(panel((8, -6))), lit)
    found = shape_of(stage)
    assert found.why is not None
    assert (found.shape, found.why.code) == ("plane", code)
    with pytest.raises(CalibrationError) as refused:
        shape_of(stage, "surface")
    assert refused.value.code == code
    assert shape_of(stage, "unknown") == FoundShape("unknown", CAMERA)


def test_a_curved_object_is_no_plane() -> None:
    with pytest.raises(CalibrationError) as refused:
        shape_of(stage_of(seen(ball(0.11, (0, 0, 1))), everywhere(2)), "plane")
    assert refused.value.code == "not-flat"


def sides(points: Array) -> tuple[MeasuredDistance, ...]:
    """The four sides of a rectangle in the picture, as a ruler shows them."""
    corners = [(35, 25), (125, 25), (125, 95), (35, 95)]
    pairs = [(corners[n], corners[(n + 1) % 4]) for n in range(4)]
    return tuple(
        MeasuredDistance(a, b, float(np.linalg.norm(points[a[1], a[0]] - points[b[1], b[0]])), 0.0001) for a, b in pairs
    )


@pytest.mark.parametrize("tilt_deg", [(8, -6), (20, 15), (5, -25)])
@pytest.mark.parametrize("projectors", [1, 2])
def test_a_plane_with_measured_sides_is_metric_and_turned_right(tilt_deg: tuple[float, float], projectors: int) -> None:
    """Judged by the truth, and by the homographies and poses of a flat target that OpenCV and COLMAP find."""
    pycolmap: Any = pytest.importorskip("pycolmap")
    points = points_of(panel(tilt_deg))
    stage = stage_of(points, everywhere(projectors))
    found = shape_of(stage, "plane", sides(points)).reconstruction
    assert found is not None
    geometry = found.geometry
    known = np.isfinite(geometry.points_m[..., 2])
    assert known[np.any([one.valid for one in stage], axis=0)].mean() > 0.99
    assert np.abs(np.linalg.norm(geometry.points_m - points, axis=2)[known]).max() < 0.004
    across = np.cross(np.gradient(points, axis=0), np.gradient(points, axis=1))[known]
    cosine = np.sum(across / np.linalg.norm(across, axis=1, keepdims=True) * geometry.normals[known], axis=1)
    assert np.degrees(np.arccos(min(1.0, cosine.min()))) < 0.5
    for own, one in zip(geometry.projectors, stage, strict=True):
        target, px = geometry.points_m[one.valid & known], one.projector_px[one.valid & known]
        column, row = np.meshgrid(np.arange(CAMERA[0]), np.arange(CAMERA[1]))
        camera_px = np.stack([column, row], axis=2)[one.valid & known].astype(np.float64)
        matrix, _ = cv2.findHomography(camera_px, px.astype(np.float64))
        straight = cv2.perspectiveTransform(camera_px[:, None], matrix)[:, 0]
        _, turn, shift = cv2.solvePnP(target, px, own.matrix, np.array([own.distortion[0], 0, 0, 0, 0]))
        assert np.degrees(np.linalg.norm(cv2.Rodrigues(cv2.Rodrigues(turn)[0] @ own.rotation.T)[0])) < 0.3
        assert np.linalg.norm(shift.ravel() - own.translation_m) < 0.01
        ours, _ = project(own, target.astype(np.float64))
        assert np.sqrt(np.mean(np.sum((ours - straight) ** 2, axis=1))) < 0.05
        some = np.s_[:: max(1, len(px) // 300)]
        again = pycolmap.estimate_homography_matrix(camera_px[some], px[some].astype(np.float64))["H"]
        theirs = cv2.perspectiveTransform(camera_px[:, None], again)[:, 0]
        assert np.sqrt(np.mean(np.sum((ours - theirs) ** 2, axis=1))) < 0.2
        lens = [*own.matrix[[0, 1, 0, 1], [0, 1, 2, 2]], own.distortion[0], 0, 0, 0]
        camera = pycolmap.Camera(model="OPENCV", width=PROJECTOR[0], height=PROJECTOR[1], params=lens)
        placed = pycolmap.estimate_and_refine_absolute_pose(px[some].astype(np.float64), target[some], camera)
        pose = placed["cam_from_world"].matrix()
        assert np.degrees(np.linalg.norm(cv2.Rodrigues(pose[:, :3] @ own.rotation.T)[0])) < 0.5
        assert np.linalg.norm(pose[:, 3] - own.translation_m) < 0.015


@settings(max_examples=3)
@given(
    tilt_deg=st.tuples(st.floats(-30, 30), st.floats(-30, 30)),
    left_top=st.tuples(st.integers(0, 33), st.integers(0, 23)),
    right_bottom=st.tuples(st.integers(127, 160), st.integers(97, 120)),
)
def test_any_plane_lies_as_its_sides_were_measured(
    tilt_deg: tuple[float, float], left_top: tuple[int, int], right_bottom: tuple[int, int]
) -> None:
    """Where a projector lights it; how far away it is only changes the unit."""
    points, some = points_of(panel(tilt_deg)), np.zeros(CAMERA[::-1], np.bool_)
    some[left_top[1] : right_bottom[1], left_top[0] : right_bottom[0]] = True
    (one,) = stage = stage_of(points, [some])
    found = shape_of(stage, "plane", sides(points)).reconstruction
    assert found is not None
    normals, lit = found.geometry.normals, one.valid
    known = np.isfinite(found.geometry.points_m[..., 2])
    assert known[lit].mean() > 0.99
    assert not known[~lit].any()
    assert (np.sum(normals[known] * points[known], axis=1) < 0).all(), "it faces the camera"
    np.testing.assert_allclose(normals[known], np.broadcast_to(normals[known][0], (known.sum(), 3)), atol=1e-5)
    np.testing.assert_allclose(found.geometry.points_m[known], points[known], atol=1e-4)
    assert np.median(found.sigma_m[known]) < 0.002


def test_a_plane_says_how_little_is_certain_without_measured_sides() -> None:
    found = shape_of(stage_of(points_of(panel((5, 12))), everywhere(1)), "plane")
    assert found.reconstruction is not None
    assert 0.01 < found.reconstruction.shape_rel_sigma < 0.1
    assert "four measured sides" in shape_sentence(found)
