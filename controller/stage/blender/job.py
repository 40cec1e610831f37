"""What Blender is given to render, as files: the reconstructed object in the calibrated camera's view."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import cv2
import numpy as np
import numpy.typing as npt

from controller.core.arrays import FloatImage, Mask, save_arrays
from controller.core.blur import nearest_known
from controller.core.errors import WorkError
from controller.core.storage import write_atomically
from controller.optics.calibrate.mesh import TO_BLENDER, Mesh, blender_camera, grid_mesh, margin_px, places_in_rendering
from controller.optics.calibrate.values import Geometry, Pinhole
from controller.optics.solve.targets.relight import smooth_normals
from controller.optics.solve.targets.values import Target

BUILTIN: Final = ("marble", "gold", "glazed", "lowered-head")
"""The scenes of ``scenes.py``."""
MOST_VERTICES: Final = 400_000
THICKNESS: Final = 0.2
"""Of the object behind the visible surface, as a share of its size: light that enters must not leave there."""
FURTHEST_FILL_PX: Final = 8.0
"""Seams between parts at different depths are filled from this far away."""
BRIGHTEST_PERCENT: Final = 97.0
SMOOTHING_PX: Final = 2.0
"""Standard deviation of the smoothing of the normals; their noise would glitter in a glaze."""


@dataclass(frozen=True, slots=True)
class RenderSettings:
    """``samples`` a pixel at most (noise decides); ``threads`` 0 takes all cores; ``seed`` of the sampling."""

    samples: int = 96
    seed: int = 1
    denoise: bool = True
    threads: int = 0


def write_job(
    folder: Path,
    geometry: Geometry,
    mask: Mask,
    paint: FloatImage,
    *,
    scene: str | Path,
    settings: RenderSettings,
    view: Pinhole | None = None,
) -> None:
    """Write ``job.json`` and ``mesh.npz`` into ``folder``.

    Parameters
    ----------
    geometry : its camera may stand anywhere; all views of a stage are in the first one's frame, which is Blender's
    mask : (camera rows, columns), the object
    paint : (camera rows, columns, 3), of ``own_paint``
    scene : the name of one of ``BUILTIN``, or a .blend file
    view : the camera of the picture; by default the calibrated one, whose picture a quick look needs only small

    Raises WorkError("target-no-geometry") when too little of the object's shape is known.
    """
    turn, shift_m = (one.astype(np.float32) for one in (geometry.camera.rotation, geometry.camera.translation_m))
    own = dataclasses.replace(
        geometry, points_m=geometry.points_m @ turn.T + shift_m, normals=geometry.normals @ turn.T
    )
    mesh = _surface(own, mask)
    rows, columns = mask.shape
    column, row = np.round(mesh.camera_px).astype(int).T
    vertices_m = upright((np.concatenate([mesh.vertices_m, _behind(mesh.vertices_m)]) - shift_m) @ turn)
    save_arrays(
        folder / "mesh.npz",
        {
            "vertices_m": vertices_m,
            "normals": upright(np.concatenate([mesh.normals, -mesh.normals]) @ turn),
            "triangles": solid(mesh.triangles, len(mesh.vertices_m)),
            "uv": np.tile(np.stack([(column + 0.5) / columns, 1 - (row + 0.5) / rows], axis=1), (2, 1)),
            "reflectance": np.tile(paint[row, column], (2, 1)),
        },
    )
    view, depth_m = geometry.camera if view is None else view, mesh.vertices_m[:, 2]
    clip = {"near_m": float(depth_m.min()) * 0.2, "far_m": float(depth_m.max()) * 20}
    job = {
        "builtin": scene if isinstance(scene, str) else None,
        "scene_file": None if isinstance(scene, str) else str(scene.resolve()),
        "camera": {**blender_camera("calibrated", view, margin_px(view)), **clip},
        "bounds_m": [vertices_m.min(axis=0).tolist(), vertices_m.max(axis=0).tolist()],
        **dataclasses.asdict(settings),
    }
    write_atomically(folder / "job.json", json.dumps(job, indent=1).encode())


def light_alike(folders: Sequence[Path]) -> None:
    """Let the jobs in these folders, of several views of one object, have one size of it, which the lights follow."""
    jobs = [json.loads((folder / "job.json").read_bytes()) for folder in folders]
    low, high = (np.array([job["bounds_m"][end] for job in jobs]) for end in (0, 1))
    bounds_m = [low.min(axis=0).tolist(), high.max(axis=0).tolist()]
    for folder, job in zip(folders, jobs, strict=True):
        write_atomically(folder / "job.json", json.dumps({**job, "bounds_m": bounds_m}, indent=1).encode())


def upright(vectors: FloatImage) -> FloatImage:
    """(..., 3) from the camera's frame to Blender's world."""
    return np.ascontiguousarray(vectors @ TO_BLENDER.T, dtype=np.float32)


def _surface(geometry: Geometry, mask: Mask) -> Mesh:
    """The object's known surface, smoothed, with at most about ``MOST_VERTICES``. Raises as ``write_job``."""
    normals, _, known = smooth_normals(geometry, mask, SMOOTHING_PX, reach_px=0)
    shape = dataclasses.replace(geometry, normals=np.where(known[..., None], normals, np.nan).astype(np.float32))
    step = max(1, math.ceil(math.sqrt(np.count_nonzero(known) / MOST_VERTICES)))
    mesh = grid_mesh(shape, step=step)
    if len(mesh.triangles) == 0:
        raise WorkError(
            "target-no-geometry",
            what="Too little of the object's shape is known for a rendering.",
            remedy="Calibrate again with better overlap of the projectors, or use a finished picture as the target.",
        )
    return mesh


