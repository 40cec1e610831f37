"""Renders one job. Runs inside Blender's own Python (``python worker.py JOB`` with the bpy module, or
``blender --background --python worker.py -- JOB``), which is why it imports nothing of ours.

JOB is a folder with ``job.json`` and ``mesh.npz`` (``controller.stage.blender.job`` writes both); the picture becomes
``picture.exr`` there: 32-bit floats, linear.
"""

import json
import sys
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix, Vector

sys.path.insert(0, str(Path(__file__).parent))
from scenes import BUILTIN, COLOURS  # type: ignore[import-not-found]

PLACEHOLDER = "velatura"
"""An object of this name in a user's scene gets the reconstructed shape and keeps its material."""
SENSOR_MM = 36.0


def main(folder: Path) -> None:
    job = json.loads((folder / "job.json").read_text(encoding="utf-8"))
    scene_file = job["scene_file"]
    if scene_file is None:
        bpy.ops.wm.read_factory_settings(use_empty=True)
    else:
        # Scripts inside a scene do not run: a scene may come from anybody.
        bpy.ops.wm.open_mainfile(filepath=scene_file, use_scripts=False)
        _check()
    with np.load(folder / "mesh.npz", allow_pickle=False) as arrays:
        mesh = _mesh({name: arrays[name] for name in arrays.files})
    body = _body(mesh)
    if scene_file is None:
        BUILTIN[job["builtin"]](body, *(Vector(corner) for corner in job["bounds_m"]))
    _camera(job["camera"])
    _settings(job, folder)
    bpy.ops.render.render(write_still=True)


def _check() -> None:
    """Refuse a scene without its textures, which would be magenta, and tell what is left out of it."""
    for image in bpy.data.images:
        path = Path(bpy.path.abspath(image.filepath, library=image.library))
        if image.source == "FILE" and image.users and image.packed_file is None and not path.is_file():
            sys.exit(f"Error: the scene's picture {path} does not exist")
    scene = bpy.context.scene
    left_out = [] if scene.view_settings.view_transform in ("Raw", "Standard") else ["view transform"]
    if scene.use_nodes and scene.render.use_compositing:
        left_out.append("compositing")
    if left_out:
        sys.stdout.write(f"Omitted: {' and '.join(left_out)}\n")
        sys.stdout.flush()


def _units_per_m() -> float:
    return float(1 / bpy.context.scene.unit_settings.scale_length)


def _mesh(arrays: dict[str, Any]) -> Any:
    mesh = bpy.data.meshes.new(PLACEHOLDER)
    vertices, triangles = arrays["vertices_m"] * _units_per_m(), arrays["triangles"]
    mesh.vertices.add(len(vertices))
    mesh.vertices.foreach_set("co", vertices.astype(np.float32).ravel())
    mesh.loops.add(triangles.size)
    mesh.loops.foreach_set("vertex_index", triangles.astype(np.int32).ravel())
    mesh.polygons.add(len(triangles))
    mesh.polygons.foreach_set("loop_start", np.arange(0, triangles.size, 3, dtype=np.int32))
    uv = mesh.uv_layers.new(name="camera")
    uv.data.foreach_set("uv", arrays["uv"].astype(np.float32)[triangles.ravel()].ravel())
    mesh.update(calc_edges=True)
    mesh.validate()
    colours = mesh.color_attributes.new(COLOURS, "FLOAT_COLOR", "POINT")
    rgba = np.concatenate([arrays["reflectance"], np.ones((len(vertices), 1))], axis=1).astype(np.float32)
    colours.data.foreach_set("color", rgba.ravel())
    mesh.polygons.foreach_set("use_smooth", np.ones(len(mesh.polygons), bool))
    mesh.normals_split_custom_set_from_vertices(arrays["normals"].astype(np.float32))
    return mesh


def _body(mesh: Any) -> Any:
    body = bpy.data.objects.get(PLACEHOLDER)
    if body is not None and body.type == "MESH":
        for material in body.data.materials:
            mesh.materials.append(material)
        body.data = mesh
        # what moves or hides the placeholder would move or hide the object: the projectors light it where it stands
        body.animation_data_clear()
        body.constraints.clear()
        body.parent = None
        body.hide_render = False
        body.delta_location, body.delta_rotation_euler, body.delta_scale = (0, 0, 0), (0, 0, 0), (1, 1, 1)
        body.delta_rotation_quaternion = (1, 0, 0, 0)
        body.matrix_world = Matrix.Identity(4)
        return body
    body = bpy.data.objects.new(PLACEHOLDER, mesh)
    bpy.context.scene.collection.objects.link(body)
    return body


def _camera(camera: dict[str, Any]) -> None:
    """The calibrated camera; the first of several is at the origin, looking along +y, z up."""
    data = bpy.data.cameras.new(camera["name"])
    data.sensor_fit, data.sensor_width = "HORIZONTAL", SENSOR_MM
    data.lens = camera["focal_widths"] * SENSOR_MM
    data.shift_x, data.shift_y = camera["shift_x"], camera["shift_y"]
    data.clip_start, data.clip_end = (camera[key] * _units_per_m() for key in ("near_m", "far_m"))
    place = bpy.data.objects.new(camera["name"], data)
    matrix = Matrix(camera["matrix_world"])
    matrix.translation *= _units_per_m()
    place.matrix_world = matrix
    scene = bpy.context.scene
    scene.collection.objects.link(place)
    scene.camera = place
    scene.render.resolution_x, scene.render.resolution_y = camera["resolution"]
    scene.render.resolution_percentage = 100
    # Blender wants ratios of at least 1
    tall = camera["pixel_aspect"]
    scene.render.pixel_aspect_x, scene.render.pixel_aspect_y = max(1.0, 1 / tall), max(1.0, tall)


def _settings(job: dict[str, Any], folder: Path) -> None:
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    cycles = scene.cycles
    cycles.device = "CPU"
    cycles.samples, cycles.seed = job["samples"], job["seed"]
    cycles.use_adaptive_sampling, cycles.adaptive_threshold = True, 0.02
    cycles.use_denoising = job["denoise"]
    cycles.sample_clamp_indirect = 10.0
    render = scene.render
    render.film_transparent = True
    render.use_border = False
    render.threads_mode = "FIXED" if job["threads"] else "AUTO"
    if job["threads"]:
        render.threads = job["threads"]
    render.image_settings.file_format = "OPEN_EXR"
    render.image_settings.color_mode, render.image_settings.color_depth = "RGBA", "32"
    render.image_settings.exr_codec = "ZIP"
    render.filepath = str(folder / "picture.exr")
    render.use_compositing = render.use_sequencer = False
    scene.view_settings.view_transform = "Raw"


if __name__ == "__main__":
    given = sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:]
    main(Path(given[0]))
