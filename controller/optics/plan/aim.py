"""Turning, zooming and focusing a projector at a place, so that its picture holds the object."""

from __future__ import annotations

from typing import Final

import numpy as np

from controller.core.arrays import Float64
from controller.optics.plan.optics import best_focus
from controller.optics.plan.values import MountingPoint, Placement, ProjectorModel, Surface

ROUNDS: Final = 40
DOWN: Final = (0.0, 1.0, 0.0)
STEEPEST: Final = 0.999
"""Cosine to the vertical from which "upright" means nothing, and the picture's top points away from the audience."""


def aimed(model: ProjectorModel, mounting_point: MountingPoint, surface: Surface, fill: float) -> Placement | None:
    """The projector at ``mounting_point``, upright, with the seen part of ``surface`` in the middle of its picture.

    Direction and zoom depend on each other through the lens shift and are found together. ``fill``: the share of the
    picture, along its tighter side, that the object takes; less where the zoom does not reach so far, more where even
    its shortest throw is too long. None where the object is beside or behind the place.
    """
    size = np.asarray(model.size_px, np.float64)
    middle = 0.5 * (size - 1.0)
    shift = np.asarray(model.lens_shift) * size
    centre = middle + np.array([-shift[0], shift[1]])
    position = np.asarray(mounting_point.position_m, np.float64)
    seen = surface.points_m[surface.area_m2 > 0]
    target, focal = seen.mean(axis=0), model.throw_ratio[0] * size[0]
    local, across = np.empty_like(seen), _level(target - position)
    for _ in range(ROUNDS):
        turned = _facing(target - position, across)
        local = (seen - position) @ turned.T
        if local[:, 2].min() <= 0.05:
            return None
        flat = local[:, :2] / local[:, 2:]
        low, high = flat.min(axis=0), flat.max(axis=0)
        wanted = fill * float(np.min(size / (high - low)))
        focal = float(np.clip(wanted, model.throw_ratio[0] * size[0], model.throw_ratio[1] * size[0]))
        miss = 0.5 * (low + high) + (centre - middle) / focal
        if np.abs(miss).max() * focal < 0.01:
            break
        target = target + float(local[:, 2].mean()) * (turned.T @ (*miss, 0.0))
    weight = surface.area_m2[surface.area_m2 > 0] / local[:, 2] ** 2
    return Placement(
        model, mounting_point, turned, focal, (float(centre[0]), float(centre[1])), best_focus(local[:, 2], weight)
    )


def _level(forward: Float64) -> Float64:
    """The horizontal direction (3,) to the right of who looks ``forward``; looking straight down, the audience's."""
    ahead = forward / np.linalg.norm(forward)
    right = np.cross(DOWN if abs(ahead[1]) < STEEPEST else (0.0, 0.0, -1.0), ahead)
    return np.asarray(right / np.linalg.norm(right))


def _facing(forward: Float64, across: Float64) -> Float64:
    """(3, 3) world to device: z forward, x as near to ``across`` as that goes.

    From almost above, a lens shift turns the axis past the vertical; what is level must not turn over with it.
    """
    ahead = forward / np.linalg.norm(forward)
    right = across - (across @ ahead) * ahead
    right /= np.linalg.norm(right)
    return np.stack((right, np.cross(ahead, right), ahead))
