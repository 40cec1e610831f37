"""A known mesh on the measured surface: where it stands, how large it is, and how far both differ.

The camera's rays meet the mesh, and each measured point is compared with the mesh along its own ray: iterative closest
points with projective association (Blais and Levine 1995) and point-to-plane distances (Chen and Medioni 1991), with a
scale, and with Tukey's weights, since the camera sees a part of the mesh, and measures a part of that. It starts at
pairs of points, or at the best of many turns, seen at a coarse grid of pixels.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from controller.core import channels
from controller.core.arrays import Float64, FloatImage, Mask
from controller.core.errors import UsageError
from controller.optics.calibrate.values import Pinhole

TURNS: Final = 1200
BEST_TURNS: Final = 30
COARSE_POINTS: Final = 800
FINE_POINTS: Final = 40_000
NEAR: Final = 0.02
"""Of the object's size: a point this far from the mesh is not on it, when poses are compared."""
CLICK_PX: Final = 5.0
WEIGHED_AS: Final = 300
"""All measured points together weigh as so many when clicks are weighed against them."""
LOOSEST: Final = 2e-4
"""Least share of the points' squared distances by which a turn, a shift or a scale shows, else it is not determined."""
APART_DEGREES: Final = 8.0


class Pose(NamedTuple):
    """From the mesh's file to the camera's frame in metres: ``scale`` * ``rotation`` (3, 3) @ x + ``shift_m`` (3,)."""

    scale: float
    rotation: Float64
    shift_m: Float64

    def placed(self, points: Float64) -> Float64:
        """(..., 3) in metres in the camera's frame of (..., 3) in the file's units."""
        return np.asarray(self.scale * points @ self.rotation.T + self.shift_m)

    def then(self, other: Pose) -> Pose:
        """This pose, and then ``other``."""
        shift_m = other.scale * other.rotation @ self.shift_m + other.shift_m
        return Pose(other.scale * self.scale, np.asarray(other.rotation @ self.rotation), np.asarray(shift_m))

    def moved(self, step: Float64, centre_m: Float64) -> Pose:
        """After a small turn (3), shift (3) and relative scale (1) about ``centre_m``."""
        turn, grown = cv2.Rodrigues(step[:3])[0], float(np.exp(step[6]))
        shift_m = grown * turn @ (self.shift_m - centre_m) + centre_m + step[3:6]
        return Pose(self.scale * grown, np.asarray(turn @ self.rotation), shift_m)

    def degrees_from(self, other: Pose) -> float:
        """The angle of the turn from one pose to the other."""
        cosine = 0.5 * (np.trace(self.rotation @ other.rotation.T) - 1)
        return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


class Hits(NamedTuple):
    """What N rays meet: ``depth`` (N,) in the ray's own length, NaN where nothing; ``face`` (N,), -1 where nothing;
    ``normals`` (N, 3) unit, towards the camera; ``outside`` (N,): whether the face was met on its front."""

    depth: Float64
    face: npt.NDArray[np.int64]
    normals: Float64
    outside: Mask


class SolidMesh:
    """A mesh that rays can meet. ``vertices`` (V, 3) in the file's units, ``faces`` (F, 3) indices of vertices."""

    def __init__(self, vertices: Float64, faces: npt.NDArray[np.int32]) -> None:
        self.vertices, self.faces = vertices, faces
        a, b, c = (vertices[faces[:, corner]] for corner in range(3))
        self._across = np.cross(b - a, c - a)
        self._along = channels.total(self._across * a)
        low, high = np.minimum(np.minimum(a, b), c).min(axis=0), np.maximum(np.maximum(a, b), c).max(axis=0)
        self._middle, self.size = 0.5 * (low + high), float(np.linalg.norm(high - low))
        embree: Any = importlib.import_module("embreex.rtcore_scene")
        meshes: Any = importlib.import_module("embreex.mesh_construction")
        self._scene = embree.EmbreeScene(robust=True)
        # its numbers have 32 bits
        meshes.TriangleMesh(self._scene, ((vertices - self._middle) / self.size).astype(np.float32), faces)

    def met_by(self, rays: Float64, pose: Pose) -> Hits:
        """What rays (N, 3) from the camera meet of the mesh in this pose."""
        origin, ways = _in_file(rays, pose)
        length = channels.length(ways)[:, None]
        start = np.broadcast_to(((origin - self._middle) / self.size).astype(np.float32), ways.shape).copy()
        face = self._scene.run(start, (ways / length).astype(np.float32)).astype(np.int64)
        across = self._across[face]  # of the last face where none is met
        with np.errstate(invalid="ignore", divide="ignore"):
            # again in 64 bits
            facing = channels.total(across * ways)
            depth = (self._along[face] - across @ origin) / facing
            normals = across @ pose.rotation.T * (-np.sign(facing) / channels.length(across))[:, None]
        face[~(depth > 0)] = -1
        return Hits(np.where(face >= 0, depth, np.nan), face, normals, facing < 0)

    def weights(self, rays: Float64, pose: Pose, face: npt.NDArray[np.int64]) -> Float64:
        """(N, 3): where rays (N, 3) meet the planes of faces (N,), as weights of the faces' corners."""
        triangles: Any = importlib.import_module("trimesh.triangles")
        origin, ways = _in_file(rays, pose)
        across = self._across[face]
        with np.errstate(invalid="ignore", divide="ignore"):
            depth = (self._along[face] - across @ origin) / channels.total(across * ways)
            at = origin + depth[:, None] * ways
            return np.asarray(triangles.points_to_barycentric(self.vertices[self.faces[face]], at), np.float64)


