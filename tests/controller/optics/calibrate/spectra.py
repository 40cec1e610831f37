"""Spectra of lamps, paints and a camera, added up by wavelength: colours that no one mixing explains."""

from __future__ import annotations

import numpy as np

from controller.core.arrays import Float64

NM = np.arange(400.0, 701.0, 1.0)
CAMERA = ((605.0, 40.0), (535.0, 40.0), (460.0, 30.0))
"""Peak and standard deviation of red, green and blue, nm."""
LAMP = ((620.0, 20.0), (540.0, 25.0), (455.0, 15.0))


def bands(levels: tuple[tuple[float, float], ...]) -> Float64:
    """(3, wavelengths)."""
    return np.stack([np.exp(-0.5 * ((NM - peak) / width) ** 2) for peak, width in levels])


def paints() -> Float64:
    """(3, wavelengths) of red, green and blue paint, each of which reaches into its neighbour's band."""
    red, blue = 1 / (1 + np.exp(-(NM - 588.0) / 14.0)), 1 / (1 + np.exp((NM - 490.0) / 14.0))
    return np.stack([red, 1 - red - blue, blue])


def colours() -> Float64:
    """(3 camera, 3 paint, 3 lamp): light in a camera channel by paint and channel of the lamp; white on white is 1."""
    lamp = bands(LAMP) / bands(LAMP).sum(axis=1, keepdims=True)
    seen = np.einsum("kw,jw,cw->kjc", bands(CAMERA), paints(), lamp)
    return np.asarray(seen / seen.sum(axis=(1, 2))[:, None, None])


def as_tuples(values: Float64) -> tuple[tuple[tuple[float, ...], ...], ...]:
    """For a ``Scene``, which is hashed."""
    return tuple(tuple(tuple(map(float, row)) for row in matrix) for matrix in values)
