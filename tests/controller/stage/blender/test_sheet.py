"""A mesh and its painted sheet in Blender: its rendering has the paint where an appearance of kind texture has it."""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh
from PIL import Image

from controller.core.colour import srgb_to_linear
from controller.optics.calibrate.values import Pinhole
from controller.optics.solve.targets.sheets import mesh_places, texture
from tests.controller.optics.solve.targets.test_sheets import MESH, POSE, UV

PYTHON = Path(__file__).parents[4] / ".venv-blender" / "bin" / "python"
WIDTH, HEIGHT, FOCAL = 320, 240, 460.0
PAINT = f"""
import bpy, sys
from mathutils import Matrix
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.import_scene.gltf(filepath=sys.argv[1])
scene = bpy.context.scene
for material in bpy.data.materials:
    nodes, links = material.node_tree.nodes, material.node_tree.links
    image = next(node for node in nodes if node.type == "TEX_IMAGE")
    light = nodes.new("ShaderNodeEmission")
    links.new(image.outputs["Color"], light.inputs["Color"])
    links.new(light.outputs[0], next(node for node in nodes if node.type == "OUTPUT_MATERIAL").inputs["Surface"])
lens = bpy.data.cameras.new("camera")
lens.sensor_fit, lens.sensor_width, lens.lens = "HORIZONTAL", 36.0, 36.0 * {FOCAL} / {WIDTH}
lens.clip_start = 0.01
scene.camera = bpy.data.objects.new("camera", lens)
scene.camera.matrix_world = Matrix(((1, 0, 0, 0), (0, 0, -1, 0), (0, 1, 0, 0), (0, 0, 0, 1)))
scene.collection.objects.link(scene.camera)
scene.render.resolution_x, scene.render.resolution_y = {WIDTH}, {HEIGHT}
scene.render.engine, scene.cycles.samples = "CYCLES", 16
scene.render.film_transparent = True
scene.view_settings.view_transform = "Standard"
scene.render.filepath = sys.argv[2]
bpy.ops.render.render(write_still=True)
"""


@pytest.mark.slow
@pytest.mark.skipif(not PYTHON.exists(), reason="needs Blender (make blender)")
def test_blender_shows_the_paint_where_the_texture_has_it(tmp_path: Path) -> None:
    y, x = np.mgrid[0:512, 0:512] / 512
    lines = (np.abs((16 * x + 0.5) % 1 - 0.5) < 0.08) | (np.abs((8 * y + 0.5) % 1 - 0.5) < 0.05)
    sheet = np.where(lines[..., None], 20, np.stack([255 * x, 200 + 0 * x, 255 * y], axis=2)).astype(np.uint8)
    visuals: Any = trimesh.visual
    material = visuals.material.PBRMaterial(baseColorTexture=Image.fromarray(sheet), doubleSided=True)
    visual = visuals.TextureVisuals(uv=UV.reshape(-1, 2), material=material)
    # glTF has y up and looks along -z
    corners = POSE.placed(MESH.vertices)[MESH.faces].reshape(-1, 3) * (1, -1, -1)
    mesh = trimesh.Trimesh(corners, np.arange(len(corners)).reshape(-1, 3), visual=visual, process=False)
    mesh.export(tmp_path / "jar.glb")
    command = [str(PYTHON), "-c", PAINT, str(tmp_path / "jar.glb"), str(tmp_path / "seen.png")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    with Image.open(tmp_path / "seen.png") as opened:
        seen = np.asarray(opened.convert("RGBA"))
    mask = cv2.erode((seen[..., 3] == 255).astype(np.uint8), np.ones((7, 7), np.uint8)).astype(bool)
    assert mask.sum() > 5000
    middle = np.array([[FOCAL, 0, (WIDTH - 1) / 2], [0, FOCAL, (HEIGHT - 1) / 2], [0, 0, 1]])
    camera = Pinhole(middle, np.zeros(2), np.eye(3), np.zeros(3), (WIDTH, HEIGHT))
    light = np.dstack([srgb_to_linear(sheet), np.ones((512, 512), np.float32)])
    whole = np.ones((HEIGHT, WIDTH), np.bool_)
    ours = texture(light, mesh_places(MESH, UV, POSE, camera), np.zeros((HEIGHT, WIDTH, 3), np.float32), whole).image
    theirs = cv2.GaussianBlur(srgb_to_linear(seen[..., :3]), (0, 0), 0.7)
    pictures = [np.where(mask, image[..., 1], 0).astype(np.float64) for image in (ours, np.asarray(theirs))]
    (right, down), _ = cv2.phaseCorrelate(*pictures)
    assert np.hypot(right, down) < 0.1
    assert np.abs(ours - theirs)[mask].mean() < 0.03
