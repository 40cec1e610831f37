"""Meshes that a person lays on the calibrated object by the same places on both: how they look, and where they lie."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from controller.core.errors import UsageError
from controller.core.storage import write_atomically
from controller.kiosk.values import LaidMesh
from controller.optics.calibrate.mesh_alignment import Pose, SolidMesh, rays_of
from controller.optics.calibrate.values import Pinhole
from controller.run.progress import Silent
from controller.stage.artefacts.geometry import read_camera
from controller.stage.artefacts.mesh import RegisteredMesh
from controller.stage.services.register import MeshOrder, read_known_mesh, register_in
from controller.stage.sessions.calibrations import finished_calibration

OWN: Final = "meshes"
"""The stage's folder of them."""
NAME: Final = r"[A-Za-z0-9][A-Za-z0-9 ._-]{0,47}\.(obj|glb|gltf|ply|stl)"
FOLDER: Final = "kiosk/meshes"
TURNS: Final = 8
"""Of a mesh about its upright axis; then it is tipped over by a quarter, four times."""
SIDE_PX: Final = 720
AWAY: Final = 6.0
"""Sizes of the mesh from the camera to it."""
FILLS: Final = 0.92
"""Of the picture."""
_FOCAL, _MIDDLE = FILLS * AWAY * SIDE_PX, 0.5 * (SIDE_PX - 1)
VIEWER: Final = Pinhole(
    np.array([[_FOCAL, 0, _MIDDLE], [0, _FOCAL, _MIDDLE], [0, 0, 1]]),
    np.zeros(2), np.eye(3), np.zeros(3), (SIDE_PX, SIDE_PX),
)  # fmt: skip
"""What sees a mesh."""
LAID_PX: Final = 1200
LIGHT: Final = np.array([-0.4, -0.5, -0.77])
"""From where a mesh is lit in pictures."""


def meshes(stage: Path) -> tuple[str, ...]:
    """Their files by name."""
    return tuple(sorted(one.name for one in (stage / OWN).glob("*") if re.fullmatch(NAME, one.name, re.IGNORECASE)))


def mesh_picture(stage: Path, mesh: str, side: int) -> Path:
    """A grey picture (PNG) of a mesh from one of 32 sides, kept until the file changes. Raises as ``register_in``, and
    UsageError("mesh-unknown").
    """
    file = _file(stage, mesh)
    kept = stage / FOLDER / f"{mesh}-{side}-{file.stat().st_mtime_ns}.png"
    if not kept.is_file():
        kept.parent.mkdir(parents=True, exist_ok=True)
        for old in kept.parent.glob(f"{mesh}-{side}-*.png"):
            old.unlink(missing_ok=True)
        solid = read_known_mesh(file).solid
        _draw(kept, solid, seen_from(solid, side), VIEWER, 1)
    return kept


def lay_mesh(stage: Path, mesh: str, side: int, points: str) -> None:
    """Lay a mesh on the object by ``points`` (JSON): x, y in its picture, x, y in the camera's view, each 0 to 1.

    None: by itself. Raises as ``register_in``, and UsageError("mesh-unknown", "mesh-pairs-file", "mesh-pair-beside").
    """
    file, run = _file(stage, mesh), finished_calibration(stage)
    try:
        given = np.array(json.loads(points or "[]"), np.float64).reshape(-1, 4)
    except (ValueError, TypeError, RecursionError):
        raise UsageError("mesh-pairs-file", what="The points are not pairs of places.",
                         remedy="Choose at least four places on the mesh and on the object.") from None  # fmt: skip
    pairs = None
    if len(given):
        solid = read_known_mesh(file).solid
        pose, rays = seen_from(solid, side), rays_of(VIEWER, *(SIDE_PX * given[:, :2] - 0.5).T)
        depth = solid.met_by(rays, pose).depth
        if not np.isfinite(depth).all():
            raise UsageError("mesh-pair-beside", what=f"Point {1 + int(np.isnan(depth).argmax())} is beside the mesh.",
                             remedy="Choose a place on the mesh, not at its edge.")  # fmt: skip
        on_mesh = (rays * depth[:, None] - pose.shift_m) @ pose.rotation / pose.scale
        pairs = np.hstack([on_mesh, given[:, 2:] * read_camera(run).size_px - 0.5])
    register_in(run, MeshOrder(file, pairs=pairs), Silent())


def laid_mesh(stage: Path) -> LaidMesh | None:
    """The mesh that lies on the object, with a picture of it in the camera's view; None without any."""
    run = finished_calibration(stage)
    found = RegisteredMesh.read(run)
    if found is None:
        return None
    figures, picture = found.figures, run / "mesh-laid.png"
    if not picture.is_file() or picture.stat().st_mtime_ns < (run / "mesh.json").stat().st_mtime_ns:
        camera = read_camera(run)
        _draw(picture, found.solid, found.pose, camera, max(1, camera.size_px[0] // LAID_PX))
    return LaidMesh(figures["file"], figures["median_off_mm"], figures["most_off_mm"], figures["size"],
                    {"laid": picture, "map": run / "mesh.png"})  # fmt: skip


def _file(stage: Path, mesh: str) -> Path:
    if mesh not in meshes(stage):
        raise UsageError("mesh-unknown", what=f"There is no mesh {mesh[:64]!r}.",
                         remedy=f"Copy its file into the folder {OWN} of the stage.")  # fmt: skip
    return stage / OWN / mesh


def seen_from(solid: SolidMesh, side: int) -> Pose:
    """Where ``VIEWER`` sees a mesh. Upright is y at side 0 to 7, as most files have it."""
    tip, turn = divmod(side, TURNS)
    ways = (90.0 * tip, 0.0, 0.0), (0.0, 360.0 / TURNS * turn, 0.0)
    about_x, about_y = (cv2.Rodrigues(np.deg2rad(way))[0] for way in ways)
    rotation = np.asarray(np.diag([1.0, -1, -1]) @ about_y @ about_x, np.float64)
    turned = solid.vertices[np.unique(solid.faces)] @ rotation.T
    low, high = turned.min(axis=0), turned.max(axis=0)
    scale = 1 / float((high - low)[:2].max())
    nearest = np.append(0.5 * (low + high)[:2], low[2])
    return Pose(scale, rotation, np.array([0, 0, AWAY]) - scale * nearest)


def _draw(file: Path, solid: SolidMesh, pose: Pose, camera: Pinhole, step: int) -> None:
    """At every so many pixels of the camera: light from the upper left, and nothing beside the mesh."""
    y, x = np.mgrid[0 : camera.size_px[1] : step, 0 : camera.size_px[0] : step]
    met = solid.met_by(rays_of(camera, x.ravel(), y.ravel()), pose)
    is_on = met.face >= 0
    grey = 40 + 200 * np.clip(np.nan_to_num(met.normals) @ LIGHT, 0, 1)
    picture = np.stack([grey, grey, grey, np.full(len(grey), 255)], axis=1) * is_on[:, None]
    write_atomically(file, cv2.imencode(".png", picture.reshape(*x.shape, 4).astype(np.uint8))[1].tobytes())
