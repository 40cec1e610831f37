"""The exported object and poses, as Blender's own importer reads them."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import numpy as np
import pytest

from controller.stage.exchange.content import Content
from controller.stage.exchange.formats import format_of

PYTHON = Path(__file__).parents[4] / ".venv-blender" / "bin" / "python"
READ = """
import bpy, json, sys
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.import_scene.gltf(filepath=sys.argv[1])
(mesh,) = (one for one in bpy.data.objects if one.type == "MESH")
points = [list(mesh.matrix_world @ vertex.co) for vertex in mesh.data.vertices]
poses = {one.name: [list(row) for row in one.matrix_world] for one in bpy.data.objects if one.type == "EMPTY"}
json.dump({"points": points, "faces": len(mesh.data.polygons), "poses": poses}, open(sys.argv[2], "w"))
"""


@pytest.mark.slow
@pytest.mark.skipif(not PYTHON.exists(), reason="needs Blender (make blender)")
def test_blender_reads_the_object_and_all_poses_from_a_glb(content: Content, tmp_path: Path) -> None:
    format_of("glb").write(content, tmp_path / "object.glb")
    command = [str(PYTHON), "-c", READ, str(tmp_path / "object.glb"), str(tmp_path / "read.json")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    found = json.loads((tmp_path / "read.json").read_text())
    # Blender has z up; it turns the axes of each object as those of the world
    turned = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    to_ours = np.diag([1.0, -1.0, -1.0]) @ turned.T
    np.testing.assert_allclose(np.array(found["points"]) @ to_ours.T, content.mesh.vertices_m, atol=1e-6)
    assert found["faces"] == len(content.mesh.triangles)
    assert set(found["poses"]) == {name for name, _ in content.views}
    for name, own in content.views:
        pose = np.array(found["poses"][name])
        np.testing.assert_allclose(to_ours @ pose[:3, 3], -own.rotation.T @ own.translation_m, atol=1e-5)
        axes = to_ours @ pose[:3, :3] @ to_ours.T
        np.testing.assert_allclose(axes, own.rotation.T, atol=1e-5)
