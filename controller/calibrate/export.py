"""Meshes as files that other programs open: PLY (Stanford polygon format 1.0, binary little-endian)."""

from __future__ import annotations

from pathlib import Path
from typing import BinaryIO

import numpy as np
import numpy.typing as npt

from controller.calibrate.surface import Mesh
from controller.errors import UsageError
from controller.storage import stream_atomically

_VERTEX = [(name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")]
_COLOUR = [(name, "u1") for name in ("red", "green", "blue")]


def write_ply(path: Path, mesh: Mesh, colours: npt.NDArray[np.uint8] | None = None) -> None:
    """Write vertices in metres (camera frame: x right, y down, z forward), normals, triangles, and colours if given.

    ``colours`` (vertices, 3). Raises UsageError("mesh-empty", "mesh-colours-wrong-size"), WorkError("no-space").
    """
    if len(mesh.triangles) == 0:
        raise UsageError(
            "mesh-empty",
            what="The reconstructed object has no triangle to write.",
            remedy="Calibrate again with the object in the camera's view and in focus.",
        )
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


def _header(vertices: int, faces: int, coloured: bool) -> bytes:
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {vertices}"]
    lines += [f"property float {name}" for name, _ in _VERTEX]
    lines += [f"property uchar {name}" for name, _ in (_COLOUR if coloured else [])]
    lines += [f"element face {faces}", "property list uchar int vertex_indices", "end_header"]
    return ("\n".join(lines) + "\n").encode("ascii")
