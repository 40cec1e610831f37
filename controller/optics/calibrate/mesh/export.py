"""Meshes as files that other programs open: PLY (Stanford polygon format 1.0, binary little-endian) and glTF 2.0."""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from controller.core.errors import UsageError
from controller.core.storage import stream_atomically
from controller.optics.calibrate.mesh.grid_mesh import Mesh

OBJECT = "object"
"""The mesh's name in glTF files and in Blender."""


class View(NamedTuple):
    """A node of a glTF file without a mesh: ``matrix`` (4, 4) its pose, ``extras`` what it says of itself."""

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
    whole = trimesh.Trimesh(
        vertices=mesh.vertices_m * turned,
        faces=mesh.triangles,
        vertex_normals=mesh.normals * turned,
        visual=trimesh.visual.TextureVisuals(uv=uv, material=material),
        process=False,
    )
    scene = trimesh.Scene()
    scene.add_geometry(whole, node_name=OBJECT, geom_name=OBJECT)
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
