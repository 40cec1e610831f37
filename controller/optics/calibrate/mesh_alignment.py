"""A known mesh on the measured surface: where it stands, how large it is, and how far both differ.

The camera's rays meet the mesh, and each measured point is compared with the mesh along its own ray: iterative closest
points with projective association (Blais and Levine 1995) and point-to-plane distances (Chen and Medioni 1991), with a
scale, and with Tukey's weights, since the camera sees a part of the mesh, and measures a part of that. It starts at
pairs of points, or at the best of many turns that are spread evenly (Alexa 2022) and seen at a coarse grid of pixels.
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
GRID: Final = 28
"""Pixels across the object, when turns are compared."""
BEST_TURNS: Final = 30
STEPS: Final = 25
COARSE_POINTS, FINE_POINTS = 900, 40_000
NEAR: Final = 0.02
"""Of the object's size: a point this far from the mesh is not on it, when turns are compared."""
CLICK_PX: Final = 5.0
WEIGHED_AS: Final = 300
"""All measured points together weigh as so many when clicks are weighed against them."""
LOOSEST: Final = 2e-4
"""Least share of the points' squared distances by which a turn, a shift or a scale shows, else it is not determined."""
NEARLY_AS_GOOD: Final = 1.25
APART_DEGREES: Final = 8.0


@dataclass(frozen=True, slots=True)
class Pose:
    """From the mesh's file to the camera's frame in metres: ``scale`` * ``rotation`` (3, 3) @ x + ``shift_m`` (3,)."""

    scale: float
    rotation: Float64
    shift_m: Float64

    def placed(self, points: Float64) -> Float64:
        """(..., 3) in metres in the camera's frame of (..., 3) in the file's units."""
        return np.asarray(self.scale * points @ self.rotation.T + self.shift_m)

    def moved(self, step: Float64, centre_m: Float64) -> Pose:
        """After a small turn (3), shift (3) and relative scale (1) about ``centre_m``."""
        turn, grown = cv2.Rodrigues(step[:3])[0], float(np.exp(step[6]))
        shift_m = grown * turn @ (self.shift_m - centre_m) + centre_m + step[3:6]
        return Pose(self.scale * grown, np.asarray(turn @ self.rotation), shift_m)


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
        used = vertices[faces.ravel()]
        low, high = used.min(axis=0), used.max(axis=0)
        self.middle, self.size = 0.5 * (low + high), float(np.linalg.norm(high - low))
        a, b, c = (vertices[faces[:, corner]] for corner in range(3))
        self._across = np.cross(b - a, c - a)
        self._along = channels.total(self._across * a)
        embree: Any = importlib.import_module("embreex.rtcore_scene")
        meshes: Any = importlib.import_module("embreex.mesh_construction")
        self._scene = embree.EmbreeScene(robust=True)
        # its numbers have 32 bits
        meshes.TriangleMesh(self._scene, ((vertices - self.middle) / self.size).astype(np.float32), faces)

    def outline(self) -> Float64:
        """(n, 3) vertices that are farthest in some direction: as far out as all of them, but few."""
        n = np.arange(200) + 0.5
        height, turn = 1 - 2 * n / 200, n * np.pi * (1 + 5**0.5)
        round_m = np.sqrt(1 - height**2)
        ways = np.stack([round_m * np.cos(turn), round_m * np.sin(turn), height], axis=1)
        used = np.unique(self.faces)
        farthest = np.unique([int((self.vertices[used] @ way).argmax()) for way in ways])
        return np.asarray(self.vertices[used[farthest]])

    def met_by(self, rays: Float64, pose: Pose) -> Hits:
        """What rays (N, 3) from the camera meet of the mesh in this pose."""
        origin = (-pose.rotation.T @ pose.shift_m) / pose.scale
        ways = rays @ pose.rotation / pose.scale
        length = np.linalg.norm(ways, axis=1)
        start = np.broadcast_to(((origin - self.middle) / self.size).astype(np.float32), ways.shape).copy()
        face = self._scene.run(start, (ways / length[:, None]).astype(np.float32)).astype(np.int64)
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
        origin = (-pose.rotation.T @ pose.shift_m) / pose.scale
        ways = rays @ pose.rotation / pose.scale
        a, b, c = (self.vertices[self.faces[face, corner]] for corner in range(3))
        across = self._across[face]
        with np.errstate(invalid="ignore", divide="ignore"):
            depth = (self._along[face] - across @ origin) / channels.total(across * ways)
            at = origin + depth[:, None] * ways - a
            second = channels.total(np.cross(at, c - a) * across) / channels.total(across * across)
            third = channels.total(np.cross(b - a, at) * across) / channels.total(across * across)
        return np.stack([1 - second - third, second, third], axis=1)


