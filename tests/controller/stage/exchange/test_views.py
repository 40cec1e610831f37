"""Cameras, projectors and points as the programs read them for which they are written; each projects by itself."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
import trimesh
from pxr import Gf, Usd, UsdGeom, UsdValidation

from controller.core.colour import linear_to_srgb
from controller.stage.exchange.content import Content
from controller.stage.exchange.formats import FORMATS, format_of
from tests.controller.stage.exchange.conftest import NAMES, NOISE_PX, opencv_px

CLOSE_PX = 1e-3


@pytest.mark.parametrize("name", ["colmap", "colmap-binary"])
def test_pycolmap_projects_the_points_where_we_do(content: Content, tmp_path: Path, name: str) -> None:
    figures = format_of(name).write(content, tmp_path)
    model: Any = pycolmap.Reconstruction(str(tmp_path))
    assert model.is_valid()
    assert (model.num_images(), model.num_points3D()) == (3, figures["points"])
    assert figures["points"] == len(content.mesh.vertices_m)
    numbers = sorted(model.point3D_ids())
    points = np.stack([model.point3D(number).xyz for number in numbers])
    np.testing.assert_array_equal(points, content.mesh.vertices_m)
    views = content.views
    for number, (_, own) in enumerate(views, 1):
        image = model.image(number)
        theirs = np.stack([image.project_point(point) for point in points])
        np.testing.assert_allclose(theirs - 0.5, opencv_px(own, content.mesh.vertices_m), atol=CLOSE_PX)
        assert (image.camera.width, image.camera.height) == own.size_px
    measured = np.stack([point.xy for point in model.image(2).points2D]) - 0.5
    at = [numbers.index(point.point3D_id) for point in model.image(2).points2D]
    np.testing.assert_allclose(measured, content.measured_px(1)[at])
    written = np.mean([model.point3D(number).error for number in numbers])
    assert model.compute_mean_reprojection_error() == pytest.approx(written, rel=0.3)
    model.update_point_3d_errors()
    assert np.mean([model.point3D(number).error for number in numbers]) == pytest.approx(written, rel=1e-6)
    assert 0.3 * NOISE_PX < written < 1.3 * NOISE_PX
    assert content.colours is not None
    np.testing.assert_array_equal(np.stack([model.point3D(number).color for number in numbers]), content.colours)


def test_a_stage_without_measured_places_keeps_its_cameras_for_colmap(content: Content, tmp_path: Path) -> None:
    bare = replace(content, seen_px=(None, None), picture=None, step=4)
    format_of("colmap").write(bare, tmp_path)
    model = pycolmap.Reconstruction(str(tmp_path))
    assert model.num_images() == 3
    assert model.image(2).num_points2D() == 0
    assert model.image(1).num_points2D() == len(bare.mesh.vertices_m)


def test_opencv_projects_what_it_reads_where_we_do(content: Content, tmp_path: Path) -> None:
    format_of("opencv").write(content, tmp_path / "stage.yml")
    storage = cv2.FileStorage(str(tmp_path / "stage.yml"), cv2.FILE_STORAGE_READ)
    points = storage.getNode("points_m").mat()
    np.testing.assert_allclose(points, content.mesh.vertices_m, rtol=1e-6)
    np.testing.assert_array_equal(storage.getNode("camera_px").mat(), content.mesh.camera_px)
    listed = storage.getNode("projectors")
    nodes = [storage.getNode("camera"), *(listed.at(n) for n in range(listed.size()))]
    assert tuple(node.getNode("name").string() for node in nodes[1:]) == NAMES
    for node, (_, own) in zip(nodes, content.views, strict=True):
        arguments: list[Any] = [
            node.getNode(key).mat() for key in ("rvec", "tvec", "camera_matrix", "distortion_coefficients")
        ]
        theirs, _ = cv2.projectPoints(points.astype(np.float64), *arguments)
        np.testing.assert_allclose(theirs[:, 0], opencv_px(own, content.mesh.vertices_m), atol=CLOSE_PX)
        assert (node.getNode("image_width").real(), node.getNode("image_height").real()) == own.size_px


def test_usds_cameras_see_the_points_where_we_do_but_for_the_lens(content: Content, tmp_path: Path) -> None:
    format_of("usd").write(content, tmp_path / "stage.usda")
    opened = Usd.Stage.Open(str(tmp_path / "stage.usda"))
    assert (UsdGeom.GetStageMetersPerUnit(opened), UsdGeom.GetStageUpAxis(opened)) == (1.0, "Y")
    mesh = UsdGeom.Mesh(opened.GetPrimAtPath("/Stage/Object"))
    points = np.array(mesh.GetPointsAttr().Get())
    np.testing.assert_allclose(points * (1, -1, -1), content.mesh.vertices_m, rtol=1e-6)
    np.testing.assert_array_equal(np.array(mesh.GetFaceVertexIndicesAttr().Get()), content.mesh.triangles.ravel())
    colours = np.array(UsdGeom.PrimvarsAPI(mesh).GetPrimvar("displayColor").Get(), np.float32)
    assert content.colours is not None
    np.testing.assert_allclose(255 * linear_to_srgb(colours), content.colours.astype(np.float32), atol=1e-3)
    for prim, (name, own) in zip(("Camera", "Projector_1", "Projector_2"), content.views, strict=True):
        seen = UsdGeom.Camera(opened.GetPrimAtPath(f"/Stage/{prim}"))
        frustum = seen.GetCamera(Usd.TimeCode.Default()).frustum
        whole = frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix()
        unit = np.array([whole.Transform(Gf.Vec3d(*map(float, point))) for point in points])[:, :2]
        width, height = own.size_px
        px = (unit * (1, -1) + 1) / 2 * own.size_px - 0.5
        straight, _ = cv2.projectPoints(
            content.mesh.vertices_m.astype(np.float64), cv2.Rodrigues(own.rotation)[0], own.translation_m, own.matrix,
            np.zeros(4),
        )  # fmt: skip
        np.testing.assert_allclose(px, straight[:, 0], atol=CLOSE_PX)
        said = {key: seen.GetPrim().GetAttribute(f"velatura:{key}").Get() for key in ("name", "size", "distortion")}
        assert (said["name"], tuple(said["size"])) == (name, (width, height))
        np.testing.assert_array_equal(said["distortion"], own.distortion)


def test_usds_own_validators_find_nothing_wrong(content: Content, tmp_path: Path) -> None:
    format_of("usd").write(content, tmp_path / "stage.usda")
    registry = UsdValidation.ValidationRegistry()
    validators = registry.GetOrLoadAllValidators()
    assert len(validators) > 10
    found = UsdValidation.ValidationContext(validators).Validate(Usd.Stage.Open(str(tmp_path / "stage.usda")))
    assert [error.GetMessage() for error in found] == []


def test_gltf_has_the_poses_and_the_intrinsics_of_all_views(content: Content, tmp_path: Path) -> None:
    format_of("glb").write(content, tmp_path / "object.glb")
    scene: Any = trimesh.load(tmp_path / "object.glb", process=False)
    points = scene.geometry["object"].vertices
    for name, own in content.views:
        matrix, _ = scene.graph.get(name)
        extras = scene.graph.transforms.edge_data[("world", name)]["metadata"]
        local = trimesh.transform_points(points, np.linalg.inv(matrix)) * (1, -1, -1)
        lens = np.array(extras["distortion"])
        px, _ = cv2.projectPoints(local, np.zeros(3), np.zeros(3), np.array(extras["camera_matrix"]), lens)
        np.testing.assert_allclose(px[:, 0], opencv_px(own, content.mesh.vertices_m), atol=CLOSE_PX)
        assert tuple(extras["size_px"]) == own.size_px


def test_formats_have_different_names_and_places() -> None:
    assert len({one.name for one in FORMATS}) == len({one.place for one in FORMATS}) == len(FORMATS)
