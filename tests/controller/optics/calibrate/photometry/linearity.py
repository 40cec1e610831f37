"""How linear a camera is by two exposures of one scene: an oracle for radiometry."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from controller.core.arrays import Float64, FloatImage

FEWEST_PIXELS: Final = 50


@dataclass(frozen=True, slots=True)
class Linearity:
    """How linear the camera is: ``ratio`` of the two exposures as measured, and the largest deviation from it.

    ``deviation`` relative, over ``signal`` bins of the longer exposure's value; NaN where a bin is empty
    """

    ratio: float
    worst: float
    signal: Float64
    deviation: Float64


def check_linearity(short: FloatImage, long: FloatImage, exposure_ratio: float) -> Linearity:
    """Compare two exposures of the same still scene.

    Parameters
    ----------
    short, long : (rows, columns, 3) full-scale images, NaN where saturated
    exposure_ratio : long over short as the camera says; used where the measured ratio is meaningless
    """
    use = np.isfinite(short) & np.isfinite(long) & (short > 0.02) & (long < 0.97)
    assert np.count_nonzero(use) >= FEWEST_PIXELS, "no part of the scene is well exposed in both"
    low, high = short[use].astype(np.float64), long[use].astype(np.float64)
    ratio = float(high.sum() / low.sum()) if low.sum() > 0 else exposure_ratio
    edges = np.linspace(0, 1, 17)
    # binned by what both say together: binning by one of them would pick its noise
    where = np.clip(np.digitize((high + ratio * low) / 2, edges) - 1, 0, 15)
    count = np.bincount(where, minlength=16)
    with np.errstate(invalid="ignore", divide="ignore"):
        ratios = np.bincount(where, high, 16) / np.bincount(where, low, 16)
    deviation = np.where(count >= FEWEST_PIXELS, ratios / ratio - 1, np.nan)
    worst = float(np.nanmax(np.abs(deviation))) if np.isfinite(deviation).any() else 0.0
    return Linearity(ratio, worst, (edges[:-1] + edges[1:]) / 2, deviation)