@dataclass(frozen=True)
class Measured:
    """What the camera measured at N pixels.

    ``px`` (N, 2); ``rays`` (N, 3) at depth 1; ``depth_m`` (N,) NaN where unknown; ``is_object`` (N,): else it is of the
    room, or unknown; ``focal_px`` of the camera
    """

    px: Float64
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
    """At most about ``count`` pixels on an even grid around the object of ``mask`` (rows, columns).

    ``points_m`` (rows, columns, 3) as in ``Geometry``. Raises UsageError("mesh-nothing-measured").
    """
    known = np.isfinite(points_m[..., 2])
    own = known & mask
    if np.count_nonzero(own) < 100:
        raise UsageError(
            "mesh-nothing-measured",
            what="The calibration has hardly a point of the object, so no mesh can be laid on it.",
            remedy="Calibrate again with the object in the camera's view and in focus.",
        )
    box = [np.flatnonzero(own.any(axis=axis)) for axis in (1, 0)]
    margin = max(int(at[-1] - at[0]) for at in box) // 8
    low = [max(0, int(at[0]) - margin) for at in box]
    high = [min(side, int(at[-1]) + 1 + margin) for at, side in zip(box, own.shape, strict=True)]
    step = max(1, round(float(np.sqrt(np.prod(np.subtract(high, low)) / count))))
    rows, columns = (np.arange(a, b, step) for a, b in zip(low, high, strict=True))
    y, x = (grid.ravel() for grid in np.meshgrid(rows, columns, indexing="ij"))
    px = np.stack([x, y], axis=1).astype(np.float64)
    return Measured(
        px, rays_of(camera, px), points_m[y, x, 2].astype(np.float64), own[y, x], float(camera.matrix[0, 0])
    )


def rays_of(camera: Pinhole, px: Float64) -> Float64:
    """(N, 3) directions at depth 1 of camera pixels (N, 2)."""
    return np.column_stack([camera.rays(px), np.ones(len(px))])


@dataclass(frozen=True, slots=True)
class Pairs:
    """The same places on both: ``on_mesh`` (N, 3) in the file's units, ``on_object_m`` (N, 3) in the camera's frame."""

    on_mesh: Float64
    on_object_m: Float64


@dataclass(frozen=True, slots=True)
class Alignment:
    """``cost``: 0 where the mesh is all that was measured, 1 where nothing of it; ``looseness``: see ``LOOSEST``."""

    pose: Pose
    cost: float
    looseness: float


def pose_by_pairs(pairs: Pairs) -> Pose:
    """The pose with the least squares of the pairs' distances (Umeyama 1991).

    Raises UsageError("mesh-pairs-flat", "mesh-mirrored").
    """
    mine, theirs = pairs.on_mesh.mean(axis=0), pairs.on_object_m.mean(axis=0)
    flat, seen = pairs.on_mesh - mine, pairs.on_object_m - theirs
    left, sizes, right = np.linalg.svd(seen.T @ flat)
    if len(flat) < 3 or sizes[1] < 1e-4 * sizes[0]:
        raise UsageError(
            "mesh-pairs-flat",
            what="The pairs of points lie on one line, or are fewer than three.",
            remedy="Give four pairs that lie far from each other and not on one line.",
        )
    hand = np.array([1.0, 1.0, np.sign(np.linalg.det(left @ right))])

    def fitted(signs: Float64) -> tuple[Pose, float]:
        rotation = left @ np.diag(signs) @ right
        scale = float((sizes * signs).sum() / np.sum(flat**2))
        pose = Pose(scale, rotation, theirs - scale * rotation @ mine)
        return pose, float(np.sqrt(np.mean(np.sum((pose.placed(pairs.on_mesh) - pairs.on_object_m) ** 2, axis=1))))

    pose, off_m = fitted(hand)
    if len(flat) > 3 and hand[2] < 0 and off_m > 3 * fitted(np.ones(3))[1] and off_m > 0.05 * np.sqrt(np.mean(seen**2)):
        raise mirrored()
    return pose


def mirrored() -> UsageError:
    """The error of a mesh that is the object's mirror image."""
    return UsageError(
        "mesh-mirrored",
        what="The mesh is the mirror image of the object.",
        remedy="Export it again without a negative scale, and with the axes of a right-handed frame.",
    )


