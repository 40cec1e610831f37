"""What the audience sees: the object from a place, pixel by pixel, as points at which a plan can be judged."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from controller.core.arrays import Float64, Mask
from controller.optics.plan.target_object import AFTER_M, TargetObject
from controller.optics.plan.values import Surface

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
