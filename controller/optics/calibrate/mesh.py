"""The reconstructed surface as a mesh: PLY and glTF files, and a script that sets up the stage in Blender 4.

A mesh is the camera's pixel grid, cut where the depth jumps. PLY is the Stanford polygon format 1.0, binary and
little-endian; glTF is version 2.0.

Blender's cameras have no radial distortion. The script therefore renders a margin around the picture, and
``bend_picture`` brings a rendered picture into the calibrated camera's own.
"""

from __future__ import annotations

import importlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from controller.core.arrays import Float64, FloatImage, Mask
from controller.core.errors import UsageError
from controller.core.storage import stream_atomically
from controller.optics.calibrate.metapixels.from_dots import project
from controller.optics.calibrate.values import Geometry, Pinhole

STEEPEST = 6.0
"""Edges longer than this many times a pixel's width on the object, seen head-on, join two different surfaces."""


@dataclass(frozen=True, slots=True)
class Mesh:
    """Triangles with outward normals, counter-clockwise seen from the camera's side.

    ``vertices_m``, ``normals`` (vertices, 3) float32; ``triangles`` (triangles, 3) int32;
    ``camera_px`` (vertices, 2) float32: where the camera sees each vertex, its texture coordinate
    """

    vertices_m: FloatImage
    normals: FloatImage
    triangles: npt.NDArray[np.int32]
    camera_px: FloatImage


def grid_mesh(geometry: Geometry, *, step: int = 1) -> Mesh:
    """Join adjacent camera pixels into triangles where all three corners are known and lie on one surface.

    ``step``: use every n-th pixel in both directions. Vertices that no triangle uses are left out.
    """
    points = geometry.points_m[::step, ::step]
    rows, columns = points.shape[:2]
    index = np.arange(rows * columns, dtype=np.int32).reshape(rows, columns)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
    # image rows run downwards, so this order turns counter-clockwise towards the camera
    corners = np.concatenate([np.stack(t, axis=2).reshape(-1, 3) for t in ((a, c, b), (b, c, d))])
    flat = points.reshape(-1, 3)
    reach = STEEPEST * step / float(geometry.camera.matrix[0, 0])
    keep = _joined(flat, corners, reach) & np.isfinite(geometry.normals[::step, ::step].reshape(-1, 3)[corners, 0]).all(
        axis=1
    )
    corners = corners[keep]
    used, renumbered = np.unique(corners, return_inverse=True)
    y, x = np.divmod(used, columns)
    return Mesh(
        vertices_m=flat[used],
        normals=geometry.normals[::step, ::step].reshape(-1, 3)[used],
        triangles=renumbered.reshape(-1, 3).astype(np.int32),
        camera_px=np.stack([x, y], axis=1).astype(np.float32) * step,
    )


def _joined(points: FloatImage, corners: npt.NDArray[np.int32], reach: float) -> npt.NDArray[np.bool_]:
    """Whether all three edges of each triangle are at most ``reach`` times as long as it is far away."""
    keep = np.isfinite(points[corners, 2]).all(axis=1)
    for first, second in ((0, 1), (1, 2), (2, 0)):
        start, end = points[corners[:, first]], points[corners[:, second]]
        with np.errstate(invalid="ignore"):
            keep &= np.linalg.norm(end - start, axis=1) <= reach * np.minimum(start[:, 2], end[:, 2])
    return np.asarray(keep)


COVERED: Final = 0.01
"""Relative difference of distance up to which two views see the same surface."""