def _in_file(rays: Float64, pose: Pose) -> tuple[Float64, Float64]:
    """The camera (3,) and its rays (N, 3) in the frame of the mesh's file."""
    return (-pose.rotation.T @ pose.shift_m) / pose.scale, rays @ pose.rotation / pose.scale


@dataclass(frozen=True)
class Measured:
    """What the camera measured at N pixels.

    ``rays`` (N, 3) at depth 1; ``depth_m`` (N,) NaN where unknown; ``is_object`` (N,): else it is of the room, or
    unknown; ``focal_px`` of the camera
    """

    rays: Float64
    depth_m: Float64
    is_object: Mask
    focal_px: float

    @cached_property
    def points_m(self) -> Float64:
        """(n, 3) of the object."""
        return np.asarray(self.rays[self.is_object] * self.depth_m[self.is_object, None])

    @cached_property
    def size_m(self) -> float:
        """The diagonal of the box that holds nearly all of the object's points."""
        return float(np.linalg.norm(np.ptp(np.percentile(self.points_m, (1, 99), axis=0), axis=0)))


def measured(camera: Pinhole, points_m: FloatImage, mask: Mask, count: int) -> Measured:
    """About ``count`` pixels on an even grid around the object of ``mask`` (rows, columns).

    ``points_m`` (rows, columns, 3) as in ``Geometry``. Raises UsageError("mesh-nothing-measured").
    """
    own = np.isfinite(points_m[..., 2]) & mask
    if np.count_nonzero(own) < 100:
        raise UsageError(
            "mesh-nothing-measured",
            what="The calibration has hardly a point of the object, so no mesh can be laid on it.",
            remedy="Calibrate again with the object in the camera's view and in focus.",
        )
    at_y, at_x = np.nonzero(own)
    margin = max(np.ptp(at_y), np.ptp(at_x)) // 8
    top, left = max(0, at_y.min() - margin), max(0, at_x.min() - margin)
    bottom, right = min(len(own), at_y.max() + margin), min(own.shape[1], at_x.max() + margin)
    step = max(1, round(float(np.sqrt((bottom - top) * (right - left) / count))))
    y, x = (grid.ravel() for grid in np.mgrid[top:bottom:step, left:right:step])
    return Measured(rays_of(camera, x, y), points_m[y, x, 2].astype(np.float64), own[y, x], camera.matrix[0, 0])


def rays_of(camera: Pinhole, x: npt.NDArray[Any], y: npt.NDArray[Any]) -> Float64:
    """(N, 3) directions at depth 1 of what the camera sees at (N,) pixels."""
    return np.column_stack([camera.rays(np.stack([x, y], axis=1).astype(np.float64)), np.ones(len(x))])


class Pairs(NamedTuple):
    """The same places on both: ``on_mesh`` (N, 3) in the file's units, ``on_object_m`` (N, 3) in the camera's frame."""

    on_mesh: Float64
    on_object_m: Float64


class Alignment(NamedTuple):
    """``cost``: 0 where the mesh is all that was measured, 1 where nothing of it; ``looseness``: see ``LOOSEST``."""

    pose: Pose
    cost: float
    looseness: float


def pose_by_pairs(pairs: Pairs) -> Pose:
    """The pose with the least squared distances between the pairs."""
    registration: Any = importlib.import_module("trimesh.registration")
    matrix = registration.procrustes(*pairs, reflection=False)[0]
    scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    return Pose(scale, matrix[:3, :3] / scale, matrix[:3, 3])


