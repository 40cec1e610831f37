"""Exports of several views: where other programs' cameras see the object, and what they make of the observations."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
import trimesh

from controller.optics.calibrate.mesh import grid_mesh, scene_script
from controller.optics.calibrate.values import Metapixels
from controller.stage.exchange.content import Content, OtherView
from controller.stage.exchange.formats import format_of
from tests.controller.optics.calibrate.geometry.test_view_poses import CAMERA, joined, stage
from tests.controller.optics.calibrate.mesh.test_export import blender_px, views_of

NAMES = ("a", "b", "c", "d")
PYTHON = Path(__file__).parents[4] / ".venv-blender" / "bin" / "python"
LOOK = """
import importlib.util, json, sys
from pathlib import Path
import bpy
from bpy_extras.object_utils import world_to_camera_view
spec = importlib.util.spec_from_file_location("scene", sys.argv[1])
module = importlib.util.module_from_spec(spec)
spec.loader.exec_module(module)
scene = module.set_up(Path(sys.argv[1]).parent)
mesh = next(one for one in bpy.data.objects if one.type == "MESH")
seen = {}
for view in module.VIEWS:
    if view["name"].startswith("camera"):
        width, height = scene.render.resolution_x, scene.render.resolution_y = view["resolution"]
        camera = bpy.data.objects[view["name"]]
        bpy.context.view_layer.update()
        places = [world_to_camera_view(scene, camera, mesh.matrix_world @ one.co) for one in mesh.data.vertices]
        margin = view["margin_px"]
        seen[view["name"]] = [[p.x * width - 0.5 - margin, (1 - p.y) * height - 0.5 - margin] for p in places]
json.dump(seen, open(sys.argv[2], "w"))
"""


@pytest.fixture(scope="module")
def content() -> Content:
    """Three cameras and four projectors around an object, joined from what they saw."""
    _, _, seen = stage(noise=0.2)
    found = joined(seen)
    shots = [tuple(np.where(one.valid[..., None], one.projector_px, np.float32(np.nan)) for one in view.correspondences)
             for view in seen]  # fmt: skip
    pictures = [np.full((CAMERA[1], CAMERA[0], 3), 60 * n + 40, np.uint8) for n in range(len(seen))]
    others = tuple(
        OtherView(view.name, one.reconstruction.geometry, one.pose, picture, px)
        for view, one, picture, px in zip(seen[1:], found[1:], pictures[1:], shots[1:], strict=True)
    )
    none = Metapixels(np.zeros((1, 1, 2), np.float32), np.zeros((1, 1, 3), np.float32), np.zeros((1, 1), np.bool_))
    return Content(
        folder=Path("unused"),
        shape=found[0].reconstruction.geometry,
        names=NAMES,
        step=2,
        picture=pictures[0],
        seen_px=shots[0],
        metapixels=lambda: (none,) * len(NAMES),
        transport=lambda: pytest.fail("not needed"),
        black=lambda: pytest.fail("not needed"),
        others=others,
    )


def test_every_camera_sees_the_object_where_its_photographs_do(content: Content) -> None:
    made = views_of(scene_script(content.views, len(content.cameras), "object.glb"))
    x, y, z = content.mesh.vertices_m.astype(np.float64).T
    for n, view in enumerate(made[:3]):
        measured = content.measured_px(n)
        own = np.isfinite(measured[:, 0])
        assert own.sum() > 300
        off = blender_px(view, np.stack([x, z, -y], axis=1))[own] - view["margin_px"] - measured[own]
        assert np.median(np.linalg.norm(off, axis=1)) < 0.5
    assert [view["name"] for view in made] == [name for name, _ in content.views]


@pytest.mark.slow
@pytest.mark.skipif(not PYTHON.exists(), reason="needs Blender (make blender)")
def test_blender_opens_it_and_its_cameras_see_the_object_there(content: Content, tmp_path: Path) -> None:
    format_of("blender").write(content, tmp_path)
    command = [str(PYTHON), "-c", LOOK, str(tmp_path / "scene.py"), str(tmp_path / "seen.json")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    seen = json.loads((tmp_path / "seen.json").read_text())
    for n, (name, _) in enumerate(content.cameras):
        off = np.linalg.norm(np.array(seen[name]) - content.measured_px(n), axis=1)
        assert np.nanmedian(off) < 0.5


def test_colmaps_bundle_adjustment_changes_the_reprojection_by_less_than_two_per_cent(
    content: Content, tmp_path: Path
) -> None:
    format_of("colmap-binary").write(content, tmp_path)
    model = pycolmap.Reconstruction(str(tmp_path))
    assert model.num_images() == 3 + 4
    settings = pycolmap.BundleAdjustmentOptions()
    settings.print_summary = settings.refine_extra_params = settings.refine_focal_length = False
    # a mesh is smoothed: only the points' places are COLMAP's, then all poses and focal lengths, too
    settings.refine_rig_from_world = False
    pycolmap.bundle_adjustment(model, settings)
    ours = residual_px(model)
    settings.refine_rig_from_world = settings.refine_focal_length = True
    pycolmap.bundle_adjustment(model, settings)
    assert ours == pytest.approx(residual_px(model), rel=0.02)


def residual_px(model: pycolmap.Reconstruction) -> float:
    """Root mean square over all observations."""
    off = [
        np.linalg.norm(image.project_point(model.points3D[point.point3D_id].xyz) - point.xy)
        for image in model.images.values()
        for point in image.points2D
        if point.has_point3D()
    ]
    return float(np.sqrt(np.mean(np.square(off))))


def test_a_gltf_has_every_surface_once_and_all_pictures(content: Content, tmp_path: Path) -> None:
    format_of("glb").write(content, tmp_path / "object.glb")
    scene: Any = trimesh.load(tmp_path / "object.glb", process=False)
    mesh = scene.geometry["object"]
    assert len(mesh.vertices) == len(content.mesh.vertices_m)
    texture = np.asarray(mesh.visual.material.baseColorTexture.convert("RGB"))
    assert texture.shape[:2] == content.sheet.shape
    assert content.colours is not None
    # each vertex has the colour of the picture that sees it
    for n in range(3):
        own = np.isfinite(content.measured_px(n)[:, 0])
        assert np.unique(content.colours[own]).tolist() == [60 * n + 40]
    shapes = [content.geometry, *(one.shape for one in content.others)]
    alone = sum(len(grid_mesh(shape, step=content.step).triangles) for shape in shapes)
    assert len(grid_mesh(content.geometry, step=content.step).triangles) < len(content.mesh.triangles) < 0.9 * alone
