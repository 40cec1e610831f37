"""The object of a plan: its mesh in the room, points that stand for its surface, and the shadows that it casts.

``seen_from`` shows it as the audience sees it, pixel by pixel, as points at which a plan can be judged.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from controller.core.arrays import Float64, Mask
from controller.core.errors import UsageError
from controller.optics.calibrate.mesh_alignment import Pose, SolidMesh
from controller.optics.plan.values import Surface
from hal.runtime.mesh_file import MeshUnreadable, read_mesh

AXES: Final = {"+x": 0, "+y": 1, "+z": 2, "-x": 3, "-y": 4, "-z": 5}
BIAS: Final = 1e-4
"""Of the object's size: nothing this near to a point can shade it, except the point's own face."""
AFTER_M: Final = 1e6
SMALLEST, LARGEST = 1e-9, 1e9
"""Of a mesh, in whatever unit its file has."""
FLATTEST: Final = 1e-6


@dataclass(frozen=True, slots=True)
class TargetObject:
    """A mesh in the room (see ``values``). ``vertices_m`` (V, 3), ``faces`` (F, 3)."""

    vertices_m: Float64
    faces: npt.NDArray[np.int32]
    solid: SolidMesh

    @property
    def size_m(self) -> float:
        """The bounding box' diagonal."""
        return float(np.linalg.norm(np.ptp(self.vertices_m, axis=0)))

    def hit(self, from_m: Float64, directions: Float64) -> tuple[Float64, Float64]:
        """Metres (N,) along unit ``directions`` (N, 3) from ``from_m`` (3,) to the surface, AFTER_M where none.

        And the faces' normals there (N, 3), unit, on the side to which they point; 0 where none.
        """
        if not len(directions):
            return np.zeros(0), np.zeros((0, 3))
        met = self.solid.met_by(directions, Pose(1.0, np.eye(3), -from_m))
        normals = met.normals * np.where(met.outside, 1.0, -1.0)[:, None]
        return np.nan_to_num(met.depth, nan=AFTER_M), np.where(met.face[:, None] >= 0, normals, 0.0)

    def hidden(self, from_m: Float64, points_m: Float64) -> Mask:
        """``optics.Shadows``."""
        towards = points_m - from_m
        distance = np.linalg.norm(towards, axis=1)
        first, _ = self.hit(from_m, towards / np.maximum(distance, 1e-12)[:, None])
        return np.asarray(first < distance - BIAS * self.size_m)


def read_target_object(path: Path, *, height_m: float | None, up: str, front: str) -> TargetObject:
    """Read a mesh of any format that trimesh reads, and stand it in the room.

    ``height_m``: what its height becomes; None: the file's unit is the metre. ``up``, ``front``: the file's axes that
    point up and towards the audience, "+x" to "-z". Raises UsageError "plan-mesh-unreadable", "plan-mesh-no-faces",
    "plan-mesh-no-size", "plan-axes".
    """
    if AXES[up] % 3 == AXES[front] % 3:
        raise UsageError(
            "plan-axes",
            what=f"The object can't have {up} up and {front} in front.",
            remedy='Give two different axes in [object], e.g. up = "+y" and front = "+z".',
        )
    vertices, faces = _read(path)
    above, towards = _axis(up), _axis(front)
    # room: x right, y down, z away from the audience
    placed = vertices @ np.stack((np.cross(above, towards), -above, -towards)).T
    low, high = placed[faces].min(axis=(0, 1)), placed[faces].max(axis=(0, 1))
    placed -= 0.5 * (low + high)
    if height_m is not None:
        height = float((high - low)[1])
        if height < FLATTEST * float((high - low).max()):
            raise _no_size(path, f"the object has no height along {up}, so height_m can't be applied")
        placed *= height_m / height
    return TargetObject(placed, faces, SolidMesh(placed, faces))


def sampled(target_object: TargetObject, count: int, audience_m: Float64, seed: int) -> Surface:
    """``count`` points evenly over the surface by area; those that no one of ``audience_m`` (M, 3) sees have area 0.

    Normals point to the side that is seen, since a mesh may be inside out. The same seed gives the same points.
    Raises UsageError("plan-nothing-seen").
    """
    rng = np.random.default_rng(seed)
    corners = target_object.vertices_m[target_object.faces]
    cross = _crosses(target_object.vertices_m, target_object.faces)
    double = np.linalg.norm(cross, axis=1)
    # stratified: even steps of area, each with one point
    edges = np.cumsum(double) / double.sum()
    chosen = np.minimum(np.searchsorted(edges, (np.arange(count) + rng.random(count)) / count), len(edges) - 1)
    u, v = rng.random((2, count))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    a, b, c = (corners[chosen, k] for k in range(3))
    points = a + u[:, None] * (b - a) + v[:, None] * (c - a)
    normals = cross[chosen] / double[chosen, None]
    seen, facing = np.zeros(count, bool), np.zeros(count)
    for eye in audience_m:
        visible = ~target_object.hidden(eye, points)
        side = np.sum(normals * (eye - points), axis=1)
        visible &= np.abs(side) > 0
        facing = np.where(visible & ~seen, np.sign(side), facing)
        seen |= visible
    if not seen.any():
        raise UsageError(
            "plan-nothing-seen",
            what="The audience sees nothing of the object from its positions.",
            remedy="Check [audience] positions_m, the object's axes, and its height_m.",
        )
    area = np.where(seen, 0.5 * double.sum() / count, 0.0)
    return Surface(points, normals * np.where(facing == 0, 1.0, facing)[:, None], area)


