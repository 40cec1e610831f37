"""A painted sheet on a mesh: its lines lie where another program's rays find them, and its edges do not alias."""

from __future__ import annotations

import functools
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh

from controller.core.arrays import Float64, FloatImage, Mask
from controller.optics.calibrate.mesh_alignment import Pose, SolidMesh
from controller.optics.calibrate.values import Pinhole
from controller.optics.solve.targets.sheets import mesh_places, photographed, texture

WIDTH, HEIGHT = 320, 240
CAMERA = Pinhole(
    np.array([[460.0, 0, 163.0], [0, 462.0, 118.0], [0, 0, 1]]),
    np.array([-0.08, 0.02]),
    np.eye(3),
    np.zeros(3),
    (WIDTH, HEIGHT),
)
POSE = Pose(0.002, cv2.Rodrigues(np.array([0.4, -0.5, 0.3]))[0].astype(np.float64), np.array([0.02, -0.01, 0.9]))


def jar() -> tuple[SolidMesh, FloatImage]:
    """A jar without a lid, 200 of its units high, unrolled on its sheet: u around it with a seam, v up."""
    turns, heights = 96, 40
    angle, height = np.meshgrid(np.linspace(0, 2 * np.pi, turns + 1), np.linspace(0, 1, heights + 1))
    radius = 60 + 25 * np.sin(3 * height) + 6 * np.cos(2 * angle)
    points = np.stack([radius * np.cos(angle), 200 * (height - 0.5), radius * np.sin(angle)], axis=2).reshape(-1, 3)
    places = np.stack([angle / (2 * np.pi), height], axis=2).reshape(-1, 2).astype(np.float32)
    at = np.arange(points.shape[0]).reshape(heights + 1, turns + 1)
    a, b, c, d = at[:-1, :-1], at[:-1, 1:], at[1:, :-1], at[1:, 1:]
    faces = np.concatenate([np.stack(three, axis=2).reshape(-1, 3) for three in ((a, c, b), (b, c, d))]).astype(
        np.int32
    )
    return SolidMesh(points, faces), places[faces]


MESH, UV = jar()


@functools.cache
def object_mask() -> Mask:
    """(rows, columns): the jar, by the oracle."""
    return oracle(pixels())[1].reshape(HEIGHT, WIDTH)


def oracle(px: Float64) -> tuple[Float64, Mask]:
    """The places (N, 2) on the sheet of camera pixels (N, 2), by OpenCV's lens and trimesh's rays; where it is met."""
    flat = cv2.undistortPointsIter(
        px[:, None], CAMERA.matrix, CAMERA.distortion, np.eye(3), np.eye(3),
        (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 60, 1e-12),
    )[:, 0]  # fmt: skip
    other = trimesh.Trimesh(POSE.placed(MESH.vertices), MESH.faces, process=False)
    rays = np.column_stack([flat, np.ones(len(px))])
    at, ray, face = other.ray.intersects_location(np.zeros_like(rays), rays, multiple_hits=False)
    barycentric: Any = trimesh.triangles.points_to_barycentric
    share = barycentric(other.triangles[face], at)
    places = np.full((len(px), 2), np.nan)
    places[ray] = np.einsum("nc,nck->nk", share, UV[face])
    return places, np.isfinite(places[:, 0])


def pixels() -> Float64:
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH]
    return np.stack([x.ravel(), y.ravel()], axis=1).astype(np.float64)


def sheet_of(colour: FloatImage, alpha: float = 1.0) -> FloatImage:
    return np.dstack([colour, np.full(colour.shape[:2], alpha, np.float32)])


def test_each_pixel_finds_its_place_and_how_it_changes() -> None:
    at, steps = mesh_places(MESH, UV, POSE, CAMERA)(pixels())
    wanted, met = oracle(pixels())
    assert met.sum() > 10_000
    both = met & np.isfinite(at[:, 0])
    assert both.sum() > 0.998 * met.sum()
    np.testing.assert_allclose(at[both], wanted[both], atol=2e-4)
    right, on = oracle(pixels() + np.array([0.25, 0]))
    smooth = both & on & (np.abs(right - wanted).max(axis=1) < 0.02)
    assert np.median(np.abs((right - wanted)[smooth] - 0.25 * steps[smooth, 0])) < 1e-4


