"""``velatura export``: the reconstructed object and stage for other programs."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, Final

import numpy as np

from controller.artefacts.geometry import has_geometry, projectors_of, read_geometry
from controller.artefacts.projectors import Light
from controller.artefacts.published import exported_path
from controller.calibrate.mesh.blender import scene_script
from controller.calibrate.mesh.export import write_glb, write_ply
from controller.calibrate.mesh.grid_mesh import Mesh, grid_mesh
from controller.calibrate.values import Geometry
from controller.core.arrays import ByteImage
from controller.core.errors import UsageError
from controller.core.storage import write_atomically

FORMATS: Final = ("glb", "ply", "blender")
MOST_VERTICES: Final = 1_000_000
MESH, SCRIPT = "object.glb", "scene.py"


def export(*, run: Path, kind: str, out: Path | None, step: int | None) -> dict[str, Any]:
    """Write the geometry of a finished calibration run as ``kind``; ``out`` a file, for "blender" a folder.

    ``step``: every n-th camera pixel becomes a vertex; None: at most ``MOST_VERTICES`` vertices.

    Raises UsageError("export-format-unknown", "not-calibrated"), and as the writers.
    """
    if kind not in FORMATS:
        raise UsageError(
            "export-format-unknown",
            what=f"The export format {kind!r} is unknown.",
            remedy=f"Choose one of {', '.join(FORMATS)}.",
        )
    if not has_geometry(run):
        raise UsageError(
            "not-calibrated",
            what=f"{run} has no reconstructed geometry.",
            remedy="Give the folder of a finished calibration: STAGE/runs/...",
        )
    geometry = read_geometry(run)
    known = int(np.isfinite(geometry.points_m[..., 2]).sum())
    mesh = grid_mesh(geometry, step=step or max(1, math.ceil(math.sqrt(known / MOST_VERTICES))))
    names = tuple(projectors_of(run))
    target = out if out is not None else exported_path(run, kind)
    _write(kind, target, geometry, mesh, names, _picture(run, names))
    return {"written": target, "vertices": len(mesh.vertices_m), "triangles": len(mesh.triangles)}


def _write(
    kind: str, target: Path, geometry: Geometry, mesh: Mesh, names: tuple[str, ...], picture: ByteImage | None
) -> None:
    if kind == "ply":
        x, y = mesh.camera_px.astype(np.int64).T
        write_ply(target, mesh, None if picture is None else picture[y, x])
    elif kind == "glb":
        write_glb(target, mesh, geometry.camera.size_px, picture)
    else:
        write_glb(target / MESH, mesh, geometry.camera.size_px, picture)
        write_atomically(target / SCRIPT, scene_script(geometry, names, MESH).encode())


def _picture(run: Path, names: tuple[str, ...]) -> ByteImage | None:
    """The object in all projectors' white light, sRGB (rows, columns, 3); None if the run has no white images."""
    if not all(Light.path(run, name).is_file() for name in names):
        return None
    white = np.sum([np.nan_to_num(Light.read(run, name).white) for name in names], axis=0)
    linear = np.clip(white / max(float(np.quantile(white, 0.995)), 1e-12), 0.0, 1.0)
    curve = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return np.asarray(np.rint(255.0 * curve), dtype=np.uint8)
