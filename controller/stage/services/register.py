"""``velatura register``: a known mesh laid on the object of a stage's newest calibration."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
import numpy.typing as npt

from controller.core.arrays import Float64
from controller.core.errors import UsageError
from controller.core.storage import sha256_of, write_atomically
from controller.optics.calibrate.mesh_alignment import Pairs, Pose
from controller.run.progress import Reporter
from controller.stage.artefacts.mesh import RegisteredMesh
from controller.stage.sessions.calibrations import finished_calibration
from controller.stage.steps.mesh import Surface, filled, lay_mesh
from hal.notices import Level
from hal.runtime.mesh_file import MeshUnreadable, read_mesh

UNITS: Final[Mapping[str, float]] = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "inch": 0.0254}
"""Metres."""
NEAR_UNIT: Final = 0.1
FARTHEST_PX: Final = 10
"""A click this near to a measured pixel means that pixel."""


@dataclass(frozen=True, slots=True)
class MeshOrder:
    """``unit`` of ``UNITS``, None: guessed; ``pairs``: a JSON file (docs/how-to/known-mesh.md), or what it holds;
    ``limit_mm``: most that the mesh may differ; ``fill``: whether it fills what no two projectors measured"""

    mesh: Path
    unit: str | None = None
    pairs: Path | Float64 | None = None
    limit_mm: float | None = None
    fill: bool = False


def register(stage: Path, order: MeshOrder, reporter: Reporter) -> Mapping[str, Any]:
    """Lay the mesh on the object of the newest calibration. Raises as ``register_in`` and ``finished_calibration``."""
    return register_in(finished_calibration(stage), order, reporter)


def register_in(run: Path, order: MeshOrder, reporter: Reporter) -> Mapping[str, Any]:
    """Lay the mesh on the object, and write it with its figures into ``run``, whose geometry is known.

    Raises UsageError("mesh-unreadable", "mesh-no-faces", "mesh-unit-wrong", "mesh-pairs-file", "mesh-pair-beside"), and
    as ``lay_mesh`` and ``Surface.read``. Nothing is written then.
    """
    mesh = read_known_mesh(order.mesh)
    surface = Surface.read(run)
    pairs = None if order.pairs is None else _pairs(order.pairs, surface)
    limit_m = None if order.limit_mm is None else 1e-3 * order.limit_mm
    mesh = lay_mesh(surface, mesh, pairs, limit_m)
    mesh = replace(mesh, figures={**mesh.figures, **_unit(mesh.pose.scale, order.unit, known=surface.scale_known)})
    mesh = filled(surface, mesh) if order.fill else mesh
    mesh.write(run)
    for sentence in _warnings(mesh):
        reporter.say(sentence, Level.WARNING)
    picture, figures = run / "mesh.png", mesh.figures
    # red before the mesh, blue behind it, white where both agree, grey elsewhere
    level = np.clip(mesh.arrays["deviation_m"] / (1e-3 * figures["limit_mm"]), -1, 1)[..., None]
    colours = 255 * (1 - np.abs(level) * np.where(level > 0, (1, 1, 0), (0, 1, 1)))
    drawn = np.where(np.isfinite(level), colours, 96).astype(np.uint8)
    write_atomically(picture, cv2.imencode(".png", drawn)[1].tobytes())
    return {
        "run": run,
        "differs": f"{figures['median_off_mm']:.2g} mm (median), {figures['most_off_mm']:.2g} mm (95 % of the points)",
        "size": figures["size"],
        "worst": f"around camera pixel {tuple(figures['worst_px'])}",
        "filled_pixels": figures.get("filled_pixels", 0),
        "map": picture,
    }


def read_known_mesh(path: Path) -> RegisteredMesh:
    """A mesh that lies nowhere yet. Raises UsageError("mesh-unreadable", "mesh-no-faces")."""
    try:
        mesh = read_mesh(path, coloured=False)
    except MeshUnreadable as error:
        raise UsageError(
            "mesh-unreadable",
            what=f"{path} can't be read as a mesh ({error}).",
            remedy="Check the file, or export it again as OBJ, glTF (.glb), PLY or STL.",
        ) from error
    a, b, c = (mesh.vertices[mesh.faces[:, corner]] for corner in range(3))
    full = np.linalg.norm(np.cross(b - a, c - a), axis=1) > 0
    if not full.any():
        raise UsageError(
            "mesh-no-faces",
            what=f"{path} has no faces with an area, so there is no surface to lay on the object.",
            remedy="Export the object as a triangle mesh, not as a point cloud.",
        )
    arrays: dict[str, npt.NDArray[Any]] = {"vertices": mesh.vertices, "faces": mesh.faces[full]}
    if mesh.uv is not None:
        arrays["uv"] = mesh.uv[full]
    nowhere = Pose(1.0, np.eye(3), np.zeros(3))
    return RegisteredMesh(arrays, nowhere, {"file": path.name, "sha256": sha256_of(path)})


def _pairs(given: Path | Float64, surface: Surface) -> Pairs:
    source = given if isinstance(given, Path) else "The list"
    try:
        rows = json.loads(given.read_text("utf-8")) if isinstance(given, Path) else given
        pairs = np.array(rows, np.float64)
        right = len(pairs) > 2 and pairs.shape[1:] == (5,) and np.isfinite(pairs).all()
        why = "" if right else "it needs three or more lists of five numbers"
    except (OSError, ValueError, TypeError) as error:
        why = str(error)
    if why:
        raise UsageError(
            "mesh-pairs-file",
            what=f"{source} has no pairs of points ({why}).",
            remedy="Write [[x, y, z, column, row], ...]: a point of the mesh, and the camera pixel that shows it.",
        )
    known = np.argwhere(surface.mask & np.isfinite(surface.points_m[..., 2]))
    far = np.linalg.norm(known[None] - pairs[:, None, :2:-1], axis=2)
    for number, far_px in enumerate(far.min(axis=1, initial=np.inf), start=1):
        if far_px > FARTHEST_PX:
            raise UsageError(
                "mesh-pair-beside",
                what=f"Nothing of the object was measured near the camera pixel of pair {number}.",
                remedy="Choose a place on the object that two projectors light, not at its edge.",
            )
    return Pairs(pairs[:, :3], surface.points_m[tuple(known[far.argmin(axis=1)].T)].astype(np.float64))


def _unit(scale: float, named: str | None, *, known: bool) -> dict[str, Any]:
    """The unit of the file, and how large the mesh is beside the object. Raises UsageError("mesh-unit-wrong")."""
    if not known:
        return {"unit": named, "size": "not known: no length of the stage was measured"}
    nearest = min(UNITS, key=lambda unit: abs(math.log(scale / UNITS[unit])))
    unit = named or nearest
    larger = UNITS[unit] / scale
    is_near = abs(math.log(larger)) < NEAR_UNIT
    if named is not None and not is_near:
        raise UsageError(
            "mesh-unit-wrong",
            what=f"In {named} the mesh would be {larger:.3g} times as large as the object.",
            remedy=f"Leave out --unit, or give --unit {nearest} if its numbers are in {nearest}.",
        )
    size = f"in {unit}, {larger:.4f} times as large as the object"
    return {"unit": unit if is_near else None, "size": size if is_near else f"1 in the file is {1e3 * scale:.4g} mm"}


def _warnings(mesh: RegisteredMesh) -> list[str]:
    figures, said = mesh.figures, []
    if figures["contradicted_share"] > 0.002:
        said.append(
            f"{100 * figures['contradicted_share']:.1f} % of the measured points lie more than "
            f"{figures['limit_mm']:.3g} mm from the mesh. There the measurement counts."
        )
    if figures["faces_flipped"]:
        said.append("The mesh's faces point inwards. Its outside was taken from what the camera sees.")
    if figures["holes_share"] > 0.001:
        said.append(f"The camera looks through holes of the mesh at {100 * figures['holes_share']:.1f} % of it.")
    if mesh.uv is None:
        said.append("The mesh has no UV, so no texture can be painted on it. Unwrap it in a 3D program to have one.")
    elif mesh.uv.min() < -1e-3 or mesh.uv.max() > 1 + 1e-3:
        said.append("The mesh's UV lies on several tiles. One sheet repeats on all of them.")
    return said
