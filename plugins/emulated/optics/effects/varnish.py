"""A rough varnish: what its highlights add to the light of the paint below (Walter et al. 2007, GGX)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from plugins.emulated.optics.shapes import dot

Floats = npt.NDArray[np.float64]


def reflected(towards_light: Floats, towards_eye: Floats, normals: Floats, roughness: float, index: float) -> Floats:
    """pi times the varnish's reflectance (N,) for unit directions (N, 3): what a highlight adds to a paint's albedo.

    D F G / (4 cos cos) with the distribution and shadowing of GGX and Fresnel's factor for unpolarised light.
    ``roughness``: alpha of GGX; ``index``: of refraction. 0 where light or eye is below the surface.
    """
    half = towards_light + towards_eye
    half = half / np.maximum(np.sqrt(dot(half, half)), 1e-12)[:, None]
    to_light, to_eye = dot(normals, towards_light), dot(normals, towards_eye)
    above = (to_light > 1e-6) & (to_eye > 1e-6)
    to_light, to_eye = np.where(above, to_light, 1.0), np.where(above, to_eye, 1.0)
    square = roughness * roughness
    facets = square / (np.pi * (dot(normals, half) ** 2 * (square - 1.0) + 1.0) ** 2)
    seen = _unshadowed(to_light, square) * _unshadowed(to_eye, square)
    mirrored = fresnel(np.clip(dot(towards_light, half), 0.0, 1.0), index)
    return np.where(above, np.pi * facets * seen * mirrored / (4.0 * to_light * to_eye), 0.0)


def fresnel(cosine: Floats, index: float) -> Floats:
    """Share (N,) of unpolarised light that is mirrored by a surface of a refractive ``index`` in air."""
    inside = np.sqrt(1.0 - (1.0 - cosine**2) / index**2)
    across = (cosine - index * inside) / (cosine + index * inside)
    along = (index * cosine - inside) / (index * cosine + inside)
    return np.asarray(0.5 * (across**2 + along**2))


def _unshadowed(cosine: Floats, square: float) -> Floats:
    """Smith's share of facets that a direction sees."""
    return np.asarray(2.0 * cosine / (cosine + np.sqrt(square + (1.0 - square) * cosine**2)))
