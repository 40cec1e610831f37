"""The mesh of a known surface, and its file as trimesh reads it."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from controller.core.errors import UsageError
from controller.optics.calibrate.mesh import Mesh, grid_mesh, ply_bytes, write_ply
from controller.optics.calibrate.values import Geometry, Pinhole


def steps(depths_m: tuple[float, float], unknown: int = 0) -> Geometry:
    """A wall with a step in the middle: the left half at one depth, the right half at another."""
    rows, columns, focal = 20, 30, 100.0
    x, y = np.meshgrid(np.arange(columns), np.arange(rows))
    depth = np.where(x < columns // 2, *depths_m).astype(np.float32)
    depth[:unknown] = np.nan
    points = np.stack([(x - 15) / focal * depth, (y - 10) / focal * depth, depth], axis=2).astype(np.float32)
    normals = np.where(np.isfinite(points), np.array([0, 0, -1], dtype=np.float32), np.float32(np.nan))
    matrix = np.array([[focal, 0, 15], [0, focal, 10], [0, 0, 1]])
    camera = Pinhole(matrix, np.zeros(2), np.eye(3), np.zeros(3), (columns, rows))
    return Geometry(camera, (), points, normals, 0.1, True)


def test_a_plane_becomes_two_triangles_a_pixel_facing_the_camera() -> None:
    mesh = grid_mesh(steps((1.0, 1.0)))
    assert mesh.triangles.shape == (2 * 19 * 29, 3)
    a, b, c = (mesh.vertices_m[mesh.triangles[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    assert np.all(normal[:, 2] < 0)
    assert 0.5 * np.linalg.norm(normal, axis=1).sum() == pytest.approx(0.29 * 0.19, rel=1e-4)


def test_a_depth_step_is_left_open_and_unknown_pixels_have_no_vertex() -> None:
    mesh = grid_mesh(steps((1.0, 1.5), unknown=3))
    assert mesh.triangles.shape == (2 * 16 * 28, 3)
    assert np.isfinite(mesh.vertices_m).all()
    assert len(mesh.vertices_m) == 17 * 30
    assert mesh.camera_px[:, 1].min() == 3


def test_a_coarser_step_keeps_the_extent() -> None:
    fine, coarse = grid_mesh(steps((1.0, 1.0))), grid_mesh(steps((1.0, 1.0)), step=3)
    assert len(coarse.triangles) < len(fine.triangles) / 7
    assert coarse.camera_px.max() == 27


def test_the_ply_file_reads_back_the_same(tmp_path: Path) -> None:
    mesh = grid_mesh(steps((1.0, 1.2)))
    colours = np.random.default_rng(0).integers(0, 256, mesh.vertices_m.shape, dtype=np.uint8)
    write_ply(tmp_path / "object.ply", mesh, colours)
    read: Any = trimesh.load(tmp_path / "object.ply", process=False)
    np.testing.assert_array_equal(read.vertices.astype(np.float32), mesh.vertices_m)
    np.testing.assert_array_equal(read.faces, mesh.triangles)
    np.testing.assert_array_equal(read.visual.vertex_colors[:, :3], colours)
    np.testing.assert_allclose(read.vertex_normals, mesh.normals, atol=1e-6)


def test_the_ply_file_holds_what_it_has_always_held(tmp_path: Path) -> None:
    mesh = grid_mesh(steps((1.0, 1.2)))
    for colours in (None, np.full(mesh.vertices_m.shape, 7, np.uint8)):
        write_ply(tmp_path / "object.ply", mesh, colours)
        header = (tmp_path / "object.ply").read_bytes().partition(b"end_header")[0].decode().split("\n")
        properties = [line.removeprefix("property ") for line in header if line.startswith("property ")]
        names = [*(f"float {name}" for name in ("x", "y", "z", "nx", "ny", "nz"))]
        names += [] if colours is None else [f"uchar {name}" for name in ("red", "green", "blue", "alpha")]
        assert properties == [*names, "list uchar int vertex_indices"]
        assert "format binary_little_endian 1.0" in header


@settings(max_examples=40, deadline=None, derandomize=True)
@given(st.integers(0, 2**32 - 1), st.integers(3, 40), st.integers(1, 60), st.booleans(), st.booleans())
def test_any_mesh_reads_back_the_same(seed: int, count: int, faces: int, normals: bool, colours: bool) -> None:
    random = np.random.default_rng(seed)
    vertices = random.uniform(-3, 3, (count, 3)).astype(np.float32)
    triangles = random.integers(0, count, (faces, 3)).astype(np.int32)
    across = random.normal(size=(count, 3)).astype(np.float32)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    painted = random.integers(0, 256, (count, 3), dtype=np.uint8)
    data = ply_bytes(vertices, triangles, normals=across if normals else None, colours=painted if colours else None)
    read: Any = trimesh.load(io.BytesIO(data), file_type="ply", process=False)
    np.testing.assert_array_equal(read.vertices.astype(np.float32), vertices)
    np.testing.assert_array_equal(read.faces, triangles)
    if normals:
        np.testing.assert_allclose(read.vertex_normals, across, atol=1e-6)
    if colours:
        np.testing.assert_array_equal(read.visual.vertex_colors[:, :3], painted)


def test_an_empty_mesh_is_refused_and_nothing_written(tmp_path: Path) -> None:
    empty = Mesh(*(np.zeros((0, 3), dtype=np.float32),) * 2, np.zeros((0, 3), np.int32), np.zeros((0, 2), np.float32))
    with pytest.raises(UsageError) as refused:
        write_ply(tmp_path / "object.ply", empty)
    assert refused.value.code == "mesh-empty"
    assert list(tmp_path.iterdir()) == []