def seen_at(camera: Pinhole, points_m: FloatImage, places_m: FloatImage) -> tuple[Float64, Mask]:
    """Where a camera has places in space (places, 3) in its picture, (places, 2) px, and whether it sees them.

    ``points_m`` (rows, columns, 3): what it sees, in its own frame
    """
    px, depth = project(camera, places_m.astype(np.float64))
    rows, columns = points_m.shape[:2]
    x, y = np.rint(np.nan_to_num(px, nan=-1.0)).clip(-1, max(rows, columns)).astype(np.int64).T
    inside = (x >= 0) & (y >= 0) & (x < columns) & (y < rows) & (depth > 0)
    known = np.where(inside, points_m[np.where(inside, y, 0), np.where(inside, x, 0), 2], np.nan)
    return px, np.asarray(np.abs(known - depth) < COVERED * known)


OBJECT = "object"
"""The mesh's name in glTF files and in Blender."""


class View(NamedTuple):
    """A node of a glTF file without a mesh: ``matrix`` (4, 4) its pose, ``extras`` its metadata."""

    name: str
    matrix: npt.NDArray[np.float64]
    extras: Mapping[str, object]


def write_ply(path: Path, mesh: Mesh, colours: npt.NDArray[np.uint8] | None = None) -> None:
    """Write vertices in metres (camera frame: x right, y down, z forward), normals, triangles, and colours if given.

    ``colours`` (vertices, 3). Raises UsageError("mesh-empty", "mesh-colours-wrong-size"), WorkError("no-space").
    """
    _require_triangles(mesh)
    if colours is not None and colours.shape != mesh.vertices_m.shape:
        raise UsageError(
            "mesh-colours-wrong-size",
            what=f"The colours have shape {colours.shape}, but the vertices have shape {mesh.vertices_m.shape}.",
            remedy="Give one red, green and blue value for each vertex.",
        )
    data = ply_bytes(mesh.vertices_m, mesh.triangles, normals=mesh.normals, colours=colours)
    stream_atomically(path, lambda file: file.write(data))


def ply_bytes(
    vertices: npt.NDArray[np.floating],
    triangles: npt.NDArray[np.integer],
    *,
    normals: npt.NDArray[np.floating] | None = None,
    colours: npt.NDArray[np.uint8] | None = None,
) -> bytes:
    """A mesh as a PLY file, binary and little-endian: float32 x, y, z, then nx, ny, nz and red, green, blue, alpha.

    ``vertices``, ``normals`` (n, 3); ``triangles`` (m, 3) indices of vertices; ``colours`` (n, 3), written opaque
    """
    trimesh: Any = importlib.import_module("trimesh")  # its functions carry no types
    opaque = None if colours is None else np.column_stack([colours, np.full(len(colours), 255, np.uint8)])
    mesh = trimesh.Trimesh(vertices, triangles, vertex_normals=normals, vertex_colors=opaque, process=False)
    data: bytes = mesh.export(file_type="ply", encoding="binary", vertex_normal=normals is not None)
    return data


def write_glb(
    path: Path,
    mesh: Mesh,
    size_px: tuple[int, int],
    texture: npt.NDArray[np.uint8] | None = None,
    views: Sequence[View] = (),
) -> None:
    """Write vertices in metres, normals, triangles and texture coordinates as one binary glTF file.

    glTF's y points up and its cameras look along -z: its frame is the camera's, turned half round x. The texture
    coordinates are places in the camera's picture of ``size_px`` (width, height), so any picture of the camera fits;
    ``texture`` (rows, columns, 3) sRGB is put into the file. Raises as ``write_ply``, without colours.
    """
    from PIL import Image

    trimesh: Any = importlib.import_module("trimesh")  # its functions carry no types
    _require_triangles(mesh)
    turned = np.array([1.0, -1.0, -1.0])
    # a pixel's middle lies half a pixel inside the picture, whose lower left corner is (0, 0)
    across = (mesh.camera_px.astype(np.float64) + 0.5) / np.asarray(size_px)
    material = trimesh.visual.material.PBRMaterial(
        name="object",
        baseColorTexture=None if texture is None else Image.fromarray(texture),
        metallicFactor=0.0,
        roughnessFactor=1.0,
        doubleSided=True,
    )
    uv = np.stack([across[:, 0], 1.0 - across[:, 1]], axis=1)
    model = trimesh.Trimesh(
        vertices=mesh.vertices_m * turned,
        faces=mesh.triangles,
        vertex_normals=mesh.normals * turned,
        visual=trimesh.visual.TextureVisuals(uv=uv, material=material),
        process=False,
    )
    scene = trimesh.Scene()
    scene.add_geometry(model, node_name=OBJECT, geom_name=OBJECT)
    for view in views:
        scene.graph.update(frame_to=view.name, matrix=view.matrix, metadata=dict(view.extras))
    data: bytes = scene.export(file_type="glb", include_normals=True)
    stream_atomically(path, lambda file: file.write(data))


