"""Light, resolution and focus of a placed projector, against closed forms, OpenCV and SciPy."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize_scalar

from controller.core.arrays import Float64, Mask
from controller.optics.plan.optics import FWHM, best_focus, blur, lit_by
from controller.optics.plan.search import aimed
from controller.optics.plan.target_object import TargetObject, sampled
from controller.optics.plan.values import MountingPoint, Placement, ProjectorModel, Surface
from tests.controller.optics.plan.conftest import EYE

FACING = Placement(
    ProjectorModel("plain", (400, 300), 600.0, (1.0, 3.0), (0.0, 0.0), 0.02, 0.35),
    MountingPoint("here", (0.0, 0.0, -2.0)), np.eye(3), 800.0, (199.5, 149.5), 2.0,
)  # fmt: skip
"""Two metres before the origin, looking at it."""


class Nothing:
    """No shadows."""

    def hidden(self, from_m: Float64, points_m: Float64) -> Mask:
        return np.zeros(len(points_m), bool)


def wall(*, steps: int = 81, half_m: float = 0.6, tilt_degrees: float = 0.0, depth_m: float = 0.0) -> Surface:
    """A square wall through the axis, turned about the vertical, facing the projector."""
    line = np.linspace(-half_m, half_m, steps)
    x, y = (part.ravel() for part in np.meshgrid(line, line))
    tilt = np.deg2rad(tilt_degrees)
    points = np.stack((x * np.cos(tilt), y, x * np.sin(tilt) + depth_m), axis=1)
    normal = np.array([np.sin(tilt), 0.0, -np.cos(tilt)])
    return Surface(points, np.tile(normal, (len(points), 1)), np.full(len(points), (line[1] - line[0]) ** 2))


@pytest.mark.parametrize("tilt", [0.0, 35.0])
def test_all_of_the_light_arrives_on_a_wall_that_holds_the_whole_picture(tilt: float) -> None:
    surface = wall(steps=401, half_m=1.2, tilt_degrees=tilt)
    assert lit_by(FACING, surface, Nothing()).lux @ surface.area_m2 == pytest.approx(600.0, rel=0.01)


def test_a_wall_that_faces_the_lens_has_square_pixels_of_depth_by_focal_length() -> None:
    lit = lit_by(FACING, wall(), Nothing())
    middle = np.argmin(np.linalg.norm(wall().points_m, axis=1))
    np.testing.assert_allclose(lit.pixel_mm[middle], 1e3 * 2.0 / 800.0)
    assert lit.lux[middle] == pytest.approx(600.0 / (400 * 300) * (800.0 / 2.0) ** 2)
    assert lit.detail_mm[middle] == pytest.approx(2.5 * FWHM * np.sqrt(1 / 12 + 0.35**2))
    assert lit.cosine[middle] == pytest.approx(1.0)


def test_turned_by_sixty_degrees_a_wall_gets_half_the_light_in_pixels_twice_as_long() -> None:
    straight, turned = (
        lit_by(FACING, Surface(np.zeros((1, 3)), np.array([[np.sin(t), 0.0, -np.cos(t)]]), np.ones(1)), Nothing())
        for t in (0.0, np.pi / 3)
    )
    assert turned.lux[0] == pytest.approx(0.5 * straight.lux[0])
    np.testing.assert_allclose(turned.pixel_mm[0], straight.pixel_mm[0] * (2.0, 1.0))


@settings(max_examples=40, deadline=None)
@given(
    x=st.floats(-0.4, 0.4), y=st.floats(-0.3, 0.3), z=st.floats(-0.5, 0.5),
    across=st.floats(-1.0, 1.0), along=st.floats(-1.0, 1.0),
)  # fmt: skip
def test_pixels_on_the_surface_are_as_opencvs_projection_has_them(
    x: float, y: float, z: float, across: float, along: float
) -> None:
    normal = np.array([across, along, -1.0]) / np.linalg.norm((across, along, -1.0))
    point = np.array([x, y, z])
    lit = lit_by(FACING, Surface(point[None], normal[None], np.ones(1)), Nothing())
    one = np.cross(normal, (0.0, 1.0, 0.0))
    one /= np.linalg.norm(one)
    tangents = np.stack((one, np.cross(normal, one)))
    step = 1e-5
    moved = np.concatenate((point + step * tangents, point - step * tangents))
    matrix = np.array([[800.0, 0.0, 199.5], [0.0, 800.0, 149.5], [0.0, 0.0, 1.0]])
    at, _ = cv2.projectPoints(moved, np.zeros(3), np.array([0.0, 0.0, 2.0]), matrix, np.zeros(4))
    jacobian = (at[:2, 0] - at[2:, 0]) / (2 * step)
    singular = np.linalg.svd(jacobian, compute_uv=False)
    if lit.reached[0]:
        np.testing.assert_allclose(lit.pixel_mm[0], 1e3 / singular[::-1], rtol=1e-4)
    else:
        assert lit.lux[0] == 0.0
        assert np.isinf(lit.detail_mm[0])


def test_what_lies_beside_the_picture_behind_or_turned_away_gets_nothing() -> None:
    points = np.array([[0.6, 0.0, 0.0], [0.0, 0.0, -3.0], [0.0, 0.0, 0.0]])
    normals = np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0], [0.0, 0.0, 1.0]])
    lit = lit_by(FACING, Surface(points, normals, np.ones(3)), Nothing())
    assert not lit.reached.any()
    assert not lit.lux.any()
    assert not lit.cosine.any()


def test_the_balls_far_side_and_what_another_thing_shades_get_nothing(
    target_object: TargetObject, model: ProjectorModel
) -> None:
    surface = sampled(target_object, 800, np.concatenate((EYE, -EYE)), seed=1)
    placement = aimed(model, MountingPoint("front", (0.0, 0.0, -1.5)), surface, 0.9)
    assert placement is not None
    lit = lit_by(placement, surface, target_object)
    front = surface.points_m[:, 2] < -0.05
    assert lit.reached[front].mean() > 0.95
    assert not lit.reached[surface.points_m[:, 2] > 0.02].any()

    class Curtain:
        def hidden(self, from_m: Float64, points_m: Float64) -> Mask:
            return np.asarray(points_m[:, 0] > 0)

    assert not lit_by(placement, surface, Curtain()).reached[surface.points_m[:, 0] > 0].any()


def test_blur_is_least_at_the_focus_and_grows_with_the_pupil() -> None:
    depth = np.linspace(1.0, 4.0, 61)
    sigma = blur(FACING, depth)
    assert depth[sigma.argmin()] == pytest.approx(2.0)
    assert sigma.min() == pytest.approx(0.35)
    # at twice the distance of focus a disc is as wide on the surface as the pupil: 0.02 m of 4 m / 800 px
    assert blur(FACING, np.array([4.0]))[0] == pytest.approx(np.hypot(0.35, 0.25 * 0.02 / (4.0 / 800.0)))
    wide = replace(FACING, model=replace(FACING.model, pupil_m=0.04))
    assert np.all(blur(wide, depth[depth != 2.0]) > sigma[depth != 2.0])


def test_the_best_focus_is_where_scipy_finds_the_least_blur() -> None:
    rng = np.random.default_rng(5)
    depth, weight = rng.uniform(1.0, 2.0, 200), rng.uniform(0.1, 1.0, 200)
    found = minimize_scalar(
        lambda at: float(weight @ blur(replace(FACING, focus_m=at), depth) ** 2),
        bounds=(1.0, 2.0), method="bounded", options={"xatol": 1e-9},
    )  # fmt: skip
    assert best_focus(depth, weight) == pytest.approx(found.x, abs=1e-5)


@settings(max_examples=60, deadline=None)
@given(
    right=st.floats(-80, 80), above=st.floats(-60, 80), distance=st.floats(0.8, 3.0), up=st.floats(-0.6, 0.6),
    side=st.floats(-0.3, 0.3),
)  # fmt: skip
def test_an_aimed_projector_holds_the_object_in_the_middle_and_stays_level(
    target_object: TargetObject,
    model: ProjectorModel,
    right: float,
    above: float,
    distance: float,
    up: float,
    side: float,
) -> None:
    a, b = np.deg2rad(right), np.deg2rad(above)
    at = distance * np.array([np.sin(a) * np.cos(b), -np.sin(b), -np.cos(a) * np.cos(b)])
    surface = sampled(target_object, 400, EYE, seed=2)
    shifted = replace(model, lens_shift=(side, up))
    placement = aimed(shifted, MountingPoint("there", (float(at[0]), float(at[1]), float(at[2]))), surface, 0.8)
    assert placement is not None
    np.testing.assert_allclose(placement.rotation @ placement.rotation.T, np.eye(3), atol=1e-12)
    level = np.cross((0.0, 1.0, 0.0), surface.points_m[surface.area_m2 > 0].mean(axis=0) - at)
    assert placement.rotation[0] @ level / np.linalg.norm(level) > 0.9
    assert model.throw_ratio[0] - 1e-9 <= placement.throw_ratio <= model.throw_ratio[1] + 1e-9
    local = (surface.points_m[surface.area_m2 > 0] - at) @ placement.rotation.T
    picture = placement.focal_px * local[:, :2] / local[:, 2:] + placement.centre_px
    low, high = picture.min(axis=0), picture.max(axis=0)
    np.testing.assert_allclose(0.5 * (low + high), (511.5, 383.5), atol=0.5)
    taken = float(np.max((high - low) / (1024, 768)))
    inside = model.throw_ratio[0] < placement.throw_ratio < model.throw_ratio[1]
    assert not inside or taken == pytest.approx(0.8, rel=0.01)


def test_nothing_can_be_aimed_from_within_the_object(target_object: TargetObject, model: ProjectorModel) -> None:
    surface = sampled(target_object, 400, EYE, seed=2)
    assert aimed(model, MountingPoint("inside", (0.0, 0.0, 0.0)), surface, 0.8) is None
