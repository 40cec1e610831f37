"""The glTF file as trimesh reads it, and Blender's view of the stage by Blender's own camera model."""

from __future__ import annotations

import ast
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pytest
import trimesh

from controller.core.errors import UsageError
from controller.optics.calibrate.mesh import Mesh, bend_picture, grid_mesh, margin_px, scene_script, write_glb
from controller.optics.calibrate.values import Geometry, Pinhole

Array = npt.NDArray[np.float64]
SIZE = (60, 40)
MATRIX = np.array([[110.0, 0, 31.2], [0, 110.0, 18.4], [0, 0, 1]])
LENS = np.array([-0.3, 0.02])


def stage() -> Geometry:
    """A tilted wall before a bent lens, and one projector with lens shift to the left of it."""
    x, y = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    px = np.stack([x, y], axis=2).reshape(-1, 1, 2).astype(np.float64)
    flat = cv2.undistortPointsIter(px, MATRIX, np.array([*LENS, 0, 0]), None, None, (3, 200, 1e-12))  # type: ignore[call-overload]
    rays = np.concatenate([flat.reshape(SIZE[1], SIZE[0], 2), np.ones((SIZE[1], SIZE[0], 1))], axis=2)
    points = rays * (1.2 / (1 + 0.3 * rays[..., :1]))
    normal = np.array([-0.3, 0, -1]) / np.hypot(0.3, 1)
    normals = np.broadcast_to(normal, points.shape).astype(np.float32)
    turn = cv2.Rodrigues(np.array([0.1, 0.4, 0.05]))[0].astype(np.float64)
    shifted = np.array([[90.0, 0, 27.0], [0, 90.0, 45.0], [0, 0, 1]])
    camera = Pinhole(MATRIX, LENS, np.eye(3), np.zeros(3), SIZE)
    projector = Pinhole(shifted, np.zeros(2), turn, np.array([0.3, 0.05, 0.1]), (56, 42))
    return Geometry(camera, (projector,), points.astype(np.float32), normals, 0.1, True)


def blender_px(view: dict[str, Any], points: Array) -> Array:
    """Blender's manual: sensor fit horizontal, shift in sensor widths, the camera looks along its -z with y up."""
    width, height = view["resolution"]
    local = (
        np.linalg.inv(np.array(view["matrix_world"])) @ np.concatenate([points, np.ones((len(points), 1))], axis=1).T
    )
    across = view["focal_widths"] * local[0] / -local[2] - view["shift_x"]
    up = view["focal_widths"] * local[1] / -local[2] - view["shift_y"]
    return np.stack([(0.5 + across) * width - 0.5, (0.5 * height / width - up) * width - 0.5], axis=1)


def views_of(script: str) -> list[dict[str, Any]]:
    tree = ast.parse(script)
    values = [node.value for node in tree.body if isinstance(node, ast.Assign) and node.targets[0].id == "VIEWS"]  # type: ignore[attr-defined]
    found: list[dict[str, Any]] = json.loads(json.dumps(ast.literal_eval(values[0])))
    return found


def test_blenders_cameras_see_the_points_where_the_calibrated_ones_do() -> None:
    geometry = stage()
    script = scene_script([("camera", geometry.camera), ("projector left", geometry.projectors[0])], 1, "object.glb")
    points = geometry.points_m.reshape(-1, 3).astype(np.float64)
    in_blender = np.stack([points[:, 0], points[:, 2], -points[:, 1]], axis=1)
    camera, projector = views_of(script)
    margin = camera["margin_px"]
    straight, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), MATRIX, np.zeros(4))
    np.testing.assert_allclose(blender_px(camera, in_blender), straight[:, 0] + margin, atol=1e-3)
    own = geometry.projectors[0]
    seen, _ = cv2.projectPoints(points, cv2.Rodrigues(own.rotation)[0], own.translation_m, own.matrix, np.zeros(4))
    np.testing.assert_allclose(blender_px(projector, in_blender), seen[:, 0], atol=1e-3)
    assert projector["name"] == "projector left"


def test_a_rendered_picture_is_bent_into_the_cameras_own() -> None:
    geometry = stage()
    margin = margin_px(geometry.camera)
    assert 0 < margin < 20
    wide, high = SIZE[0] + 2 * margin, SIZE[1] + 2 * margin
    x, y = np.meshgrid(np.arange(wide) - margin, np.arange(high) - margin)
    rendered = np.stack([x, y], axis=2).astype(np.float32)  # each pixel holds where it is
    bent = bend_picture(rendered, geometry.camera)
    straight, _ = cv2.projectPoints(
        geometry.points_m.reshape(-1, 3).astype(np.float64), np.zeros(3), np.zeros(3), MATRIX, np.zeros(4)
    )
    np.testing.assert_allclose(bent.reshape(-1, 2), straight[:, 0], atol=0.02)


def test_a_lens_without_distortion_needs_no_more_than_a_pixel_of_margin() -> None:
    camera = Pinhole(MATRIX, np.zeros(2), np.eye(3), np.zeros(3), SIZE)
    assert margin_px(camera) == 1


def test_the_gltf_file_reads_back_with_normals_and_places_in_the_picture(tmp_path: Path) -> None:
    geometry = stage()
    mesh = grid_mesh(geometry)
    texture = np.random.default_rng(0).integers(0, 256, (SIZE[1], SIZE[0], 3), dtype=np.uint8)
    write_glb(tmp_path / "object.glb", mesh, SIZE, texture)
    scene: Any = trimesh.load(tmp_path / "object.glb", process=False)
    read = scene.geometry["object"]
    np.testing.assert_allclose(read.vertices * (1, -1, -1), mesh.vertices_m, atol=1e-6)
    np.testing.assert_allclose(read.vertex_normals * (1, -1, -1), mesh.normals, atol=1e-6)
    np.testing.assert_array_equal(read.faces, mesh.triangles)
    np.testing.assert_array_equal(np.asarray(read.visual.material.baseColorTexture.convert("RGB")), texture)
    uv = read.visual.uv
    np.testing.assert_allclose(uv[:, 0] * SIZE[0] - 0.5, mesh.camera_px[:, 0], atol=1e-4)
    np.testing.assert_allclose((1 - uv[:, 1]) * SIZE[1] - 0.5, mesh.camera_px[:, 1], atol=1e-4)


def test_the_same_triangle_faces_outwards_in_gltf(tmp_path: Path) -> None:
    mesh = grid_mesh(stage())
    write_glb(tmp_path / "object.glb", mesh, SIZE)
    scene: Any = trimesh.load(tmp_path / "object.glb", process=False)
    read = scene.geometry["object"]
    assert np.all(np.sum(read.face_normals * read.vertex_normals[read.faces[:, 0]], axis=1) > 0)


def test_an_empty_mesh_becomes_no_gltf_file(tmp_path: Path) -> None:
    none = np.zeros((0, 3), dtype=np.float32)
    with pytest.raises(UsageError) as refused:
        write_glb(tmp_path / "object.glb", Mesh(none, none, np.zeros((0, 3), np.int32), none[:, :2]), SIZE)
    assert refused.value.code == "mesh-empty"
    assert list(tmp_path.iterdir()) == []
