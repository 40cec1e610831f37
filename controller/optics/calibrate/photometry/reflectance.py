"""The object's own pattern: its reflectance in even white light, from its white images and its shape."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from controller.core import channels
from controller.core.arrays import FloatImage, Mask
from controller.optics.calibrate.values import Calibration, Geometry

BRIGHT: Final = 0.3
"""Of a projector's strongest light: pixels that compare the strengths of projectors."""
FAINTEST: Final = 0.1
"""Of the median light of all projectors: below it, at grazing edges, reflectance is not known."""
WHITEST: Final = 99.0
ENOUGH_PIXELS: Final = 400_000
"""So many stand for a larger picture."""


def own_reflectance(calibration: Calibration, geometry: Geometry | None) -> FloatImage:
    """(rows, columns, 3) float32, about 1 for the palest paint; NaN where it is not known.

    The white images over the light that falls there by the surface's slope and distance. Without ``geometry`` of
    these projectors they are taken as they are, with their shading.
    """
    whites = np.stack([part.white for part in calibration.projectors])
    mask = calibration.object_mask
    if geometry is None or len(geometry.projectors) != len(whites):
        light, falling = whites.sum(axis=0), np.ones_like(whites[0])
    else:
        lit = whites.min(axis=3) > 1e-3 * whites.max(initial=0)
        shapes = np.stack([np.where(on, shape, 0) for on, shape in zip(lit, falling_light(geometry), strict=True)])
        light = np.where(shapes[..., None] > 0, whites, 0).sum(axis=0)
        falling = np.einsum("nyx,nc->yxc", shapes, _strengths(whites, shapes)).astype(np.float32)
    known = mask & (channels.smallest(falling) > FAINTEST * float(np.median(falling[mask]) if mask.any() else 1.0))
    if not known.any():
        return np.full(calibration.black.shape, np.nan, np.float32)
    found = np.divide(light, falling, out=np.full(light.shape, np.nan, np.float32), where=known[..., None])
    return np.asarray(found / np.percentile(found[known], WHITEST), np.float32)


def falling_light(geometry: Geometry) -> list[FloatImage]:
    """Light of each projector (rows, columns) by cos / r^2, up to a factor; 0 where nothing is known."""
    shapes = []
    for projector in geometry.projectors:
        towards = -projector.rotation.T @ projector.translation_m - geometry.points_m
        distance = channels.length(towards)
        with np.errstate(invalid="ignore", divide="ignore"):
            cosine = channels.total(towards * geometry.normals) / distance
            shapes.append(np.nan_to_num(np.maximum(cosine, 0) / distance**2, posinf=0.0).astype(np.float32))
    return shapes


def subset(mask: Mask) -> tuple[slice, slice]:
    """Every so many rows and columns of a picture like ``mask``, about ``ENOUGH_PIXELS`` together."""
    step = max(1, int(np.sqrt(mask.size / ENOUGH_PIXELS)))
    return np.s_[::step, ::step]


def subset_of(geometry: Geometry, pixels: tuple[slice, slice]) -> Geometry:
    """The same surface, known on these camera pixels alone."""
    return replace(geometry, points_m=geometry.points_m[pixels], normals=geometry.normals[pixels])


def _strengths(whites: FloatImage, shapes: FloatImage) -> FloatImage:
    """(projectors, 3): their light at the same slope and distance, relative to the first one's."""
    strengths = np.ones((len(whites), 3), np.float32)
    bright = [shape > BRIGHT * shape.max(initial=0) for shape in shapes]
    for n in range(1, len(whites)):
        both = bright[0] & bright[n] & (channels.smallest(whites[0]) > 0)
        if both.any():
            ratio = whites[n][both] / whites[0][both] * (shapes[0][both] / shapes[n][both])[:, None]
            strengths[n] = np.median(ratio, axis=0)
    return strengths