def _require_triangles(mesh: Mesh) -> None:
    if len(mesh.triangles) == 0:
        raise UsageError(
            "mesh-empty",
            what="The reconstructed object has no triangle to write.",
            remedy="Calibrate again with the object in the camera's view and in focus.",
        )


TO_BLENDER: Final = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""From the camera's frame (x right, y down, z forward) to Blender's world (x right, y forward, z up)."""
_LOOKING: Final = np.diag([1.0, -1.0, -1.0])


def margin_px(camera: Pinhole) -> int:
    """How much wider than the picture, on each side, a picture without distortion must be to hold all of it."""
    width, height = camera.size_px
    edge_x = np.concatenate([np.arange(width), np.arange(width), np.zeros(height), np.full(height, width - 1)])
    edge_y = np.concatenate([np.zeros(width), np.full(width, height - 1), np.arange(height), np.arange(height)])
    straight = camera.straightened(np.stack([edge_x, edge_y], axis=1).astype(np.float64))
    beyond = np.max([-straight.min(), *(straight.max(axis=0) - (width - 1, height - 1))])
    return max(0, math.ceil(float(beyond)) + 1)


def bend_picture(rendered: FloatImage, camera: Pinhole) -> FloatImage:
    """What the calibrated camera sees, (rows, columns, channels) float32, of a picture that ``scene_script`` rendered.

    ``rendered`` is larger than the camera's picture by ``margin_px`` on each side.
    """
    from scipy import ndimage

    at = places_in_rendering(camera)
    # splines, since OpenCV's remap rounds places to 1/32 px
    planes = [
        ndimage.map_coordinates(rendered[..., channel], (at[..., 1], at[..., 0]), order=3, mode="nearest")
        for channel in range(rendered.shape[2])
    ]
    return np.stack(planes, axis=2).astype(np.float32)


def places_in_rendering(camera: Pinhole) -> Float64:
    """(rows, columns, 2) float64: x and y, in a rendering with its margin, of what each camera pixel sees."""
    width, height = camera.size_px
    column, row = np.meshgrid(np.arange(width), np.arange(height))
    straight = camera.straightened(np.stack([column.ravel(), row.ravel()], axis=1).astype(np.float64))
    return (straight + margin_px(camera)).reshape(height, width, 2)


def scene_script(views: Sequence[tuple[str, Pinhole]], cameras: int, mesh_file: str) -> str:
    """Python for ``blender --python`` or for a Python with bpy; it reads ``mesh_file`` (.glb) from its own folder.

    ``views``: all by name, first the ``cameras``; ``-- --render FILE`` renders, ``-- --save FILE`` keeps a .blend.
    """
    made = [blender_camera(name, own, margin_px(own) if n < cameras else 0) for n, (name, own) in enumerate(views)]
    return _SCRIPT.replace("@MESH@", json.dumps(mesh_file)).replace("@VIEWS@", json.dumps(made, indent=4))


def blender_camera(name: str, own: Pinhole, margin: int) -> Mapping[str, object]:
    """A Blender camera: focal length and shift in widths of the rendered picture, and its matrix in the world."""
    width, height = own.size_px
    whole_width, whole_height = width + 2 * margin, height + 2 * margin
    # Blender measures focal length and shift in the larger side, where the sensor's fit is automatic; the script fixes
    # the fit to the width
    tall = float(own.matrix[0, 0] / own.matrix[1, 1])
    matrix = np.eye(4)
    matrix[:3, :3] = TO_BLENDER @ own.rotation.T @ _LOOKING
    matrix[:3, 3] = TO_BLENDER @ (-own.rotation.T @ own.translation_m)
    return {
        "name": name,
        "resolution": [whole_width, whole_height],
        "margin_px": margin,
        "pixel_aspect": tall,
        "focal_widths": float(own.matrix[0, 0]) / whole_width,
        "shift_x": ((width - 1) / 2 - float(own.matrix[0, 2])) / whole_width,
        "shift_y": (float(own.matrix[1, 2]) - (height - 1) / 2) * tall / whole_width,
        "matrix_world": matrix.tolist(),
    }


_SCRIPT: Final = '''\
"""A calibrated Velatura stage in Blender 4: blender --python scene.py, or python scene.py where bpy is installed.