def refined(
    mesh: SolidMesh, of: Measured, start: Pose, *, pairs: Pairs | None = None, reach: float = 0.1, steps: int = STEPS
) -> Alignment:
    """The mesh moved from ``start`` to where it fits the measured points best.

    ``reach``: how far, of the object's size, a point may be from the mesh at first; ``pairs`` hold it where the
    points leave it free.
    """
    pose, size_m = start, of.size_m
    looseness = 0.0
    for step in range(steps):
        met = mesh.met_by(of.rays, pose)
        use = of.is_object & (met.face >= 0)
        if np.count_nonzero(use) < 20:
            return Alignment(pose, 1.0, 0.0)
        at, normals = of.rays[use] * met.depth[use, None], met.normals[use]
        off = channels.total(normals * of.rays[use]) * (of.depth_m[use] - met.depth[use])
        spread = 1.4826 * float(np.median(np.abs(off)))
        limit = max(min(reach * size_m, 4.7 * spread), 1e-4 * size_m)
        weights = np.where(np.abs(off) < limit, (1 - (off / limit) ** 2) ** 2, 0.0)
        if weights.sum() < 10:
            return Alignment(pose, 1.0, 0.0)
        centre = np.average(at, axis=0, weights=weights)
        arm = (at - centre) / size_m
        rows = np.column_stack([np.cross(arm, normals), normals, channels.total(arm * normals)])
        matrix = (rows * weights[:, None]).T @ rows / weights.sum()
        right = (rows * weights[:, None]).T @ off / weights.sum()
        looseness = float(np.linalg.eigvalsh(matrix)[0])
        if pairs is not None:
            one_m = max(spread, 1e-4 * size_m)
            matrix, right = WEIGHED_AS / one_m**2 * matrix, WEIGHED_AS / one_m**2 * right
            for mine, theirs in zip(pose.placed(pairs.on_mesh), pairs.on_object_m, strict=True):
                near = (mine - centre) / size_m
                own = np.column_stack([-_cross_matrix(near), np.eye(3), near])
                weight = (CLICK_PX * theirs[2] / of.focal_px) ** -2
                matrix, right = matrix + weight * own.T @ own, right + weight * own.T @ (theirs - mine)
        matrix += np.eye(7) * 1e-9 * np.trace(matrix)
        change = np.linalg.solve(matrix, right) / np.array([size_m] * 3 + [1.0] * 3 + [size_m])
        change *= min(1.0, 0.3 / max(float(np.abs(change[[0, 1, 2, 6]]).max()), 1e-12))
        pose = pose.moved(change, centre)
        if step > 3 and np.abs(change[[0, 1, 2, 6]]).max() < 1e-6 and np.abs(change[3:6]).max() < 1e-6 * size_m:
            break
    return Alignment(pose, cost_of(mesh, of, pose), looseness)


def _cross_matrix(v: Float64) -> Float64:
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def cost_of(mesh: SolidMesh, of: Measured, pose: Pose) -> float:
    """From 0 (the mesh is where the object was measured, and nowhere else) to 1."""
    depth = mesh.met_by(of.rays, pose).depth
    near_m = NEAR * of.size_m
    hit = np.isfinite(depth)
    with np.errstate(invalid="ignore"):
        apart = np.minimum(np.abs(depth - of.depth_m) / near_m, 1.0)
        in_front = hit & ~of.is_object & (depth < of.depth_m - near_m)
    apart[~hit] = 1.0
    return float((apart[of.is_object].sum() + np.count_nonzero(in_front)) / (of.is_object.sum() + in_front.sum()))


def aligned(mesh: SolidMesh, coarse: Measured) -> list[Alignment]:
    """The mesh laid on the object without any help, at any scale: the best poses that differ, the best first."""
    outline, points = mesh.outline(), coarse.points_m
    ahead = points.mean(axis=0) / np.linalg.norm(points.mean(axis=0))
    across = np.cross((0.0, 1.0, 0.0) if abs(ahead[1]) < 0.9 else (1.0, 0.0, 0.0), ahead)
    frame = np.stack([across, np.cross(ahead, across), ahead])
    frame[:2] /= np.linalg.norm(frame[:2], axis=1, keepdims=True)
    low, high = np.percentile(points @ frame.T, (0.5, 99.5), axis=0)
    trials = []
    for rotation in _turns(TURNS):
        turned = outline @ rotation.T
        own_low, own_high = turned.min(axis=0), turned.max(axis=0)
        scale = float(np.sqrt(np.prod((high - low)[:2] / np.maximum(own_high - own_low, 1e-9 * mesh.size)[:2])))
        shift = 0.5 * (low + high) - 0.5 * scale * (own_low + own_high)
        shift[2] = low[2] - scale * own_low[2]
        pose = Pose(scale, frame.T @ rotation, frame.T @ shift)
        trials.append((cost_of(mesh, coarse, pose), pose))
    trials.sort(key=lambda trial: trial[0])
    better = [refined(mesh, coarse, pose, reach=0.25, steps=15) for _, pose in trials[:BEST_TURNS]]
    different: list[Alignment] = []
    for one in sorted(better, key=lambda trial: trial.cost):
        if all(degrees_between(one.pose, other.pose) > APART_DEGREES for other in different):
            different.append(one)
    return different


def _turns(count: int) -> Float64:
    """(count, 3, 3) rotations, spread evenly: super-Fibonacci spirals (Alexa 2022)."""
    from scipy.spatial.transform import Rotation

    at = np.arange(count) + 0.5
    inner, outer = np.sqrt(at / count), np.sqrt(1 - at / count)
    one, two = 2 * np.pi * at / np.sqrt(2), 2 * np.pi * at / 1.533751168755204288118041
    four = np.stack([inner * np.sin(one), inner * np.cos(one), outer * np.sin(two), outer * np.cos(two)], axis=1)
    return np.asarray(Rotation.from_quat(four).as_matrix())


def degrees_between(one: Pose, other: Pose) -> float:
    """The angle of the turn from one pose to the other."""
    cosine = 0.5 * (np.trace(one.rotation @ other.rotation.T) - 1)
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