def test_lines_on_the_sheet_lie_where_they_belong() -> None:
    """Within 0.5 camera pixels; each line's middle by the weight of its darkness."""
    side, lines = 1024, 16
    across = (np.arange(side) + 0.5) / side
    dark = np.abs((across * lines + 0.5) % 1 - 0.5) < 0.06
    colour = np.where(dark[None, :, None], 0, 1) * np.ones((side, 1, 3))
    wanted, met = oracle(pixels())
    mask = met.reshape(HEIGHT, WIDTH)
    image = texture(
        sheet_of(colour.astype(np.float32)),
        mesh_places(MESH, UV, POSE, CAMERA),
        np.zeros((*mask.shape, 3), np.float32),
        mask,
    ).image
    u = wanted[:, 0].reshape(mask.shape) * lines
    off = []
    for row in range(60, 180, 3):
        inside = np.flatnonzero(mask[row])[6:-6]
        for x in inside[:-1]:
            near = slice(x - 4, x + 6)
            step = np.diff(u[row, near])
            if (
                np.isfinite(step).all()
                and (np.abs(step) < 0.08).all()
                and np.floor(u[row, x]) != np.floor(u[row, x + 1])
            ):
                line = x + (np.round(u[row, x]) - u[row, x]) / (u[row, x + 1] - u[row, x])
                weight = 1 - image[row, near, 0]
                off.append(float(weight @ np.arange(x - 4, x + 6) / weight.sum() - line))
    assert len(off) > 100
    assert np.abs(off).max() < 0.5
    assert abs(np.median(off)) < 0.05


def test_a_sheet_far_finer_than_the_picture_gives_its_mean() -> None:
    rng = np.random.default_rng(1)
    colour = rng.choice(np.array([0.0, 1.0], np.float32), (2048, 2048, 1)).repeat(3, axis=2)
    mask = object_mask()
    image = texture(
        sheet_of(colour), mesh_places(MESH, UV, POSE, CAMERA), np.zeros((*mask.shape, 3), np.float32), mask
    ).image
    assert image[mask].std() < 0.09
    assert image[mask].mean() == pytest.approx(0.5, abs=0.01)


def test_where_the_sheet_is_transparent_the_object_stays_as_it_is() -> None:
    colour = np.full((64, 64, 3), 0.8, np.float32)
    own = np.random.default_rng(2).uniform(0.2, 0.6, (HEIGHT, WIDTH, 3)).astype(np.float32)
    mask = np.ones((HEIGHT, WIDTH), np.bool_)
    places = mesh_places(MESH, UV, POSE, CAMERA)
    clear = texture(sheet_of(colour, 0.0), places, own, mask).image
    np.testing.assert_array_equal(clear, own)
    half = texture(sheet_of(colour, 0.25), places, own, mask).image
    beside = ~cv2.dilate(object_mask().astype(np.uint8), np.ones((9, 9), np.uint8)).astype(bool)
    np.testing.assert_array_equal(half[beside], own[beside])
    inside = cv2.erode(object_mask().astype(np.uint8), np.ones((9, 9), np.uint8)).astype(bool)
    np.testing.assert_allclose(half[inside], 0.25 * 0.8 + 0.75 * own[inside], atol=1e-5)


def test_an_exported_sheet_brings_the_object_back_as_it_was() -> None:
    """Unfolded and laid on again; the sheet's seam and the jar's far side are in the way."""
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH].astype(np.float32)
    picture = np.stack([0.5 + 0.4 * np.sin(x / 9), 0.5 + 0.4 * np.cos(y / 11), 0.3 + 0.0 * x], axis=2).astype(
        np.float32
    )
    met = object_mask()
    places = mesh_places(MESH, UV, POSE, CAMERA)
    sheet = photographed(picture, places, met, 512)
    assert 0.2 < sheet[..., 3].mean() < 0.7, "the far side is clear"
    image = texture(sheet, places, picture, met).image
    inside = cv2.erode(met.astype(np.uint8), np.ones((7, 7), np.uint8)).astype(bool)
    assert np.abs(image - picture)[inside].mean() < 0.01
    assert np.percentile(np.abs(image - picture)[inside], 99) < 0.06


def test_without_a_mesh_the_sheet_is_the_camera_s_picture() -> None:
    picture = np.random.default_rng(3).uniform(0, 1, (HEIGHT, WIDTH, 3)).astype(np.float32)
    smooth = np.asarray(cv2.GaussianBlur(picture, (0, 0), 4), np.float32)
    mask = np.ones((HEIGHT, WIDTH), np.bool_)
    image = texture(sheet_of(smooth), None, np.zeros_like(picture), mask).image
    np.testing.assert_allclose(image[4:-4, 4:-4], smooth[4:-4, 4:-4], atol=0.006)
