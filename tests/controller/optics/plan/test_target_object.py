"""The planned object: how a mesh stands in the room, and what of it is seen."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from controller.core.errors import UsageError
from controller.optics.plan.target_object import AFTER_M, TargetObject, read_target_object, sampled, seen_from
from tests.controller.optics.plan.conftest import EYE


def test_a_mesh_stands_upright_in_metres_with_its_front_to_the_audience(tmp_path: Path) -> None:
    # a wedge: 1 wide in x, 2 deep in y with its low edge in front (-y), 3 high in z
    block = trimesh.creation.box((1.0, 2.0, 3.0))
    tip = trimesh.creation.box((0.1, 0.1, 0.1))
    tip.apply_translation((0.0, -1.5, 1.45))
    (block + tip).export(tmp_path / "block.stl")
    target_object = read_target_object(tmp_path / "block.stl", height_m=0.6, up="+z", front="-y")
    low, high = target_object.vertices_m.min(axis=0), target_object.vertices_m.max(axis=0)
    np.testing.assert_allclose(high - low, (0.2, 0.6, 0.2 * 2.55), atol=1e-6)
    np.testing.assert_allclose(low + high, 0.0, atol=1e-6)
    nose = target_object.vertices_m[target_object.vertices_m[:, 2].argmin()]
    assert nose[1] < -0.27  # the tip is on top, and y points down


def test_points_stand_for_the_area_and_only_what_is_seen_counts(target_object: TargetObject) -> None:
    surface = sampled(target_object, 4000, EYE, seed=4)
    radius = 0.15
    assert np.linalg.norm(surface.points_m, axis=1) == pytest.approx(radius, rel=0.02)
    # a cap seen from distance d: 2 pi r^2 (1 - r / d)
    assert surface.area_m2.sum() == pytest.approx(2 * np.pi * radius**2 * (1 - radius / 2.0), rel=0.03)
    assert np.all(np.sum(surface.normals * surface.points_m, axis=1)[surface.area_m2 > 0] > 0)
    again = sampled(target_object, 4000, EYE, seed=4)
    np.testing.assert_array_equal(again.points_m, surface.points_m)


def test_a_mesh_that_is_inside_out_is_seen_from_outside_all_the_same(tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(subdivisions=2)
    ball.invert()
    ball.export(tmp_path / "ball.ply")
    target_object = read_target_object(tmp_path / "ball.ply", height_m=0.3, up="+y", front="+z")
    surface = sampled(target_object, 500, EYE, seed=1)
    assert np.all(np.sum(surface.normals * surface.points_m, axis=1)[surface.area_m2 > 0] > 0)


def test_nobody_who_looks_is_a_mistake(target_object: TargetObject) -> None:
    with pytest.raises(UsageError) as refused:
        sampled(target_object, 100, np.zeros((0, 3)), seed=1)
    assert refused.value.code == "plan-nothing-seen"


def test_what_is_behind_the_ball_is_hidden_and_what_is_before_it_is_not(target_object: TargetObject) -> None:
    points = np.array([[0.0, 0.0, -0.5], [0.0, 0.0, 0.5], [1.0, 0.0, 0.5]])
    assert target_object.hidden(EYE[0], points).tolist() == [False, True, False]
    distance, normals = target_object.hit(EYE[0], np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]]))
    assert distance[0] == pytest.approx(1.85, abs=0.01)
    assert distance[1] == AFTER_M
    assert abs(normals[0, 2]) == pytest.approx(1.0, abs=0.05)


def test_the_audience_sees_a_disc_that_faces_it(target_object: TargetObject) -> None:
    view = seen_from(target_object, EYE[0], rows=120)
    assert view.mask.mean() == pytest.approx(np.pi / 4 / 1.06**2, abs=0.02)
    picture = view.map_of(np.arange(len(view.surface.points_m), dtype=np.float64))
    assert np.array_equal(np.isfinite(picture), view.mask)
    assert np.all(view.surface.normals[:, 2] < 0.1)


@pytest.mark.parametrize(
    ("name", "content", "code"),
    [
        ("nothing.obj", "", "plan-mesh-no-faces"),
        ("letter.obj", "Dear reader,\n", "plan-mesh-no-faces"),
        ("nowhere.obj", "v 0 0 0\nv 1 0 0\nv nan 1 0\nf 1 2 3\n", "plan-mesh-unreadable"),
        ("flat.obj", "v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", "plan-mesh-no-size"),
        ("cut.stl", "solid\nfacet normal 0 0", "plan-mesh-no-faces"),
        ("kind.unknown", "x", "plan-mesh-unreadable"),
    ],
)
def test_a_file_that_is_no_mesh_is_refused(tmp_path: Path, name: str, content: str, code: str) -> None:
    (tmp_path / name).write_text(content)
    with pytest.raises(UsageError) as refused:
        read_target_object(tmp_path / name, height_m=1.0, up="+y", front="+z")
    assert refused.value.code == code


def test_up_and_front_must_differ(ball: Path) -> None:
    with pytest.raises(UsageError) as refused:
        read_target_object(ball, height_m=1.0, up="+y", front="-y")
    assert refused.value.code == "plan-axes"
