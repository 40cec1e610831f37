"""Meshes as files that other programs open: PLY (Stanford polygon format 1.0, binary little-endian) and glTF 2.0."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from controller.calibrate.surface import Mesh
from controller.errors import UsageError
from controller.storage import stream_atomically

OBJECT = "object"
"""The mesh's name in glTF files and in Blender."""
_VERTEX = [(name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")]
_COLOUR = [(name, "u1") for name in ("red", "green", "blue")]


def write_ply(path: Path, mesh: Mesh, colours: npt.NDArray[np.uint8] | None = None) -> None:
    """Write vertices in metres (camera frame: x right, y down, z forward), normals, triangles, and colours if given.

    ``colours`` (vertices, 3). Raises UsageError("mesh-empty", "mesh-colours-wrong-size"), WorkError("no-space").
    """
    _require_triangles(mesh)
    if colours is not None and colours.shape != mesh.vertices_m.shape:
        raise UsageError(
            "mesh-colours-wrong-size",
            what=f"There are colours of shape {colours.shape} for vertices of shape {mesh.vertices_m.shape}.",
            remedy="Give one red, green and blue value a vertex.",
        )
    vertices = np.empty(len(mesh.vertices_m), dtype=_VERTEX + (_COLOUR if colours is not None else []))
    for axis, name in enumerate("xyz"):
        vertices[name], vertices[f"n{name}"] = mesh.vertices_m[:, axis], mesh.normals[:, axis]
    for channel, (name, _) in enumerate(_COLOUR if colours is not None else []):
        assert colours is not None
        vertices[name] = colours[:, channel]
    faces = np.empty(len(mesh.triangles), dtype=[("count", "u1"), ("corners", "<i4", (3,))])
    faces["count"], faces["corners"] = 3, mesh.triangles

    def write(file: BinaryIO) -> None:
        file.write(_header(len(vertices), len(faces), colours is not None))
        file.write(vertices.tobytes())
        file.write(faces.tobytes())

    stream_atomically(path, write)


def write_glb(path: Path, mesh: Mesh, size_px: tuple[int, int], texture: npt.NDArray[np.uint8] | None = None) -> None:
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
    data: bytes = scene.export(file_type="glb", include_normals=True)
    stream_atomically(path, lambda file: file.write(data))


def _require_triangles(mesh: Mesh) -> None:
    if len(mesh.triangles) == 0:
        raise UsageError(
            "mesh-empty",
            what="The reconstructed object has no triangle to write.",
            remedy="Calibrate again with the object in the camera's view and in focus.",
        )


def _header(vertices: int, faces: int, coloured: bool) -> bytes:
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {vertices}"]
    lines += [f"property float {name}" for name, _ in _VERTEX]
    lines += [f"property uchar {name}" for name, _ in (_COLOUR if coloured else [])]
    lines += [f"element face {faces}", "property list uchar int vertex_indices", "end_header"]
    return ("\n".join(lines) + "\n").encode("ascii")
