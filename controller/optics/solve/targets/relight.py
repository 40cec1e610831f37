"""New light and new material from the reconstructed normals."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from controller.core import channels
from controller.core.arrays import FloatImage, Mask
from controller.core.blur import nearest_known
from controller.core.errors import UsageError
from controller.optics.calibrate.values import Geometry
from controller.optics.solve.targets.patterns import Colour
from controller.optics.solve.targets.values import Target


@dataclass(frozen=True, slots=True)
class GlossLook:
    """Settings of a glossy body; those of stage.toml have the same names.

    ``light_direction``: from the object towards a distant light, in the camera's frame (x right, y down, z away)
    ``shininess``: exponent of the highlight; ``strength``: its peak, as a share of white
    ``ambient``: share of the light that comes from all directions
    ``smoothing_px``: standard deviation of the smoothing of the normals, which noise would otherwise make glitter
    """

    base_colour: Colour = (0.30, 0.12, 0.08)
    light_direction: tuple[float, float, float] = (-0.5, -0.7, -1.0)
    shininess: float = 60.0
    strength: float = 0.75
    ambient: float = 0.3
    smoothing_px: float = 1.5


GLOSSY: Final = GlossLook()


def gloss(geometry: Geometry, mask: Mask, look: GlossLook = GLOSSY) -> Target:
    """A diffuse body with a highlight: Lambert plus Blinn-Phong (Blinn 1977), clipped to [0, 1].

    Raises UsageError("light-direction-invalid") for a direction of no length.
    """
    light = np.asarray(look.light_direction, dtype=np.float64)
    length = float(np.linalg.norm(light))
    if not (np.isfinite(length) and length > 0):
        raise UsageError(
            "light-direction-invalid",
            what=f"A light can't come from the direction {look.light_direction}.",
            remedy="Give three numbers that are not all 0, e.g. -0.5 -0.7 -1 for a light from above the camera's left.",
        )
    normals, directions, known = smooth_normals(geometry, mask, look.smoothing_px)
    towards_light = (light / length).astype(np.float32)
    half = towards_light - directions
    half /= np.maximum(np.linalg.norm(half, axis=2, keepdims=True), 1e-6)
    lit = np.clip(normals @ towards_light, 0, 1)
    highlight = np.clip(channels.total(normals * half), 0, 1) ** np.float32(look.shininess) * (lit > 0)
    body = np.float32(look.ambient) + np.float32(1 - look.ambient) * lit
    image = (
        body[..., None] * np.asarray(look.base_colour, dtype=np.float32)
        + np.float32(look.strength) * highlight[..., None]
    )
    return Target(np.where(known[..., None], np.clip(image, 0, 1), 0).astype(np.float32), known)


def recolour(image: FloatImage, mask: Mask, tint: Colour) -> Target:
    """A picture, such as the white image scaled to [0, 1], seen through a colour filter.

    ``image`` (rows, columns, 3) or (rows, columns), linear; values that are not finite leave the mask.
    """
    full = image if image.ndim == 3 else np.repeat(image[..., None], 3, axis=2)
    known = mask & channels.finite(full)
    tinted = np.where(known[..., None], full, 0) * np.asarray(tint, dtype=np.float32)
    return Target(np.clip(tinted, 0, 1).astype(np.float32), known)


def smooth_normals(
    geometry: Geometry, mask: Mask, sigma_px: float, reach_px: int = 8
) -> tuple[FloatImage, FloatImage, Mask]:
    """Unit normals averaged over neighbours, unit directions of view, both 0 outside the mask of where they are known.

    Gaps of at most ``reach_px`` are filled from the nearest known pixel.
    """
    from scipy import ndimage

    known = mask & channels.finite(geometry.normals) & channels.finite(geometry.points_m)
    distance, nearest = nearest_known(known)
    filled = mask & (distance <= reach_px) & known.any()
    normals = np.where(filled[..., None], geometry.normals[nearest], 0).astype(np.float32)
    normals = np.nan_to_num(normals)
    if sigma_px > 0:
        # beyond the picture as beyond the object: nothing
        normals = ndimage.gaussian_filter(normals, (sigma_px, sigma_px, 0), mode="constant", truncate=3.0)
    length = np.linalg.norm(normals, axis=2, keepdims=True)
    directions = np.where(filled[..., None], geometry.points_m[nearest], 0)
    directions /= np.maximum(np.linalg.norm(directions, axis=2, keepdims=True), 1e-9)
    unit = np.where(filled[..., None], normals / np.maximum(length, 1e-9), 0)
    return unit.astype(np.float32), directions.astype(np.float32), filled
