"""A known mesh laid on the object of a run: ``mesh.npz`` and ``mesh.json``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
import numpy.typing as npt

from controller.core.arrays import FloatImage, load_arrays, save_arrays
from controller.optics.calibrate.mesh_alignment import Pose, SolidMesh
from controller.optics.calibrate.values import Pinhole
from controller.optics.solve.targets.sheets import Places, mesh_places
from controller.stage.artefacts.names import json_path, npz_path, read_json, write_json

_MESH: Final = "mesh"


@dataclass(frozen=True, slots=True)
class RegisteredMesh:
    """A mesh, and where it stands.

    ``arrays``: ``vertices`` (V, 3) in the file's units; ``faces`` (F, 3) int32; ``uv`` (F, 3, 2) float32, if it has
    any; ``deviation_m`` (rows, columns) float32: by how much every ``step``-th measured point lies before the mesh, NaN
    where there is none or no mesh; ``filled_at`` (N,), ``filled_points_m`` and ``filled_normals`` (N, 3): camera
    pixels, numbered row by row, that have no measured point, and what the mesh says of them, if a person asked for it
    ``figures`` as in ``mesh.json``: ``file``, ``sha256``, ``unit``, how well it fits (docs/how-to/known-mesh.md)
    """

    arrays: Mapping[str, npt.NDArray[Any]]
    pose: Pose
    figures: Mapping[str, Any]

    def write(self, run: Path) -> None:
        """Replace the run's mesh."""
        save_arrays(npz_path(run, _MESH), self.arrays)
        self.write_figures(run)

    def write_figures(self, run: Path) -> None:
        """``mesh.json`` alone."""
        pose = [self.pose.scale, self.pose.rotation.tolist(), self.pose.shift_m.tolist()]
        write_json(json_path(run, _MESH), {"pose": dict(zip(Pose._fields, pose, strict=True)), **self.figures})

    @classmethod
    def read(cls, run: Path) -> Self | None:
        """None if no mesh was registered."""
        if not json_path(run, _MESH).is_file():
            return None
        figures = read_json(json_path(run, _MESH))
        scale, rotation, shift_m = figures.pop("pose").values()
        return cls(load_arrays(npz_path(run, _MESH)), Pose(scale, np.array(rotation), np.array(shift_m)), figures)

    @property
    def solid(self) -> SolidMesh:
        """The mesh for rays."""
        return SolidMesh(self.arrays["vertices"], self.arrays["faces"])

    @property
    def uv(self) -> FloatImage | None:
        """(F, 3, 2) places of the faces' corners on the sheet; None if the file has none."""
        return self.arrays.get("uv")

    def places(self, camera: Pinhole) -> Places:
        """Where the camera's pixels lie on the mesh's sheet. Raises KeyError without UV."""
        return mesh_places(self.solid, self.arrays["uv"], self.pose, camera)

    def fill(self, points_m: FloatImage, normals: FloatImage) -> tuple[FloatImage, FloatImage]:
        """Both (rows, columns, 3), with the mesh's where no projector pair measured any, if a person asked for that."""
        filled = np.array(points_m), np.array(normals)
        for image, name in zip(filled, ("filled_points_m", "filled_normals"), strict=True):
            if name in self.arrays:
                image.reshape(-1, 3)[self.arrays["filled_at"]] = self.arrays[name]
        return filled


def last_mesh(run: Path) -> RegisteredMesh | None:
    """The mesh of this run, or of the newest run before it in the same folder."""
    for one in sorted(run.parent.glob("*"), reverse=True):
        if one.name <= run.name and (mesh := RegisteredMesh.read(one)) is not None:
            return mesh
    return None
