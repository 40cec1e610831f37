"""Whether the object's surface is glossy: light of a projector where the surface mirrors its lens into the camera.

Paint throws back each projector's light alike, so the reflectances that two projectors' white images give differ by
what the surface mirrors of one of them alone.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from controller.core import channels
from controller.core.arrays import Float64, FloatImage, Mask
from controller.optics.calibrate.photometry.reflectance import falling_light, subset, subset_of
from controller.optics.calibrate.values import Calibration, Geometry

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
    found = [_along(_against(lobes, n), _against(seen, n)) for n in range(len(parts))]
    strength, correlation = np.median(found, axis=0)
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
    found = []
    for projector in geometry.projectors:
        towards = -projector.rotation.T @ projector.translation_m - points
        between = towards / np.linalg.norm(towards, axis=1, keepdims=True) + seen
        found.append(np.abs(np.sum(between * normals, axis=1)) / np.linalg.norm(between, axis=1))
    return np.asarray(np.clip(found, 0, 1), np.float64)


def _against(values: Float64, n: int) -> Float64:
    """A projector's values (pixels,) less the mean of the others'."""
    return np.asarray(values[n] - np.delete(values, n, axis=0).mean(axis=0))


def _along(wanted: Float64, seen: Float64) -> tuple[float, float]:
    """How much of ``wanted`` is in ``seen`` (pixels,), and their correlation."""
    wanted, seen = wanted - wanted.mean(), seen - seen.mean()
    both = float(wanted @ seen)
    size = float(wanted @ wanted)
    return both / max(size, 1e-30), both / max(np.sqrt(size * float(seen @ seen)), 1e-30)


__all__ = ["gloss_strength", "glossy"]
