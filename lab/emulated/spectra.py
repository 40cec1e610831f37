"""Light by wavelength: what the camera sees depends on lamp and paint together, and its colours are its own.

A projector's red, green and blue and the camera's three filters are Gaussians of wavelength. A paint reflects its
red, green and blue albedo in three smooth bands that add up to 1. So the camera sees of a channel on a paint a sum
of the paint's three albedos, with weights for each pair: mixing is different for each paint.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from plugins.emulated.core.truth import Bands

Floats = npt.NDArray[np.float64]
WAVELENGTHS_NM: Final = np.arange(380.0, 781.0, 2.0)
EDGES_NM: Final = (492.0, 586.0)
"""Where a paint's blue band ends and its red band begins."""
SOFT_NM: Final = 12.0
D65_WHITE: Final = (0.95047, 1.0, 1.08883)
D65_K: Final = 6504.0
_LOBES: Final = (
    ((1.056, 599.8, 37.9, 31.0), (0.362, 442.0, 16.0, 26.7), (-0.065, 501.1, 20.4, 26.2)),
    ((0.821, 568.8, 46.9, 40.5), (0.286, 530.9, 16.3, 31.1)),
    ((1.217, 437.0, 11.8, 36.0), (0.681, 459.0, 26.0, 13.8)),
)
"""CIE 1931's colour matching functions as sums of lobes: height, peak, widths below and above (Wyman et al. 2013)."""


def bands(levels: Bands) -> Floats:
    """(3, wavelengths): Gaussians of peak and standard deviation, nm; each has the sum 1."""
    curves = np.stack([np.exp(-0.5 * ((WAVELENGTHS_NM - peak) / width) ** 2) for peak, width in levels])
    return np.asarray(curves / curves.sum(axis=1, keepdims=True))


def paint_bands() -> Floats:
    """(3, wavelengths): what a paint of red, green or blue albedo 1 reflects; together 1."""
    not_blue, red = (1.0 / (1.0 + np.exp(-(WAVELENGTHS_NM - edge) / SOFT_NM)) for edge in EDGES_NM)
    return np.stack((red, not_blue - red, 1.0 - not_blue))


def colours(lamp: Bands, filters: Bands, white: npt.ArrayLike) -> Floats:
    """(3 camera, 3 paint, 3 projector channels): light in a camera channel by albedo and projector channel.

    White light on white paint gives the camera ``white`` (3,).
    """
    seen = np.einsum("kw,jw,cw->kjc", bands(filters), paint_bands(), bands(lamp))
    return np.asarray(seen * (np.asarray(white) / seen.sum(axis=(1, 2)))[:, None, None])


def matching_functions() -> Floats:
    """(3, wavelengths): x, y, z."""
    curves = []
    for lobes in _LOBES:
        curve = np.zeros_like(WAVELENGTHS_NM)
        for height, peak, below, above in lobes:
            width = np.where(peak > WAVELENGTHS_NM, below, above)
            curve += height * np.exp(-0.5 * ((WAVELENGTHS_NM - peak) / width) ** 2)
        curves.append(curve)
    return np.stack(curves)


def daylight() -> Floats:
    """(wavelengths,): Planck's law at the temperature of D65."""
    metres = WAVELENGTHS_NM * 1e-9
    return np.asarray(metres**-5 / (np.exp(0.014387769 / (metres * D65_K)) - 1.0) * 1e-30)


def xyz_to_camera(filters: Bands) -> Floats:
    """(3, 3): as its maker would measure it, by smooth paints in daylight; D65's white gives (1, 1, 1)."""
    light, paint = daylight(), paint_bands()
    steps = np.linspace(0.05, 0.95, 4)
    albedo = np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3)
    reflected = albedo @ paint * light
    seen, xyz = (reflected @ curves.T / (curves @ light) for curves in (bands(filters), matching_functions()))
    xyz *= D65_WHITE
    # Least squares for the paints, with white exactly: the rest of each row is free in two dimensions.
    free = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, -1.0]])
    grey = np.outer(D65_WHITE, np.full(3, 1.0 / 3.0))
    rest = np.linalg.lstsq(seen @ free, xyz - seen @ grey.T, rcond=None)[0]
    return np.asarray(np.linalg.inv(grey + rest.T @ free.T))
