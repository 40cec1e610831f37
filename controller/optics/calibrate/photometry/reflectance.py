"""The object's own pattern: its reflectance in even white light, from its white images and its shape; and its gloss.

A glossy surface adds light of a projector where it mirrors its lens into the camera. Paint throws back each projector's
light alike, so the reflectances that two projectors' white images give differ by what the surface mirrors of one of
them alone.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from controller.core import channels
from controller.core.arrays import Float64, FloatImage, Mask
from controller.core.blur import nearest_known
from controller.optics.calibrate.values import Calibration, Geometry

BRIGHT: Final = 0.3
"""Of a projector's strongest light: pixels that compare the strengths of projectors."""
FAINTEST: Final = 0.1
"""Of the median light of all projectors: below it, at grazing edges, reflectance is not known."""
WHITEST: Final = 99.0
ENOUGH_PIXELS: Final = 400_000
"""So many stand for a larger picture."""


def own_reflectance(calibration: Calibration, geometry: Geometry | None, matt: FloatImage | None = None) -> FloatImage:
    """(rows, columns, 3) float32, about 1 for the palest paint; NaN where it is not known.

    The white images over the light that falls there by the surface's slope and distance. Without ``geometry`` of
    these projectors they are taken as they are, with their shading. ``matt`` (rows, columns, 1): the share of the
    light that is no highlight; None: all of it
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
    light = light if matt is None else light * matt
    reflectance = np.divide(light, falling, out=np.full(light.shape, np.nan, np.float32), where=known[..., None])
    return np.asarray(reflectance / np.percentile(reflectance[known], WHITEST), np.float32)


def reflectance_everywhere(calibration: Calibration, own: FloatImage) -> FloatImage:
    """``own_reflectance`` on all of the object, also where it is not known, as on a frame beside a plane.

    There as much light falls as on the nearest pixel that the same projectors light, and whose reflectance is known.
    """
    whites = np.stack([part.white for part in calibration.projectors])
    lit = whites.min(axis=3) > 1e-3 * whites.max(initial=0)
    known, everywhere = channels.finite(own), own.copy()
    for by in np.unique(lit[:, calibration.object_mask & ~known], axis=1).T:
        both = known & lit[by].all(axis=0)
        if not by.any() or not both.any():
            continue
        here = calibration.object_mask & ~known & (lit == by[:, None, None]).all(axis=0)
        there = tuple(index[here] for index in nearest_known(both)[1])
        light = whites[by].sum(axis=0)
        everywhere[here] = np.minimum(own[there] * light[here] / light[there], 1)
    return everywhere


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


SHARPNESS: Final = 25.0
"""Exponent of the highlight that is looked for: broader and narrower ones go along with it."""
STEEPEST: Final = 0.3
"""Of the light that falls where most does: less comes at grazing angles, where the shape is not known well enough."""
DARKEST: Final = 0.1
FEWEST_PIXELS: Final = 2000
NAMED: Final = 0.01
"""Strength from which gloss is named: stages without any have at most 0.003."""
LEAST_CORRELATION: Final = 0.4
"""Between what is seen and what is looked for; errors of the shape and of indirect light reach 0.25."""


def gloss_strength(calibration: Calibration, geometry: Geometry | None) -> float:
    """The highlight's light over that of white paint, from 0, times (exponent + 8) / 8 at its peak (Blinn and Phong).

    0 where none is found or too little is known: it takes the ``geometry`` of these projectors, and two of them on the
    same pixels. ``calibration``: with white images of direct light
    """
    parts = calibration.projectors
    if geometry is None or len(parts) < 2 or len(geometry.projectors) != len(parts):
        return 0.0
    thin = subset(calibration.object_mask)
    shape = subset_of(geometry, thin)
    falling, whites = np.stack(falling_light(shape)), np.stack([part.white[thin] for part in parts])
    use = _known(calibration.object_mask[thin], falling, whites)
    if np.count_nonzero(use) < FEWEST_PIXELS:
        return 0.0
    lobes = _mirrored(shape, use) ** SHARPNESS
    seen = whites[:, use].astype(np.float64) / falling[:, use, None]
    # a median: most pixels mirror no projector
    seen /= np.median(seen / seen[:1], axis=1, keepdims=True)
    seen = channels.mean(seen / np.percentile(seen.mean(axis=0), 99, axis=0))
    fits = [_along(_against(lobes, n), _against(seen, n)) for n in range(len(parts))]
    strength, correlation = np.median(fits, axis=0)
    if correlation < LEAST_CORRELATION:
        return 0.0
    return float(max(strength * 8 / (SHARPNESS + 8), 0.0))


def glossy(strength: float) -> str | None:
    """What a technician should know of ``gloss_strength``; None where the surface is matt."""
    if strength < NAMED:
        return None
    return (
        f"The object is glossy: its highlights add {100 * strength:.0f} % of the light of white paint. People beside "
        "the camera see them elsewhere. Where it is allowed, make the surface matt. Else place the projectors more to "
        "the side, so that the surface mirrors none of them to where people stand. Then calibrate again."
    )


def _known(mask: Mask, falling: FloatImage, whites: FloatImage) -> Mask:
    """(rows, columns): pixels that all projectors light well."""
    if not mask.any():
        return mask
    light = whites.min(axis=3)
    most, brightest = (np.percentile(images[:, mask], 95, axis=1)[:, None, None] for images in (falling, light))
    return np.asarray(mask & ((falling > STEEPEST * most) & (light > DARKEST * brightest)).all(axis=0))


def _mirrored(geometry: Geometry, use: Mask) -> Float64:
    """(projectors, pixels) cosine between the normal and the middle of the directions to lens and camera."""
    points, normals = geometry.points_m[use].astype(np.float64), geometry.normals[use].astype(np.float64)
    seen = -points / np.linalg.norm(points, axis=1, keepdims=True)
    cosines = []
    for projector in geometry.projectors:
        towards = -projector.rotation.T @ projector.translation_m - points
        between = towards / np.linalg.norm(towards, axis=1, keepdims=True) + seen
        cosines.append(np.abs(np.sum(between * normals, axis=1)) / np.linalg.norm(between, axis=1))
    return np.asarray(np.clip(cosines, 0, 1), np.float64)


def _against(values: Float64, n: int) -> Float64:
    """A projector's values (pixels,) less the mean of the others'."""
    return np.asarray(values[n] - np.delete(values, n, axis=0).mean(axis=0))


def _along(wanted: Float64, seen: Float64) -> tuple[float, float]:
    """How much of ``wanted`` is in ``seen`` (pixels,), and their correlation."""
    wanted, seen = wanted - wanted.mean(), seen - seen.mean()
    both = float(wanted @ seen)
    size = float(wanted @ wanted)
    return both / max(size, 1e-30), both / max(np.sqrt(size * float(seen @ seen)), 1e-30)