def _behind(vertices_m: FloatImage) -> FloatImage:
    """The back's vertices: each on its own line of sight, so that the front hides the whole back."""
    low, high = np.percentile(vertices_m, [2, 98], axis=0)
    thickness = THICKNESS * float(np.max(high - low))
    distance = np.linalg.norm(vertices_m, axis=1, keepdims=True)
    return np.asarray(vertices_m * (1 + thickness / np.maximum(distance, 1e-9)), np.float32)


def solid(triangles: npt.NDArray[np.int32], vertices: int) -> npt.NDArray[np.int32]:
    """Close a surface: ``triangles`` (n, 3) of the front, the same of the back (vertex + ``vertices``, turned round),
    and walls between them along every edge that only one triangle has."""
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]).astype(np.int64)
    key = edges.min(axis=1) * vertices + edges.max(axis=1)
    _, first, count = np.unique(key, return_index=True, return_counts=True)
    a, b = edges[first[count == 1]].T
    walls = [np.stack([b, a, a + vertices], axis=1), np.stack([b, a + vertices, b + vertices], axis=1)]
    return np.concatenate([triangles, triangles[:, ::-1] + vertices, *walls]).astype(np.int32)


def own_paint(geometry: Geometry, light: FloatImage) -> FloatImage:
    """(rows, columns, 3) reflectance in [0.02, 0.95]: the light that comes back over the light that arrives.

    ``light`` (rows, columns, 3): what the camera sees under the white of all projectors
    What arrives is taken as falling with the square of the distance and the cosine (Lambert), the same from every
    projector, which is right but for one factor; the palest places are given 0.9.
    """
    arrives = np.zeros(light.shape[:2], np.float32)
    for projector in geometry.projectors:
        centre = (-projector.rotation.T @ projector.translation_m).astype(np.float32)
        towards = centre - geometry.points_m
        distance = np.linalg.norm(towards, axis=2)
        cosine = np.sum(towards * geometry.normals, axis=2) / np.maximum(distance, 1e-6)
        arrives += np.nan_to_num(np.maximum(cosine, 0) / np.maximum(distance, 1e-6) ** 2)
    known = arrives > 0.05 * arrives.max(initial=0)
    ratio = np.where(known[..., None], light / np.maximum(arrives, 1e-9)[..., None], 0)
    palest = np.percentile(ratio[known], 98) if known.any() else 1.0
    paint: FloatImage = np.clip(0.9 * ratio / max(float(palest), 1e-9), 0.02, 0.95).astype(np.float32)
    return paint


def as_seen(pictures: Sequence[FloatImage], cameras: Sequence[Pinhole], masks: Sequence[Mask]) -> list[Target]:
    """The rendered pictures (rows, columns, 4; transparent where no object is) as the calibrated cameras see them.

    They are scaled alike, so that all but their highlights lie below 1, and clipped at 1.5; the exposure is the
    solver's.
    """
    seen = [_seen(*one) for one in zip(pictures, cameras, strict=True)]
    levels = [colour[mask & covered].max(axis=1) for (colour, covered), mask in zip(seen, masks, strict=True)]
    bright = np.concatenate(levels)
    scale = max(float(np.percentile(bright, BRIGHTEST_PERCENT)), 1e-9) if len(bright) else 1.0
    return [_filled(colour / scale, covered, mask) for (colour, covered), mask in zip(seen, masks, strict=True)]


def _seen(picture: FloatImage, camera: Pinhole) -> tuple[FloatImage, Mask]:
    """Light (rows, columns, 3), and where the object is."""
    at = places_in_rendering(camera).astype(np.float32)
    # linear, since splines would ring around highlights and silhouettes
    picture = np.asarray(cv2.remap(picture, at[..., 0], at[..., 1], cv2.INTER_LINEAR), np.float32)
    covered = picture[..., 3] > 0.5
    # Alpha is premultiplied in a rendering; at silhouettes the object's own light is what counts.
    colour = np.where(covered[..., None], picture[..., :3] / np.maximum(picture[..., 3:], 0.5), 0)
    return np.where(np.isfinite(colour), np.maximum(colour, 0), 0).astype(np.float32), covered


def _filled(colour: FloatImage, covered: Mask, mask: Mask) -> Target:
    distance, nearest = nearest_known(covered & mask)
    filled = mask & (distance <= FURTHEST_FILL_PX)
    # Where a bent shape leaves the object bare, there is nothing to be seen: black.
    image = np.where(filled[..., None], np.minimum(colour[nearest], 1.5), 0)
    return Target(np.ascontiguousarray(image, np.float32), mask)
