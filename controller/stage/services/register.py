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

from controller.core.errors import UsageError
from controller.core.storage import sha256_of, write_atomically
from controller.optics.calibrate.mesh_alignment import Pairs, Pose
from controller.run.progress import Reporter
from controller.stage.artefacts.mesh import RegisteredMesh
from controller.stage.sessions.calibrations import finished_calibration
from controller.stage.steps.mesh import Guide, Surface, filled, lay_mesh
from hal.notices import Level
from hal.runtime.mesh_file import MeshUnreadable, read_mesh

UNITS: Final[Mapping[str, float]] = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "inch": 0.0254}
"""Metres."""
NEAR_UNIT: Final = 0.1
FARTHEST_PX: Final = 10
"""A click this near to a measured pixel means that pixel."""


@dataclass(frozen=True, slots=True)
class MeshOrder:
    """``unit`` of ``UNITS``, None: guessed; ``pairs``: (x, y, z of the mesh's file, x, y in the camera's picture);
    ``limit_mm``: most that the mesh may differ; ``fill``: whether it fills what no two projectors measured"""

    mesh: Path
    unit: str | None = None
    pairs: tuple[tuple[float, ...], ...] = ()
    limit_mm: float | None = None
    fill: bool = False


def register(stage: Path, order: MeshOrder, reporter: Reporter) -> Mapping[str, Any]:
    """Lay the mesh on the object, and write it with its figures into the run of the newest calibration.

    Raises UsageError("mesh-unreadable", "mesh-no-faces", "mesh-unit-wrong", "mesh-pair-beside"), and as ``lay_mesh``,
    ``Surface.read`` and ``finished_calibration``. Nothing is written then.
    """
    mesh = _read(order.mesh)
    run = finished_calibration(stage)
    surface = Surface.read(run)
    pairs = _on_object(order.pairs, surface) if order.pairs else None
    limit_m = None if order.limit_mm is None else 1e-3 * order.limit_mm
    mesh = lay_mesh(surface, mesh, Guide(None, pairs, limit_m))
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


def _read(path: Path) -> RegisteredMesh:
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


def _on_object(pairs: tuple[tuple[float, ...], ...], surface: Surface) -> Pairs:
    known_y, known_x = np.nonzero(surface.mask & np.isfinite(surface.points_m[..., 2]))
    places = []
    for number, (*_, x, y) in enumerate(pairs, start=1):
        far = np.hypot(known_x - x, known_y - y)
        nearest = int(far.argmin()) if len(far) else 0
        if not len(far) or far[nearest] > FARTHEST_PX:
            raise UsageError(
                "mesh-pair-beside",
                what=f"Nothing of the object was measured around camera pixel ({x:.0f}, {y:.0f}) of pair {number}.",
                remedy="Choose a place on the object that two projectors light, not at its edge.",
            )
        places.append(surface.points_m[known_y[nearest], known_x[nearest]])
    return Pairs(np.array([pair[:3] for pair in pairs]), np.array(places, np.float64))


def _unit(scale: float, named: str | None, *, known: bool) -> dict[str, Any]:
    """The unit of the file, and how large the mesh is beside the object. Raises UsageError("mesh-unit-wrong")."""
    if not known:
        return {"unit": named, "size": "not known: no length of the stage was measured"}
    nearest = min(UNITS, key=lambda unit: abs(math.log(scale / UNITS[unit])))
    is_near = abs(math.log(scale / UNITS[nearest])) < NEAR_UNIT
    if named is not None and abs(math.log(scale / UNITS[named])) > NEAR_UNIT:
        raise UsageError(
            "mesh-unit-wrong",
            what=f"In {named} the mesh would be {UNITS[named] / scale:.3g} times as large as the object.",
            remedy=f"Give --unit {nearest}." if is_near else "Leave out --unit, or check the mesh's scale.",
        )
    unit = named or (nearest if is_near else None)
    if unit is None:
        return {"unit": None, "size": f"1 in the file is {1e3 * scale:.4g} mm, which is no usual unit"}
    larger = 100 * (UNITS[unit] / scale - 1)
    return {
        "unit": unit,
        "size": f"in {unit}, {abs(larger):.2f} % {'larger' if larger > 0 else 'smaller'} than measured",
    }


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


def read_pairs(path: Path) -> tuple[tuple[float, ...], ...]:
    """Pairs in a JSON file, each five numbers as in ``MeshOrder``. Raises UsageError("mesh-pairs-file")."""
    try:
        pairs = tuple(tuple(float(number) for number in pair) for pair in json.loads(path.read_text("utf-8")))
        if len(pairs) >= 3 and all(len(pair) == 5 and all(map(math.isfinite, pair)) for pair in pairs):
            return pairs
        why = "it needs three or more lists of five numbers"
    except (OSError, ValueError, TypeError) as error:
        why = str(error)
    raise UsageError(
        "mesh-pairs-file",
        what=f"{path} has no pairs of points ({why}).",
        remedy="Write [[x, y, z, column, row], ...]: a point of the mesh, and the camera pixel that shows it.",
    )
