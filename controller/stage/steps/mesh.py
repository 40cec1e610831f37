"""A known mesh on the object of a calibrated run: laid on it, judged, and where it fills what was not measured."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
import numpy.typing as npt

from controller.core import channels
from controller.core.arrays import FloatImage, Mask, strips
from controller.core.blur import gaussian_blur, nearest_known
from controller.core.errors import UsageError, WorkError
from controller.optics.calibrate.geometry.background import room_pixels
from controller.optics.calibrate.mesh_alignment import (
    APART_DEGREES,
    COARSE_POINTS,
    FINE_POINTS,
    LOOSEST,
    Alignment,
    Measured,
    Pairs,
    Pose,
    SolidMesh,
    aligned,
    measured,
    pose_by_pairs,
    rays_of,
    refined,
)
from controller.optics.calibrate.values import Pinhole
from controller.stage.artefacts.geometry import known_points_m, read_camera, read_geometry_figures, require_shape
from controller.stage.artefacts.mesh import RegisteredMesh, last_mesh

MOST_COST: Final = 0.25
"""Of ``Alignment.cost``: above it, the mesh is of something else."""
GOOD_COST: Final = 0.1
NEARLY_AS_GOOD: Final = 1.25
LIMIT_SHARE: Final = 0.02
"""Of the object's size: farther from the mesh, a measured point contradicts it."""
MOST_BESIDE: Final = 0.05
"""Share of the measured points that may contradict the mesh."""
LEAST_PART: Final = 0.05
MOST_PARTS: Final = 3
DEPTH_JUMP: Final = 0.02
"""Of the distance, from one pixel to the next."""
MOST_MAP: Final = 1_000_000
GUIDED: Final = "Give four pairs of points with --pairs FILE."


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
        points_m = known_points_m(run)
        assert points_m is not None
        scale_known = bool(read_geometry_figures(run)["scale_known"])
        return cls(read_camera(run), points_m, ~room_pixels(points_m), scale_known)

    def parts(self) -> list[Mask]:
        """The whole, and the largest of what stands apart in the picture or in depth, if there are several."""
        depth_m = np.nan_to_num(np.where(self.mask, self.points_m[..., 2], 0))
        nearest, farthest = (change(depth_m, np.ones((3, 3))) for change in (cv2.erode, cv2.dilate))
        smooth = (nearest > 0) & (farthest - nearest < DEPTH_JUMP * farthest)
        _, labels, sizes, _ = cv2.connectedComponentsWithStats(smooth.astype(np.uint8))
        area = sizes[:, cv2.CC_STAT_AREA]
        large = [n for n in 1 + np.argsort(-area[1:])[:MOST_PARTS] if area[n] > LEAST_PART * np.count_nonzero(smooth)]
        return [self.mask, *(labels == n for n in large if len(large) > 1)]


def lay_mesh(
    surface: Surface, mesh: RegisteredMesh, guide: Pose | Pairs | None = None, limit_m: float | None = None
) -> RegisteredMesh:
    """``mesh`` where it fits what was measured, with its figures.

    ``guide``: where it stood, or pairs of points; ``limit_m``: how far both may differ, None: ``LIMIT_SHARE``
    Raises UsageError("mesh-mirrored", "mesh-pairs-wrong"), WorkError("mesh-does-not-fit", "mesh-ambiguous").
    """
    solid = mesh.solid
    best, fine = _best(surface, solid, guide)
    limit_m = limit_m or LIMIT_SHARE * fine.size_m
    met = solid.met_by(fine.rays, best.pose)
    front = met.outside[met.face >= 0]
    figures = {
        **mesh.figures,
        "limit_mm": 1e3 * limit_m,
        "faces_flipped": bool(len(front) and front.mean() < 0.5),
        "holes_share": float(min(front.mean(), 1 - front.mean())) if len(front) else 0.0,
        "step": math.ceil(math.sqrt(surface.mask.size / MOST_MAP)),
    }
    mesh = replace(mesh, pose=best.pose, figures=figures)
    deviation_m = _deviations(surface, mesh, solid)
    off_m = np.abs(deviation_m[np.isfinite(deviation_m)])
    beside = float(np.mean(off_m > limit_m)) if len(off_m) else 1.0
    place = _worst(deviation_m) * figures["step"]
    if best.cost > MOST_COST or beside > MOST_BESIDE:
        if isinstance(guide, Pairs) and _best(surface, solid, refuse=False)[0].cost < MOST_COST:
            raise UsageError(
                "mesh-pairs-wrong",
                what="The mesh fits the object, but not where the pairs of points say.",
                remedy="Choose them again: the same places on the mesh and in the camera's picture.",
            )
        mirror = SolidMesh(mesh.arrays["vertices"] * (-1.0, 1.0, 1.0), mesh.arrays["faces"])
        if _best(surface, mirror, refuse=False)[0].cost < min(MOST_COST, 0.7 * best.cost):
            raise UsageError(
                "mesh-mirrored",
                what="The mesh is the mirror image of the object.",
                remedy="Export it again without a negative scale, and with the axes of a right-handed frame.",
            )
        raise WorkError(
            "mesh-does-not-fit",
            what=f"The mesh does not fit the object: {100 * beside:.0f} % of the measured points are more than "
            f"{1e3 * limit_m:.3g} mm off, most around camera pixel ({place[0]}, {place[1]}).",
            remedy=f"Check that the mesh is of this object, in its present state. {GUIDED} --limit MM allows more.",
        )
    figures |= {
        "median_off_mm": 1e3 * float(np.median(off_m)),
        "most_off_mm": 1e3 * float(np.percentile(off_m, 95)),
        "contradicted_share": beside,
        "worst_px": place.tolist(),
    }
    return replace(mesh, arrays={**mesh.arrays, "deviation_m": deviation_m}, figures=figures)