After --: --render FILE renders the camera's view as it is lit (16-bit PNG, or EXR by its name), --save FILE keeps a
.blend. Rendered pictures have margin_px more on each side than the camera's, and no lens distortion.
"""

import sys
from pathlib import Path

import bpy
from mathutils import Matrix

MESH = @MESH@
VIEWS = @VIEWS@
SENSOR_MM = 36.0


def load_object(path):
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.import_scene.gltf(filepath=str(path))
    return next(thing for thing in bpy.data.objects if thing.type == "MESH")


def add_view(view):
    lens = bpy.data.cameras.new(view["name"])
    lens.sensor_fit = "HORIZONTAL"
    lens.sensor_width = SENSOR_MM
    lens.lens = view["focal_widths"] * SENSOR_MM
    lens.shift_x, lens.shift_y = view["shift_x"], view["shift_y"]
    lens.clip_start, lens.clip_end = 0.01, 100.0
    camera = bpy.data.objects.new(view["name"], lens)
    camera.matrix_world = Matrix(view["matrix_world"])
    bpy.context.scene.collection.objects.link(camera)
    return camera


def set_up(folder):
    load_object(folder / MESH)
    cameras = [add_view(view) for view in VIEWS]
    scene = bpy.context.scene
    scene.camera = cameras[0]
    scene.render.resolution_x, scene.render.resolution_y = VIEWS[0]["resolution"]
    scene.render.resolution_percentage = 100
    scene.render.pixel_aspect_x = max(1.0, 1.0 / VIEWS[0]["pixel_aspect"])
    scene.render.pixel_aspect_y = max(1.0, VIEWS[0]["pixel_aspect"])
    scene.unit_settings.system = "METRIC"
    scene.view_settings.view_transform = "Standard"
    scene.render.engine = "CYCLES"
    scene.cycles.samples = 64
    world = bpy.data.worlds.new("stage")
    world.use_nodes = True
    world.node_tree.nodes["Background"].inputs["Color"].default_value = (0.6, 0.6, 0.6, 1.0)
    scene.world = world
    return scene


def render(scene, path):
    image = scene.render.image_settings
    image.file_format = "OPEN_EXR" if path.suffix == ".exr" else "PNG"
    image.color_depth = "32" if path.suffix == ".exr" else "16"
    image.color_mode = "RGB"
    scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True)


def main(arguments):
    scene = set_up(Path(__file__).resolve().parent)
    for option, value in zip(arguments[::2], arguments[1::2]):
        if option == "--render":
            render(scene, Path(value).resolve())
        elif option == "--save":
            bpy.ops.wm.save_as_mainfile(filepath=str(Path(value).resolve()))
        else:
            sys.exit(f"unknown option {option}: --render FILE and --save FILE are known")


if __name__ == "__main__":
    main(sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else [])
'''
