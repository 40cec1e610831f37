"""How much of each colour of a projector the camera sees depends on the paint, because paint and lamps have spectra.

Reflectances of paint are nearly a sum of three (Maloney 1986). Then what a camera channel sees of a projector channel
is a sum of what the three camera channels see of white there: W_k r becomes the sum over j of W_j B_kj r. One B of 27
numbers holds for all paints of a stage, and the colour tiles tell it: each shows another colour on another paint.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from controller.core.arrays import Float64
from controller.optics.calibrate.photometry.colour_tiles import TileMeasurements

LIKELY: Final = 0.3
"""Standard deviation of its numbers before tiles are looked at."""
LIKELY_NOISE: Final = 0.01
"""Of a tile of mean weight, beside that."""
FAINTEST: Final = 0.02
"""Of the brightest of a paint's colours: less is taken for so much, because the quotient would be noise."""


def colour_of(white: Float64) -> Float64:
    """(..., 3, 3): ``white`` (..., 3) of channel j over that of channel k, at [k, j]."""
    floor = FAINTEST * white.max(axis=-1, keepdims=True)
    safe = np.maximum(white, np.maximum(floor, 1e-30))
    return np.asarray(safe[..., None, :] / safe[..., :, None], np.float64)


def fit_paint_mixing(tiles: TileMeasurements, shown: Float64, weight: Float64, mixing: Float64) -> Float64:
    """B (3, 3, 3): camera channel, projector channel, camera channel of white.

    Parameters
    ----------
    tiles : ``ratio`` without stray light of other tiles
    shown : (tiles, 3) light of each projector channel
    weight : (tiles, 3) of each measurement
    mixing : (3, 3) of all paints together, which B is near to where nothing else is known
    """
    quotient = colour_of(tiles.white)
    found = np.zeros((3, 3, 3))
    others = shown[:, :2] - shown[:, 2:]
    for channel in range(3):
        root = np.sqrt(weight[:, channel])
        parts = [others * quotient[:, channel, j, None] for j in range(3)]
        equations = np.concatenate(parts, axis=1) * root[:, None]
        before = np.zeros(6)
        before[2 * channel : 2 * channel + 2] = mixing[channel, :2]
        left = (tiles.ratio[:, channel] - shown[:, 2]) * root - equations @ before
        prior = np.eye(6) * np.sqrt(weight[:, channel].mean()) * LIKELY_NOISE / LIKELY
        solved = np.linalg.lstsq(np.concatenate([equations, prior]), np.concatenate([left, np.zeros(6)]), rcond=None)[0]
        two = (before + solved).reshape(3, 2).T  # projector channel, channel of white
        found[channel, :2] = two
        found[channel, 2] = (np.arange(3) == channel) - two.sum(axis=0)
    return found


def paint_light(tiles: TileMeasurements, shown: Float64, paint: Float64) -> Float64:
    """(tiles, 3): light over white by B."""
    return np.asarray(np.einsum("tkj,kcj,tc->tk", colour_of(tiles.white), paint, shown))