def refined(
    mesh: SolidMesh, of: Measured, start: Pose, *, pairs: Pairs | None = None, reach: float = 0.1, steps: int = 25
) -> Alignment:
    """The mesh moved from ``start`` to where it fits the measured points best.

    ``reach``: how far, of the object's size, a point may be from the mesh at first; ``pairs`` hold it where the
    points leave it free.
    """
    pose, size_m, looseness = start, of.size_m, 0.0
    units = np.array([size_m] * 3 + [1.0] * 3 + [size_m])
    for step in range(steps):
        met = mesh.met_by(of.rays, pose)
        use = of.is_object & (met.face >= 0)
        if np.count_nonzero(use) < 20:
            return Alignment(pose, 1.0, 0.0)
        at, normals = of.rays[use] * met.depth[use, None], met.normals[use]
        off = channels.total(normals * of.rays[use]) * (of.depth_m[use] - met.depth[use])
        spread = max(1.4826 * float(np.median(np.abs(off))), 2e-5 * size_m)
        limit = min(reach * size_m, 4.7 * spread)
        weights = np.where(np.abs(off) < limit, (1 - (off / limit) ** 2) ** 2, 0.0)
        if weights.sum() < 10:
            return Alignment(pose, 1.0, 0.0)
        centre = np.average(at, axis=0, weights=weights)
        arm = (at - centre) / size_m
        rows = np.column_stack([np.cross(arm, normals), normals, channels.total(arm * normals)])
        weighted = rows * weights[:, None] / weights.sum()
        matrix, right = weighted.T @ rows, weighted.T @ off
        looseness = float(np.linalg.eigvalsh(matrix)[0])
        if pairs is not None:
            for mine, theirs in zip(pose.placed(pairs.on_mesh), pairs.on_object_m, strict=True):
                near = (mine - centre) / size_m
                own = np.column_stack([np.cross(np.eye(3), near).T, np.eye(3), near])
                weight = (spread / (CLICK_PX * theirs[2] / of.focal_px)) ** 2 / WEIGHED_AS
                matrix, right = matrix + weight * own.T @ own, right + weight * own.T @ (theirs - mine)
        matrix += np.eye(7) * 1e-9 * np.trace(matrix)
        change = np.linalg.solve(matrix, right) / units
        largest = float(np.abs(change * units / size_m).max())
        pose = pose.moved(change * min(1.0, 0.3 / max(largest, 1e-12)), centre)
        if step > 3 and largest < 1e-6:
            break
    return Alignment(pose, cost_of(mesh, of, pose), looseness)


def cost_of(mesh: SolidMesh, of: Measured, pose: Pose) -> float:
    """From 0 (the mesh is where the object was measured, and nowhere else) to 1."""
    depth = mesh.met_by(of.rays, pose).depth
    near_m = NEAR * of.size_m
    with np.errstate(invalid="ignore"):
        apart = np.nan_to_num(np.minimum(np.abs(depth - of.depth_m) / near_m, 1.0), nan=1.0)
        in_front = ~of.is_object & (depth < of.depth_m - near_m)
    return float((apart[of.is_object].sum() + in_front.sum()) / (of.is_object.sum() + in_front.sum()))


def aligned(mesh: SolidMesh, coarse: Measured) -> list[Alignment]:
    """The mesh laid on the object without any help, at any scale: the best poses that differ, the best first."""
    from scipy.spatial.transform import Rotation

    some = mesh.vertices[mesh.faces[:: 1 + len(mesh.faces) // 3000].ravel()]
    points = coarse.points_m
    ahead = points.mean(axis=0) / np.linalg.norm(points.mean(axis=0))
    frame = np.asarray(Rotation.align_vectors([0.0, 0.0, 1.0], ahead)[0].as_matrix())
    low, high = np.percentile(points @ frame.T, (0.5, 99.5), axis=0)
    trials = []
    for rotation in Rotation.random(TURNS, rng=np.random.default_rng(0)).as_matrix():
        turned = some @ rotation.T
        own_low, own_high = turned.min(axis=0), turned.max(axis=0)
        sides = (high - low)[:2] / np.maximum(own_high - own_low, 1e-9 * mesh.size)[:2]
        scale = float(np.sqrt(sides.prod()))
        shift = 0.5 * (low + high) - 0.5 * scale * (own_low + own_high)
        shift[2] = low[2] - scale * own_low[2]
        pose = Pose(scale, frame.T @ rotation, frame.T @ shift)
        trials.append((cost_of(mesh, coarse, pose), pose))
    trials.sort(key=lambda trial: trial[0])
    better = [refined(mesh, coarse, pose, reach=0.25, steps=15) for _, pose in trials[:BEST_TURNS]]
    different: list[Alignment] = []
    for one in sorted(better, key=lambda trial: trial.cost):
        if all(one.pose.degrees_from(other.pose) > APART_DEGREES for other in different):
            different.append(one)
    return different
