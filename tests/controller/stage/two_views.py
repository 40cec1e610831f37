"""A run of two cameras before a bent, painted wall, from formulas: what each calibration would have left."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from controller.core.arrays import FloatImage, save_arrays
from controller.optics.calibrate.mesh_alignment import Pose
from controller.stage.artefacts.geometry import write_view_pose
from controller.stage.artefacts.projectors import Light, Pixels
from controller.stage.artefacts.views import view_folder, write_view
from lab.timings.tools.synthetic import TO_XYZ

Points = npt.NDArray[np.float64]
NAMES: Final = ("left", "right")
VIEWS: Final = ("front", "side")
CAMERA: Final = (180, 240)
PROJECTOR: Final = (90, 120)
"""(rows, columns)"""
FOCAL_PX: Final = {CAMERA: 260.0, PROJECTOR: 125.0}
BENT: Final = 0.25


def turned(degrees: float) -> Points:
    """(3, 3) around the vertical axis."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def looking(right_m: float, degrees: float) -> Pose:
    """From the first camera's frame to that of what stands so far to the right and is turned to the left."""
    turn = turned(degrees)
    return Pose(1.0, turn, -turn @ np.array([right_m, 0.0, 0.0]))


POSES: Final = {"front": looking(0, 0), "side": looking(0.35, 18), "left": looking(-0.3, -14), "right": looking(0.2, 9)}


def matrix(size: tuple[int, int]) -> Points:
    return np.array([[FOCAL_PX[size], 0, size[1] / 2], [0, FOCAL_PX[size], size[0] / 2], [0, 0, 1]])


def on_wall(pose: Pose, size: tuple[int, int]) -> Points:
    """(rows, columns, 3): what each pixel sees of the wall, in the first camera's frame."""
    y, x = np.mgrid[: size[0], : size[1]].astype(np.float64)
    way = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(matrix(size)).T @ pose.rotation
    eye = -pose.rotation.T @ pose.shift_m
    far = np.ones_like(x)
    for _ in range(40):
        at = eye + far[..., None] * way
        far = (1 + BENT * (at[..., 0] ** 2 + at[..., 1] ** 2) - eye[2]) / way[..., 2]
    return np.asarray(eye + far[..., None] * way)


def in_picture(points: Points, pose: Pose, size: tuple[int, int]) -> Points:
    """(..., 2) pixels."""
    seen = (points @ pose.rotation.T + pose.shift_m) @ matrix(size).T
    return np.asarray(seen[..., :2] / seen[..., 2:])


def write_two_views(run: Path, paint: Callable[[Points], FloatImage], gloss: float = 0.0) -> None:
    """``paint``: reflectance (..., 3) at places (..., 3) of the wall; ``gloss``: strength of the second camera's
    highlight of the left projector."""
    for number, view in enumerate(VIEWS):
        folder = run if number == 0 else view_folder(run, view)
        folder.mkdir(parents=True)
        pose = POSES[view]
        wall = on_wall(pose, CAMERA)
        normals = np.stack([2 * BENT * wall[..., 0], 2 * BENT * wall[..., 1], -np.ones(CAMERA)], axis=-1)
        normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
        reflectance: Points = paint(wall).astype(np.float64)
        for n, name in enumerate(NAMES):
            projector = POSES[name]
            towards = -projector.rotation.T @ projector.shift_m - wall
            far = np.linalg.norm(towards, axis=-1)
            lit = 0.4 * np.sum(towards * normals, axis=-1) / far**3
            at = in_picture(wall, projector, PROJECTOR)
            seen = np.all((at >= 0) & (at < (PROJECTOR[1], PROJECTOR[0])), axis=-1)
            white = reflectance * np.where(seen, lit, 0)[..., None]
            if gloss and number == 1 and n == 0:
                spot = np.exp(-0.5 * ((wall[..., 0] + 0.05) ** 2 + wall[..., 1] ** 2) / 0.03**2)
                white = white + gloss * (spot * np.where(seen, lit, 0))[..., None]
            black = np.full((*CAMERA, 3), 1e-4, np.float32)
            response, mixing = np.tile(np.linspace(0, 1, 256) ** 2.2, (3, 1)), np.eye(3)
            Light(response, mixing, white.astype(np.float32), black, TO_XYZ).write(folder, name)
            centre = in_picture(on_wall(projector, PROJECTOR), pose, CAMERA)
            valid = np.all((centre >= 0) & (centre < (CAMERA[1], CAMERA[0])), axis=-1)
            covariance = np.broadcast_to(np.array([0.9, 0, 0.9], np.float32), (*PROJECTOR, 3)).copy()
            px = np.where(seen[..., None], at, np.nan).astype(np.float32)
            spread = np.broadcast_to(np.array([0.19, 0, 0.19], np.float32), (*PROJECTOR, 3)).copy()
            Pixels(px, seen.astype(np.float32), seen, centre.astype(np.float32), covariance, valid, px, spread,
                   np.array([[0, 1], [1, 2]])).write(folder, name)  # fmt: skip
        write_geometry_of(folder, wall, normals, pose)
        write_view(folder, view, number)
        write_view_pose(folder, pose)


def write_geometry_of(folder: Path, wall: Points, normals: Points, pose: Pose) -> None:
    """In the frame of the view whose ``pose`` is given."""
    own = (wall @ pose.rotation.T + pose.shift_m).astype(np.float32)
    save_arrays(folder / "geometry.npz", {"points_m": own, "normals": (normals @ pose.rotation.T).astype(np.float32)})
    projectors = {}
    for name in NAMES:
        turn = POSES[name].rotation @ pose.rotation.T
        projectors[name] = pinhole(PROJECTOR, turn, POSES[name].shift_m - turn @ pose.shift_m)
    poses = {"camera": pinhole(CAMERA, np.eye(3), np.zeros(3)), "projectors": projectors}
    (folder / "geometry.json").write_text(json.dumps(poses | {"reprojection_rms_px": 0.03, "scale_known": True}))
    grade = {name: {"relative_rms": 0.012, "grade": "A", "reasons": []} for name in NAMES}
    (folder / "verification.json").write_text(json.dumps(grade))


def pinhole(size: tuple[int, int], turn: Points, shift_m: Points) -> dict[str, object]:
    """As geometry.json has it."""
    return {"matrix": matrix(size).tolist(), "distortion": [0.0, 0.0], "rotation": turn.tolist(),
            "translation_m": shift_m.tolist(), "size_px": [size[1], size[0]]}  # fmt: skip
