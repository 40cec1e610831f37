"""A known mesh on the object of a calibrated run: laid on it, judged, and where it fills what was not measured."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
import numpy.typing as npt

from controller.core import channels
from controller.core.arrays import Float64, FloatImage, Mask, strips
from controller.core.errors import UsageError, WorkError
from controller.core.storage import write_atomically
from controller.optics.calibrate.geometry.background import room_pixels
from controller.optics.calibrate.mesh_alignment import (
    APART_DEGREES,
    FINE_POINTS,
    GRID,
    LOOSEST,
    NEARLY_AS_GOOD,
    Alignment,
    Hits,
    Measured,
    Pairs,
    Pose,
    SolidMesh,
    aligned,
    degrees_between,
    measured,
    mirrored,
    pose_by_pairs,
    rays_of,
    refined,
)
from controller.optics.calibrate.metapixels.from_dots import project
from controller.optics.calibrate.values import Pinhole
from controller.stage.artefacts.geometry import known_points_m, read_geometry, require_shape
from controller.stage.artefacts.mesh import RegisteredMesh, last_mesh, write_filled

MOST_COST: Final = 0.25
"""Of ``Alignment.cost``: above it, the mesh is of something else."""
LIMIT_SHARE: Final = 0.02
"""Of the object's size: farther from the mesh, a measured point contradicts it."""
MOST_BESIDE: Final = 0.05
"""Share of the measured points that may contradict the mesh."""
LEAST_PART: Final = 0.05
MOST_PARTS: Final = 3
DEPTH_JUMP: Final = 0.02
"""Of the distance, from one pixel to the next."""
APART_PX: Final = 60.0
MOST_MAP: Final = 1_000_000
BLOCKS: Final = 8
GUIDED: Final = "Click four pairs of points: --pairs FILE, or the panel."


@dataclass(frozen=True, slots=True)
class Guide:
    """What is known of the pose before: ``start``, or ``pairs``; neither: nothing. ``limit_m``: ``LIMIT_SHARE`` if
    None."""

    start: Pose | None = None
    pairs: Pairs | None = None
    limit_m: float | None = None


@dataclass(frozen=True, slots=True)
class Surface:
    """What the camera measured in a run: ``points_m`` (rows, columns, 3), NaN where nothing; ``mask`` (rows, columns):
    not the room; ``scale_known``: whether metres are metres."""

    camera: Pinhole
    points_m: FloatImage
    mask: Mask
    scale_known: bool

    @classmethod
    def read(cls, run: Path) -> Surface:
        """Raises UsageError("shape-unknown")."""
        require_shape(run, "A mesh")
        geometry, points_m = read_geometry(run), known_points_m(run)
        assert points_m is not None
        return cls(geometry.camera, points_m, ~room_pixels(points_m), geometry.scale_known)

    def parts(self) -> list[Mask]:
        """The whole, and the largest of what stands apart in the picture or in depth, if there are several."""
        depth_m = np.where(self.mask, self.points_m[..., 2], np.nan)
        nearest, farthest = (change(np.nan_to_num(depth_m), np.ones((3, 3))) for change in (cv2.erode, cv2.dilate))
        smooth = (nearest > 0) & (farthest - nearest < DEPTH_JUMP * farthest)
        _, labels, sizes, _ = cv2.connectedComponentsWithStats(smooth.astype(np.uint8))
        area = sizes[:, cv2.CC_STAT_AREA]
        large = [n for n in 1 + np.argsort(-area[1:])[:MOST_PARTS] if area[n] > LEAST_PART * np.count_nonzero(smooth)]
        return [self.mask, *(labels == n for n in large if len(large) > 1)]