def _read(path: Path) -> tuple[Float64, npt.NDArray[np.int32]]:
    try:
        mesh = read_mesh(path, coloured=False)
    except MeshUnreadable as error:
        raise UsageError(
            "plan-mesh-unreadable",
            what=f"The object {path} can't be read as a mesh ({error}).",
            remedy="Check the file, or export it again as .obj, .ply or .glb.",
        ) from error
    vertices, faces = mesh.vertices, mesh.faces
    if len(faces):
        size = float(np.ptp(vertices[faces].reshape(-1, 3), axis=0).max())
        if not SMALLEST < size < LARGEST:
            raise _no_size(path, f"its largest side is {size:g} units of the file long")
        faces = faces[np.linalg.norm(_crosses(vertices, faces), axis=1) > 1e-12 * size**2]
        if not len(faces):
            raise _no_size(path, "none of its faces has an area")
    if not len(faces):
        raise UsageError(
            "plan-mesh-no-faces",
            what=f"{path} contains no faces, so there is no surface to light.",
            remedy="Export the object as a triangle mesh (.obj, .ply or .glb), not as a point cloud.",
        )
    return vertices, faces


def _crosses(vertices: Float64, faces: npt.NDArray[np.int32]) -> Float64:
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return np.asarray(np.cross(b - a, c - a))


def _no_size(path: Path, why: str) -> UsageError:
    return UsageError(
        "plan-mesh-no-size",
        what=f"The object {path} can't be lit: {why}.",
        remedy="Export it as a surface in metres, or correct [object] height_m, up and front.",
    )


def _axis(name: str) -> Float64:
    axis = np.zeros(3)
    axis[AXES[name] % 3] = 1.0 if AXES[name] < 3 else -1.0
    return axis


MARGIN = 1.06


@dataclass(frozen=True, slots=True)
class AudienceView:
    """A picture of the object: ``mask`` (rows, columns) bool, and a surface of one point a pixel of the mask."""

    mask: Mask
    surface: Surface

    def map_of(self, values: Float64) -> Float64:
        """(rows, columns) of one value a surface point, NaN beside the object."""
        picture = np.full(self.mask.shape, np.nan)
        picture[self.mask] = values
        return picture


def seen_from(target_object: TargetObject, eye_m: Float64, *, rows: int) -> AudienceView:
    """The object from ``eye_m`` (3,), upright, ``rows`` pixels high and as wide as it needs."""
    ahead = -eye_m / np.linalg.norm(eye_m)
    right = np.cross((0.0, 1.0, 0.0) if abs(ahead[1]) < 0.999 else (0.0, 0.0, -1.0), ahead)
    right /= np.linalg.norm(right)
    down = np.cross(ahead, right)
    local = (target_object.vertices_m[np.unique(target_object.faces)] - eye_m) @ np.stack((right, down, ahead)).T
    flat = local[:, :2] / np.maximum(local[:, 2:], 1e-6)
    low, high = flat.min(axis=0), flat.max(axis=0)
    middle, half = 0.5 * (low + high), 0.5 * MARGIN * np.maximum(high - low, 1e-9)
    columns = int(np.clip(np.ceil(rows * half[0] / half[1]), 16, 4 * rows))
    y, x = np.meshgrid(np.linspace(-1, 1, rows), np.linspace(-1, 1, columns), indexing="ij")
    across, along = middle[0] + x.ravel() * half[0], middle[1] + y.ravel() * half[1]
    ray = across[:, None] * right + along[:, None] * down + ahead
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    distance, normals = target_object.hit(eye_m, ray)
    hit = distance < AFTER_M
    normals = normals[hit] * -np.sign(np.sum(normals[hit] * ray[hit], axis=1))[:, None]
    points = eye_m + distance[hit, None] * ray[hit]
    return AudienceView(hit.reshape(rows, columns), Surface(points, normals, np.ones(len(points))))