def _best(
    surface: Surface, solid: SolidMesh, guide: Pose | Pairs | None = None, *, refuse: bool = True
) -> tuple[Alignment, Measured]:
    """The best pose, and the measured points that it is judged by."""
    pairs = guide if isinstance(guide, Pairs) else None
    found: list[tuple[Alignment, Measured]] = []
    for mask in surface.parts():
        coarse, fine = (measured(surface.camera, surface.points_m, mask, n) for n in (COARSE_POINTS, FINE_POINTS))
        if isinstance(guide, Pose):
            starts = [guide]
        elif pairs is not None:
            starts = [refined(solid, coarse, pose_by_pairs(pairs), pairs=pairs, reach=0.25).pose]
        else:
            starts = [one.pose for one in aligned(solid, coarse)[:3]]
        found += [(refined(solid, fine, start, pairs=pairs), fine) for start in starts]
        if any(one.cost < GOOD_COST and one.looseness > LOOSEST for one, _ in found):
            break
    found.sort(key=lambda one: (one[0].cost > MOST_COST, one[0].looseness < LOOSEST, one[0].cost))
    best, fine = found[0]
    if guide is not None or not refuse or best.cost > MOST_COST:
        return best, fine
    is_loose = best.looseness < LOOSEST
    if is_loose or any(
        of is fine and other.cost < NEARLY_AS_GOOD * best.cost and other.pose.degrees_from(best.pose) > APART_DEGREES
        for other, of in found
    ):
        raise WorkError(
            "mesh-ambiguous",
            what="The mesh fits in more than one way: the part of the object that the camera measured is "
            + ("too plain to hold it in one place." if is_loose else "symmetric."),
            remedy=GUIDED,
        )
    return best, fine


def _deviations(surface: Surface, mesh: RegisteredMesh, solid: SolidMesh) -> FloatImage:
    """``deviation_m`` of a ``RegisteredMesh`` in its pose; where the camera looks through a hole, it has none."""
    step, limit_m = mesh.figures["step"], 1e-3 * mesh.figures["limit_mm"]
    depth_m = np.where(surface.mask, surface.points_m[..., 2], np.nan)[::step, ::step]
    out: FloatImage = np.full(depth_m.shape, np.nan, np.float32)
    for rows in strips(len(out)):
        y, x = np.nonzero(np.isfinite(depth_m[rows]))
        if len(y):
            rays = rays_of(surface.camera, step * x, step * (y + rows.start))
            met = solid.met_by(rays, mesh.pose)
            off_m = channels.total(met.normals * rays) * (depth_m[rows][y, x] - met.depth)
            with np.errstate(invalid="ignore"):
                through = (met.outside == mesh.figures["faces_flipped"]) & (np.abs(off_m) > limit_m)
            out[rows][y, x] = np.where(through, np.nan, off_m)
    return out


def _worst(deviation_m: FloatImage) -> npt.NDArray[np.int64]:
    """(2,) x and y of the place where mesh and measurement differ most, over a small area."""
    known = np.isfinite(deviation_m)
    sigma_px = max(1.0, math.sqrt(np.count_nonzero(known)) / 30)
    off = gaussian_blur(np.nan_to_num(np.abs(deviation_m)), sigma_px)
    y, x = np.unravel_index(int(np.where(known, off, -1).argmax()), off.shape)
    return np.array([x, y])


def filled(surface: Surface, mesh: RegisteredMesh) -> RegisteredMesh:
    """``mesh`` with what it says of the object's pixels that have no measured point.

    None is filled through a hole, or beside a place where the measurement contradicts the mesh.
    """
    solid, step, deviation_m = mesh.solid, mesh.figures["step"], mesh.arrays["deviation_m"]
    agrees = np.abs(deviation_m[nearest_known(np.isfinite(deviation_m))[1]]) <= 1e-3 * mesh.figures["limit_mm"]
    empty = surface.mask & ~np.isfinite(surface.points_m[..., 2])
    empty &= np.kron(agrees, np.ones((step, step), np.bool_))[: len(empty), : empty.shape[1]]
    y, x = np.nonzero(empty)
    rays = rays_of(surface.camera, x, y) if len(y) else np.zeros((0, 3))
    met = solid.met_by(rays, mesh.pose)
    on = (met.face >= 0) & (met.outside != mesh.figures["faces_flipped"])
    arrays: dict[str, npt.NDArray[Any]] = {
        "filled_at": (y * empty.shape[1] + x)[on],
        "filled_points_m": (rays * met.depth[:, None])[on].astype(np.float32),
        "filled_normals": met.normals[on].astype(np.float32),
    }
    return replace(mesh, arrays={**mesh.arrays, **arrays}, figures={**mesh.figures, "filled_pixels": int(on.sum())})


def carried_mesh(run: Path) -> RegisteredMesh | None:
    """The run's mesh; else that of an earlier run, laid on this run's surface from where it stood. None without any.

    What it filled is filled again. Raises as ``lay_mesh``.
    """
    mesh = last_mesh(run)
    if mesh is not None and RegisteredMesh.read(run) is None:
        surface = Surface.read(run)
        mesh = lay_mesh(surface, mesh, mesh.pose, 1e-3 * mesh.figures["limit_mm"])
        mesh = filled(surface, mesh) if "filled_at" in mesh.arrays else mesh
        mesh.write(run)
    return mesh
