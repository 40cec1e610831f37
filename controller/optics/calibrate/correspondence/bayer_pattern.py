"""Which colour each of a camera's samples has, found in a photograph: what is interpolated is its neighbours' mean.

No file has to tell. Where the development was another one than ours, none fits, and the transport takes each camera
pixel's three colours as they are.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from controller.core.arrays import FloatImage

PATTERNS: Final = (((0, 1), (1, 2)), ((2, 1), (1, 0)), ((1, 0), (2, 1)), ((1, 2), (0, 1)))
EXACT: Final = 1e-4
"""Relative difference from the neighbours' mean that can still be rounding."""
PLAIN: Final = 20.0
"""The other patterns' difference must be this many times the right one's; a picture without detail fits all."""
WINDOW_PX: Final = 768


def find_bayer_pattern(image: FloatImage) -> npt.NDArray[np.int64] | None:
    """Colours (2, 2) of the samples at even and odd rows and columns, or None.

    ``image`` (rows, columns, 3): one linear photograph, not merged from several; NaN where not measured
    """
    if image.ndim != 3 or min(image.shape[:2]) < 4:
        return None
    part = _brightest(image).astype(np.float64)
    off = [_off(part, np.array(pattern)) for pattern in PATTERNS]
    best = int(np.argmin(off))
    others = min(value for index, value in enumerate(off) if index != best)
    if not (off[best] < EXACT and others > PLAIN * off[best] and others > EXACT):
        return None
    return np.array(PATTERNS[best], np.int64)


def _brightest(image: FloatImage) -> FloatImage:
    """The part around the middle of the light, at even rows and columns."""
    light = np.nan_to_num(image[::8, ::8, 1])
    total = float(light.sum())
    if not total > 0:
        return image[:WINDOW_PX, :WINDOW_PX]
    y = int(8 * float((light.sum(axis=1) * np.arange(light.shape[0])).sum()) / total) - WINDOW_PX // 2
    x = int(8 * float((light.sum(axis=0) * np.arange(light.shape[1])).sum()) / total) - WINDOW_PX // 2
    top, left = max(y, 0) & ~1, max(x, 0) & ~1
    return image[top : top + WINDOW_PX, left : left + WINDOW_PX]


def _off(image: npt.NDArray[np.float64], colours: npt.NDArray[np.int64]) -> float:
    """How far red and blue samples' other two colours are from their neighbours' means, relative to the light.

    Green comes from the four beside. The third colour comes from the corners; it tells patterns with green in common
    apart.
    """
    green = image[:, :, 1]
    beside = (green[:-2, 1:-1] + green[2:, 1:-1] + green[1:-1, :-2] + green[1:-1, 2:]) / 4 - green[1:-1, 1:-1]
    corners = (image[:-2, :-2] + image[:-2, 2:] + image[2:, :-2] + image[2:, 2:]) / 4 - image[1:-1, 1:-1]
    medians = []
    for row, column in np.argwhere(colours != 1):
        # the first row and column have been cut off
        sites = slice(1 - row, None, 2), slice(1 - column, None, 2)
        for difference in (beside[sites], corners[..., 2 - colours[row, column]][sites]):
            finite = np.abs(difference[np.isfinite(difference)])
            medians.append(float(np.median(finite)) if finite.size else np.inf)
    light = float(np.nanmean(np.abs(image))) if np.isfinite(image).any() else 0.0
    return max(medians) / light if light > 0 else np.inf