def lay_mesh(surface: Surface, mesh: RegisteredMesh, guide: Guide) -> RegisteredMesh:
    """``mesh`` where it fits what was measured, with its figures.

    Raises UsageError("mesh-mirrored", "mesh-pairs-flat", "mesh-pairs-wrong"), WorkError("mesh-does-not-fit",
    "mesh-ambiguous").
    """
    solid = mesh.solid
    best, fine = _best(surface, solid, guide)
    limit_m = guide.limit_m or LIMIT_SHARE * fine.size_m
    met = solid.met_by(fine.rays, best.pose)
    front = met.outside[met.face >= 0]
    flipped = bool(len(front) and front.mean() < 0.5)
    off_m = _off_m(met, fine.rays, fine.depth_m, limit_m, flipped=flipped)
    use = fine.is_object & np.isfinite(off_m)
    off_m, place = off_m[use], _worst(fine.px[use], off_m[use])
    beside = float(np.mean(np.abs(off_m) > limit_m)) if len(off_m) else 1.0
    if best.cost > MOST_COST or beside > MOST_BESIDE:
        if guide.pairs is not None and _best(surface, solid, Guide(), alone=True)[0].cost < MOST_COST:
            raise UsageError(
                "mesh-pairs-wrong",
                what="The mesh fits the object, but not where the pairs of points say.",
                remedy="Click them again: the same places on the mesh and in the camera's picture.",
            )
        other = SolidMesh(mesh.vertices * (-1.0, 1.0, 1.0), mesh.faces)
        if _best(surface, other, Guide(), alone=True)[0].cost < min(MOST_COST, 0.7 * best.cost):
            raise mirrored()
        raise WorkError(
            "mesh-does-not-fit",
            what=f"The mesh does not fit the object: {100 * beside:.0f} % of the measured points are more than "
            f"{1e3 * limit_m:.3g} mm off, most {_where(place)}.",
            remedy=f"Check that the mesh is of this object, in its present state. {GUIDED} --limit MM allows more.",
        )
    if guide.pairs is not None:
        _check_pairs(best.pose, guide.pairs, surface.camera)
    step = math.ceil(math.sqrt(surface.mask.size / MOST_MAP))
    figures = {
        **mesh.figures,
        "median_off_mm": 1e3 * float(np.median(np.abs(off_m))),
        "most_off_mm": 1e3 * float(np.percentile(np.abs(off_m), 95)),
        "limit_mm": 1e3 * limit_m,
        "contradicted_share": beside,
        "worst_px": [round(one) for one in place[:2]],
        "worst_mm": 1e3 * place[2],
        "mesh_seen_share": float(np.mean(met.face[fine.is_object] >= 0)),
        "faces_flipped": flipped,
        "holes_share": float(np.mean(front == flipped)),
        "step": step,
    }
    deviation_m = _deviation_map(surface, solid, best.pose, figures)
    return replace(mesh, pose=best.pose, deviation_m=deviation_m, figures=figures)


def _best(surface: Surface, solid: SolidMesh, guide: Guide, *, alone: bool = False) -> tuple[Alignment, Measured]:
    """The best pose, and the measured points that it is judged by. ``alone``: nothing is refused."""
    found: list[tuple[Alignment, Measured]] = []
    for mask in surface.parts():
        coarse, fine = (measured(surface.camera, surface.points_m, mask, n) for n in (GRID**2, FINE_POINTS))
        if guide.start is not None:
            starts = [guide.start]
        elif guide.pairs is not None:
            start = pose_by_pairs(guide.pairs)
            starts = [refined(solid, coarse, start, pairs=guide.pairs, reach=0.25).pose]
        else:
            starts = [one.pose for one in aligned(solid, coarse)[:3]]
        found += [(refined(solid, fine, start, pairs=guide.pairs, reach=0.1), fine) for start in starts]
    found.sort(key=lambda one: (one[0].cost > MOST_COST, one[0].looseness < LOOSEST, one[0].cost))
    best = found[0][0]
    rivals = [
        other
        for other, fine in found
        if fine is found[0][1]
        and other.cost < NEARLY_AS_GOOD * best.cost
        and degrees_between(other.pose, best.pose) > APART_DEGREES
    ]
    is_guided = guide.pairs is not None or guide.start is not None
    is_loose = best.looseness < LOOSEST
    if best.cost <= MOST_COST and not is_guided and not alone and (rivals or is_loose):
        raise WorkError(
            "mesh-ambiguous",
            what="The mesh fits in more than one way: the part of the object that the camera measured is "
            + ("too plain to hold it in one place." if is_loose else "symmetric."),
            remedy=GUIDED,
        )
    return found[0]


def _off_m(met: Hits, rays: Float64, depth_m: Float64, limit_m: float, *, flipped: bool) -> Float64:
    """Metres (N,) by which measured points lie before the mesh; NaN where there is none, and at a hole of the mesh."""
    off_m = channels.total(met.normals * rays) * (depth_m - met.depth)
    with np.errstate(invalid="ignore"):
        off_m[(met.outside == flipped) & (np.abs(off_m) > limit_m)] = np.nan
    return np.asarray(off_m)


def _worst(px: Float64, off_m: Float64) -> tuple[float, float, float]:
    """x, y in camera pixels, and metres, of the worst of the places (n, 2) where both were compared."""
    if not len(px):
        return 0.0, 0.0, math.inf
    low, high = px.min(axis=0), px.max(axis=0)
    cell = np.minimum(((px - low) / np.maximum(high - low, 1.0) * BLOCKS).astype(np.int64), BLOCKS - 1)
    number = cell[:, 1] * BLOCKS + cell[:, 0]
    some = [n for n in np.unique(number) if np.count_nonzero(number == n) > len(number) / 500]
    worst = max(some, key=lambda n: abs(float(np.median(off_m[number == n]))))
    x, y = px[number == worst].mean(axis=0)
    return float(x), float(y), float(np.median(off_m[number == worst]))


