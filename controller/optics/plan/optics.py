"""What a projector does to a surface: resolution, light, grazing and focus, from its data sheet and its place.

Every figure follows from the pinhole's Jacobian J, (2, 2), from the surface's tangent plane to pixels: its singular
values are pixels by metre along the two sides of a pixel's footprint, its determinant pixels by area. A projector sends
the same flux through every pixel, so light by area is that flux times the determinant; inverse squares, cosines and the
picture's corners are all in it. Omitted, because no data sheet has them: vignetting, lamps that age.
"""

from __future__ import annotations

from typing import Final, Protocol

import numpy as np

from controller.core.arrays import Float64, Mask
from controller.optics.plan.values import Illumination, Placement, Surface

FWHM: Final = 2.0 * np.sqrt(2.0 * np.log(2.0))
PIXEL_VARIANCE_PX2: Final = 1.0 / 12.0
"""Of an evenly lit square pixel along a side."""
DISC_SIGMA: Final = 0.25
"""Standard deviation along an axis of an evenly lit disc, by its diameter."""
NEAREST_M: Final = 0.05


class Shadows(Protocol):
    """What stands in the way of light."""

    def hidden(self, from_m: Float64, points_m: Float64) -> Mask:
        """(N,) whether something lies between ``from_m`` (3,) and each of ``points_m`` (N, 3)."""


def lit_by(placement: Placement, surface: Surface, shadows: Shadows) -> Illumination:
    """What ``placement`` does at each point of ``surface``."""
    at_px, local = pixels_of(placement, surface.points_m)
    depth = np.maximum(local[:, 2], NEAREST_M)
    towards = placement.position_m - surface.points_m
    cosine = np.sum(surface.normals * towards, axis=1) / np.maximum(np.linalg.norm(towards, axis=1), NEAREST_M)
    size = np.asarray(placement.model.size_px)
    reached = (local[:, 2] > NEAREST_M) & (cosine > 0) & np.all((at_px >= -0.5) & (at_px <= size - 0.5), axis=1)
    reached[reached] = ~shadows.hidden(placement.position_m, surface.points_m[reached])
    fine, coarse = _pixels_by_metre(placement, local, depth, surface.normals)
    blur_px = blur(placement, depth)
    with np.errstate(divide="ignore"):
        pixel_mm = np.where(reached[:, None], 1e3 / np.stack((coarse, fine), axis=1), np.inf)
    flux = placement.model.lumens / float(size[0] * size[1])
    return Illumination(
        reached=reached,
        cosine=np.where(reached, cosine, 0.0),
        lux=np.where(reached, flux * fine * coarse, 0.0),
        blur_px=np.where(reached, blur_px, np.inf),
        pixel_mm=pixel_mm,
        detail_mm=np.where(reached, FWHM * np.sqrt(PIXEL_VARIANCE_PX2 + blur_px**2) * pixel_mm[:, 0], np.inf),
    )


def pixels_of(placement: Placement, points_m: Float64) -> tuple[Float64, Float64]:
    """Pixels (N, 2) and places in the projector's own frame (N, 3) of points (N, 3); what is behind it is near it."""
    local = (points_m - placement.position_m) @ placement.rotation.T
    at_px = placement.focal_px * local[:, :2] / np.maximum(local[:, 2:], NEAREST_M) + placement.centre_px
    return np.asarray(at_px), np.asarray(local)


def blur(placement: Placement, depth_m: Float64) -> Float64:
    """Standard deviation in projector pixels at depths: a thin lens' disc of confusion, and what is never sharper."""
    disc_px = placement.focal_px * placement.model.pupil_m * np.abs(1.0 / depth_m - 1.0 / placement.focus_m)
    return np.asarray(np.hypot(placement.model.sharpest_px, DISC_SIGMA * disc_px))


def best_focus(depth_m: Float64, weight: Float64) -> float:
    """The depth of focus with the least mean squared blur over points at ``depth_m`` (N,), ``weight`` (N,) each.

    The disc grows with the difference of inverse depths, so their weighted mean is the best.
    """
    return float(np.sum(weight) / np.sum(weight / depth_m))


def _pixels_by_metre(placement: Placement, local: Float64, depth: Float64, normals: Float64) -> tuple[Float64, Float64]:
    """Singular values (N,), larger first, of the Jacobian from the tangent plane at each point to pixels."""
    along, across = _tangents(normals @ placement.rotation.T)
    columns = [
        placement.focal_px / depth[:, None] * (t[:, :2] - local[:, :2] / depth[:, None] * t[:, 2:])
        for t in (along, across)
    ]
    singular = np.linalg.svd(np.stack(columns, axis=2), compute_uv=False)
    return np.asarray(singular[:, 0]), np.asarray(singular[:, 1])


def _tangents(normals: Float64) -> tuple[Float64, Float64]:
    """Two unit vectors (N, 3) across each unit normal and each other."""
    other = np.where(np.abs(normals[:, :1]) < 0.7, (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    along = np.cross(normals, other)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    return along, np.cross(normals, along)
