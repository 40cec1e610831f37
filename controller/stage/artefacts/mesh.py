"""A known mesh laid on the object of a run: ``mesh.npz`` and ``mesh.json``; what it fills: ``mesh-filled.npz``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
import numpy.typing as npt

from controller.core.arrays import Float64, FloatImage, load_arrays, save_arrays
from controller.core.storage import sha256_of
from controller.optics.calibrate.mesh_alignment import Pose, SolidMesh
from controller.optics.calibrate.values import Pinhole
from controller.optics.solve.targets.sheets import Places, mesh_places
from controller.stage.artefacts.names import json_path, npz_path, read_json, write_json

_MESH: Final = "mesh"
_FILLED: Final = "filled"


@dataclass(frozen=True, slots=True)
class RegisteredMesh:
    """A mesh, and where it stands.

    ``vertices`` (V, 3) in the file's units; ``faces`` (F, 3) int32; ``uv`` (F, 3, 2) float32, None without
    ``deviation_m`` (rows, columns) float32: by how much every ``step``-th measured point lies before the mesh, NaN
    where there is none or no mesh
    ``figures`` as in ``mesh.json``: ``file``, ``sha256``, ``unit``, how well it fits (docs/reference/report.md)
    """

    vertices: Float64
    faces: npt.NDArray[np.int32]
    uv: FloatImage | None
    pose: Pose
    deviation_m: FloatImage
    figures: Mapping[str, Any]

    def write(self, run: Path) -> None:
        """What an earlier mesh filled is no longer so."""
        npz_path(run, _MESH, _FILLED).unlink(missing_ok=True)
        arrays: dict[str, npt.NDArray[Any]] = {"vertices": self.vertices, "faces": self.faces}
        arrays |= {"deviation_m": self.deviation_m} | ({} if self.uv is None else {"uv": self.uv})
        save_arrays(npz_path(run, _MESH), arrays)
        self.write_figures(run)

    def write_figures(self, run: Path) -> None:
        """``mesh.json`` alone."""
        pose = {
            "scale": self.pose.scale,
            "rotation": self.pose.rotation.tolist(),
            "shift_m": self.pose.shift_m.tolist(),
        }
        write_json(json_path(run, _MESH), {"pose": pose, **self.figures})

    @classmethod
    def read(cls, run: Path) -> Self | None:
        """None if no mesh was registered."""
        if not json_path(run, _MESH).is_file():
            return None
        arrays, figures = load_arrays(npz_path(run, _MESH)), read_json(json_path(run, _MESH))
        pose = figures.pop("pose")
        at = Pose(pose["scale"], np.array(pose["rotation"], np.float64), np.array(pose["shift_m"], np.float64))
        return cls(arrays["vertices"], arrays["faces"], arrays.get("uv"), at, arrays["deviation_m"], figures)

    @property
    def solid(self) -> SolidMesh:
        """The mesh for rays."""
        return SolidMesh(self.vertices, self.faces)

    def places(self, camera: Pinhole) -> Places:
        """Where the camera's pixels lie on the mesh's sheet. It must have UV."""
        assert self.uv is not None
        return mesh_places(self.solid, self.uv, self.pose, camera)


def last_mesh(run: Path) -> RegisteredMesh | None:
    """The mesh of this run, or of the newest run before it in the same folder."""
    for one in sorted(run.parent.glob("*"), reverse=True):
        if one.name <= run.name and (mesh := RegisteredMesh.read(one)) is not None:
            return mesh
    return None


def write_filled(run: Path, at: npt.NDArray[np.int64], points_m: FloatImage, normals: FloatImage) -> None:
    """Points and normals (N, 3) of the mesh at camera pixels ``at`` (N,), numbered row by row, that have none."""
    save_arrays(npz_path(run, _MESH, _FILLED), {"at": at, "points_m": points_m, "normals": normals})


def filled_digest(run: Path) -> str | None:
    """What identifies that file; None without it."""
    path = npz_path(run, _MESH, _FILLED)
    return sha256_of(path) if path.is_file() else None


def fill(run: Path, points_m: FloatImage, normals: FloatImage) -> tuple[FloatImage, FloatImage]:
    """Both (rows, columns, 3), with the mesh's where no projector pair measured any, if a person asked for that."""
    path = npz_path(run, _MESH, _FILLED)
    if not path.is_file():
        return points_m, normals
    arrays = load_arrays(path)
    points_m, normals = np.array(points_m), np.array(normals)
    points_m.reshape(-1, 3)[arrays["at"]] = arrays["points_m"]
    normals.reshape(-1, 3)[arrays["at"]] = arrays["normals"]
    return points_m, normals
