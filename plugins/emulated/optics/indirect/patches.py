"""The scene's surfaces in patches: small, nearly flat groups of faces. Each patch has two sides.

A mesh may be open or inside out, so both sides of each group count as patches of their own: ``2 * group`` is the side
that its face normals point away from, ``2 * group + 1`` the other one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from embreex import rtcore_scene
from embreex.mesh_construction import TriangleMesh

from plugins.emulated.optics.objects import Scene

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

OBJECT_SHARE: Final = 0.7
"""Of the patches, where there are surfaces, too."""
FINEST: Final = 0.25
"""Longest edge of a face, in sizes of a patch."""
FACES_COUNTED: Final = 60_000
"""Of so many faces the groups are counted, to find the size of a patch."""
CLEAR_M: Final = 2e-5
"""Rays start so far above the surface."""


@dataclass(frozen=True, slots=True)
class Hits:
    """Of rays: ``patch`` (N,), its side included, -1 for none; ``points``, and ``normals`` towards the ray (N, 3)."""

    patch: Integers
    points: Floats
    normals: Floats


@dataclass(frozen=True, slots=True)
class Patches:
    """Faces in ``groups``, sorted by group, and the rays' scene of the same faces.

    ``corners`` (F, 3, 3); ``normals`` (F, 3): of the faces; ``areas`` (F,); ``group`` (F,) rising; ``starts`` (G + 1,)
    ``albedo`` (G, 3); ``centres``, ``directions`` (G, 3): means of points and normals; ``size_m`` (G,): of its patches;
    ``body`` (G,): 0 for the object, n for surface n; ``rays``: embree's scene
    """

    corners: Floats
    normals: Floats
    areas: Floats
    group: Integers
    starts: Integers
    albedo: Floats
    centres: Floats
    directions: Floats
    body: Integers
    size_m: Floats
    rays: Any

    @property
    def count(self) -> int:
        return len(self.starts) - 1

    def hit(self, origins: Floats, rays: Floats) -> Hits:
        """What each ray hits first."""
        hits = self.rays.run(origins.astype(np.float32), rays.astype(np.float32), output=1)
        face = np.asarray(hits["primID"], dtype=np.int64)
        normals = self.normals[face]
        front = np.sum(normals * rays, axis=1) < 0.0
        return Hits(
            patch=np.where(face >= 0, 2 * self.group[face] + np.where(front, 0, 1), -1),
            points=origins + np.where(face >= 0, hits["tfar"], 0.0)[:, None] * rays,
            normals=np.where(front[:, None], normals, -normals),
        )


def patches_of(scene: Scene, count: int) -> Patches:
    """About ``count`` groups of the scene's faces; large faces are cut first."""
    surfaces = (len(scene.faces) - scene.object_faces) // 2
    on_object = count if not surfaces else round(OBJECT_SHARE * count)
    parts = [_groups(scene, np.arange(scene.object_faces), on_object)]
    areas = [_area(scene, np.arange(n, n + 2)) for n in range(scene.object_faces, len(scene.faces), 2)]
    for number in range(surfaces):
        first = scene.object_faces + 2 * number
        share = max(4, round((count - on_object) * areas[number] / sum(areas)))
        parts.append(_groups(scene, np.arange(first, first + 2), share))
    offsets = np.cumsum([0, *(part[1].max() + 1 for part in parts)])
    corners = np.concatenate([part[0] for part in parts])
    group = np.concatenate([part[1] + offset for part, offset in zip(parts, offsets, strict=False)])
    albedo = np.concatenate([part[2] for part in parts])
    body = np.repeat(np.arange(len(parts)), np.diff(offsets))
    size_m = np.repeat([part[3] for part in parts], np.diff(offsets))
    return _sorted(corners, group, albedo, body, size_m)


def _sorted(corners: Floats, group: Integers, albedo: Floats, body: Integers, size_m: Floats) -> Patches:
    order = np.argsort(group, kind="stable")
    corners, group, albedo = corners[order], group[order], albedo[order]
    normals, areas = _normals(corners)
    count = int(group[-1]) + 1
    starts = np.searchsorted(group, np.arange(count + 1))
    total = np.bincount(group, weights=areas, minlength=count)

    def mean(values: Floats) -> Floats:
        sums = [np.bincount(group, weights=areas * values[:, axis], minlength=count) for axis in range(3)]
        return np.stack(sums, axis=1) / total[:, None]

    direction = mean(normals)
    vertices = corners.reshape(-1, 3).astype(np.float32)
    rays = rtcore_scene.EmbreeScene(robust=True)
    TriangleMesh(rays, vertices, np.arange(len(vertices), dtype=np.int32).reshape(-1, 3))
    return Patches(
        corners, normals, areas, group, starts, mean(albedo), mean(corners.mean(axis=1)),
        direction / np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-12), body, size_m, rays,
    )  # fmt: skip


def _groups(scene: Scene, faces: Integers, count: int) -> tuple[Floats, Integers, Floats, float]:
    """Corners of the (cut) faces, their groups, their albedo, and the size of a group."""
    import trimesh

    size = np.sqrt(_area(scene, faces) / count)
    corners, source = _cut(scene, faces, FINEST * size)
    normals, areas = _normals(corners)
    corners, normals, source = corners[areas > 0.0], normals[areas > 0.0], source[areas > 0.0]
    middle = corners.mean(axis=1)
    whole = scene.vertices[scene.faces[source]].astype(np.float64)
    to_weights: Any = trimesh.triangles.points_to_barycentric
    weights = to_weights(whole, middle, method="cross")
    albedo = scene.albedo(middle, source.astype(np.int32), weights.astype(np.float32))
    axis = np.abs(normals).argmax(axis=1)
    side = 2 * axis + (normals[np.arange(len(axis)), axis] > 0.0)
    place = middle - middle.min(axis=0)

    def keys(size: float, step: int = 1) -> Integers:
        cells = np.floor(place[::step] / size + 1e-6).astype(np.int64)
        return np.asarray(cells @ (6, 6 * 4096, 6 * 4096**2) + side[::step])

    low, high = 0.5 * size, 4.0 * size
    for _ in range(10):
        size = np.sqrt(low * high)
        many = len(np.unique(keys(size, max(1, len(place) // FACES_COUNTED)))) > count
        low, high = (size, high) if many else (low, size)
    group = np.unique(keys(size), return_inverse=True)[1]
    return corners, group.reshape(-1), albedo.astype(np.float64), float(size)


def _cut(scene: Scene, faces: Integers, longest: float) -> tuple[Floats, Integers]:
    """Corners (F, 3, 3) of faces without longer edges, and the face of the scene that each is of."""
    import trimesh

    whole = scene.vertices[scene.faces[faces]].astype(np.float64)
    large = np.linalg.norm(whole - np.roll(whole, 1, axis=1), axis=2).max(axis=1) > longest
    if not large.any():
        return whole, faces
    subdivide: Any = trimesh.remesh.subdivide_to_size
    vertices, pieces, source = subdivide(
        scene.vertices.astype(np.float64), scene.faces[faces[large]], longest, max_iter=20, return_index=True
    )
    return np.concatenate([whole[~large], vertices[pieces]]), np.concatenate([faces[~large], faces[large][source]])


def _normals(corners: Floats) -> tuple[Floats, Floats]:
    """Unit normals (F, 3) and areas (F,)."""
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(across, axis=1)
    return across / np.maximum(length, 1e-30)[:, None], 0.5 * length


def _area(scene: Scene, faces: Integers) -> float:
    return float(_normals(scene.vertices[scene.faces[faces]].astype(np.float64))[1].sum())
