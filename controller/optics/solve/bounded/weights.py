"""How much each camera pixel counts in the solve of an appearance."""

from __future__ import annotations

from typing import Final

import numpy as np

from controller.core import channels
from controller.core.arrays import FloatImage, Mask

BEYOND_REACH: Final = 0.2
"""A pixel that can't be right anyway must not spoil its neighbours, but should still look as near as it can."""
DARKNESS_EXPONENT: Final = 0.7
"""Between even weights (0) and the squared slope of L* (4/3): measured on the demo's targets, it gives the lowest 95th
percentile of CIEDE2000 for no loss in the median."""
DARKEST: Final = 0.02


def appearance_weights(target: FloatImage, reachable: Mask, white: float) -> FloatImage:
    """Weights (rows, columns) float32 of mean 1: more for the dark, where the eye sees a difference sooner.

    ``target`` (rows, columns, 3) radiance; ``white`` its white, > 0; ``reachable`` as ``solve.feasibility`` finds it
    """
    light = channels.mean(target) / np.float32(white) + np.float32(DARKEST)
    weights = light ** np.float32(-DARKNESS_EXPONENT) * np.where(reachable, 1, BEYOND_REACH)
    return np.asarray(weights / weights.mean(dtype=np.float64), np.float32)
