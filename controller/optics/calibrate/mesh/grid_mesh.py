"""The object as a mesh: the camera's pixel grid, cut where the depth jumps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from controller.core.arrays import FloatImage
from controller.optics.calibrate.values import Geometry

STEEPEST = 6.0
"""Edges longer than this many times a pixel's width on the object, seen head-on, join two different surfaces."""


@dataclass(frozen=True, slots=True)
class Mesh:
    """Triangles with outward normals, counter-clockwise seen from the camera's side.

    ``vertices_m``, ``normals`` (vertices, 3) float32; ``triangles`` (triangles, 3) int32;
    ``camera_px`` (vertices, 2) float32: where the camera sees each vertex, its texture coordinate
    """

    vertices_m: FloatImage
    normals: FloatImage
    triangles: npt.NDArray[np.int32]
    camera_px: FloatImage


def grid_mesh(geometry: Geometry, *, step: int = 1) -> Mesh:
    """Join adjacent camera pixels into triangles where all three corners are known and lie on one surface.

    ``step``: use every n-th pixel in both directions. Vertices that no triangle uses are left out.
    """
    points = geometry.points_m[::step, ::step]
    rows, columns = points.shape[:2]
    index = np.arange(rows * columns, dtype=np.int32).reshape(rows, columns)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
    # image rows run downwards, so this order turns counter-clockwise towards the camera
    corners = np.concatenate([np.stack(t, axis=2).reshape(-1, 3) for t in ((a, c, b), (b, c, d))])
    flat = points.reshape(-1, 3)
    reach = STEEPEST * step / float(geometry.camera.matrix[0, 0])
    keep = _joined(flat, corners, reach) & np.isfinite(geometry.normals[::step, ::step].reshape(-1, 3)[corners, 0]).all(
        axis=1
    )
    corners = corners[keep]
    used, renumbered = np.unique(corners, return_inverse=True)
    y, x = np.divmod(used, columns)
    return Mesh(
        vertices_m=flat[used],
        normals=geometry.normals[::step, ::step].reshape(-1, 3)[used],
        triangles=renumbered.reshape(-1, 3).astype(np.int32),
        camera_px=np.stack([x, y], axis=1).astype(np.float32) * step,
    )


def _joined(points: FloatImage, corners: npt.NDArray[np.int32], reach: float) -> npt.NDArray[np.bool_]:
    """Whether all three edges of each triangle are at most ``reach`` times as long as it is far away."""
    keep = np.isfinite(points[corners, 2]).all(axis=1)
    for first, second in ((0, 1), (1, 2), (2, 0)):
        start, end = points[corners[:, first]], points[corners[:, second]]
        with np.errstate(invalid="ignore"):
            keep &= np.linalg.norm(end - start, axis=1) <= reach * np.minimum(start[:, 2], end[:, 2])
    return np.asarray(keep)