def _where(place: tuple[float, float, float]) -> str:
    x, y, off_m = place
    side = "before" if off_m > 0 else "behind"
    return f"around camera pixel ({x:.0f}, {y:.0f}), {1e3 * abs(off_m):.3g} mm {side} the mesh"


def _check_pairs(pose: Pose, pairs: Pairs, camera: Pinhole) -> None:
    mine, theirs = (project(camera, points)[0] for points in (pose.placed(pairs.on_mesh), pairs.on_object_m))
    off_px = np.linalg.norm(mine - theirs, axis=1)
    worst = int(off_px.argmax())
    if off_px[worst] > APART_PX:
        raise UsageError(
            "mesh-pairs-wrong",
            what=f"Pair {worst + 1} lies {off_px[worst]:.0f} camera pixels from where the mesh fits the object.",
            remedy="Click this pair again: the same place on the mesh and in the camera's picture.",
        )


def _deviation_map(surface: Surface, solid: SolidMesh, pose: Pose, figures: Mapping[str, Any]) -> FloatImage:
    """(rows, columns) of every ``step``-th pixel: as ``_off_m``."""
    step, limit_m = figures["step"], 1e-3 * figures["limit_mm"]
    some_m = surface.points_m[::step, ::step]
    out: FloatImage = np.full(some_m.shape[:2], np.nan, np.float32)
    use = surface.mask[::step, ::step] & np.isfinite(some_m[..., 2])
    for rows in strips(len(out)):
        y, x = np.nonzero(use[rows])
        if len(y):
            rays = rays_of(surface.camera, step * np.stack([x, y + rows.start], axis=1).astype(np.float64))
            depth_m = some_m[rows][y, x, 2].astype(np.float64)
            met = solid.met_by(rays, pose)
            out[rows][y, x] = _off_m(met, rays, depth_m, limit_m, flipped=figures["faces_flipped"])
    return out


def fill_from(run: Path, surface: Surface, mesh: RegisteredMesh) -> int:
    """Fill the object's pixels that have no measured point from the mesh; returns how many.

    None is filled through a hole, or beside a place where the measurement contradicts the mesh.
    """
    from scipy.ndimage import distance_transform_edt

    solid, step = mesh.solid, mesh.figures["step"]
    known = np.isfinite(mesh.deviation_m)
    nearest = distance_transform_edt(~known, return_distances=False, return_indices=True)
    agrees = np.abs(mesh.deviation_m[tuple(nearest)]) <= 1e-3 * mesh.figures["limit_mm"]
    empty = surface.mask & ~np.isfinite(surface.points_m[..., 2])
    parts: list[tuple[npt.NDArray[np.int64], Float64, Float64]] = []
    for rows in strips(len(empty)):
        y, x = np.nonzero(empty[rows])
        use = agrees[(y + rows.start) // step, x // step]
        y, x = y[use] + rows.start, x[use]
        if len(y):
            rays = rays_of(surface.camera, np.stack([x, y], axis=1).astype(np.float64))
            met = solid.met_by(rays, mesh.pose)
            on = (met.face >= 0) & (met.outside != mesh.figures["faces_flipped"])
            at = y * empty.shape[1] + x
            parts.append((at[on], rays[on] * met.depth[on, None], met.normals[on]))
    at, points_m, normals = (np.concatenate(one) for one in zip(*parts, strict=True)) if parts else _NOTHING
    write_filled(run, at, points_m.astype(np.float32), normals.astype(np.float32))
    return len(at)


_NOTHING: Final = (np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3)))


def write_map(path: Path, mesh: RegisteredMesh) -> None:
    """A picture of the deviations: red before the mesh, blue behind it, white where both agree, grey elsewhere."""
    level = np.clip(mesh.deviation_m / (1e-3 * mesh.figures["limit_mm"]), -1, 1)[..., None]
    colours = 255 * (1 - np.abs(level) * np.where(level > 0, (1, 1, 0), (0, 1, 1)))  # blue, green, red
    picture = np.where(np.isfinite(level), colours, 96).astype(np.uint8)
    write_atomically(path, cv2.imencode(".png", picture)[1].tobytes())


def carried_mesh(run: Path) -> RegisteredMesh | None:
    """The run's mesh; else that of an earlier run, laid on this run's surface from where it stood. None without any.

    Raises as ``lay_mesh``.
    """
    mesh = last_mesh(run)
    if mesh is not None and RegisteredMesh.read(run) is None:
        mesh = lay_mesh(Surface.read(run), mesh, Guide(start=mesh.pose, limit_m=1e-3 * mesh.figures["limit_mm"]))
        mesh.write(run)
    return mesh
