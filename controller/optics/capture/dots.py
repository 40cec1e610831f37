"""The paper's patterns: one lit pixel in every r x r block of a projector's image, r^2 of them (paper 4.1).

The fast way measures the same metapixels from 35 photographs (``patterns``). Dots remain the reference to compare with,
and the way to see a single pixel's light where one camera pixel looks at two surfaces.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from controller.core.arrays import ByteImage
from controller.core.errors import UsageError

PAPER_SPACING_PX: Final = 16
SIGMAS_APART: Final = 6.5
"""Dots this many standard deviations apart do not disturb each other's fit: their Gaussians meet at 3.25."""
LEAST_SPACING_PX: Final = 4


@dataclass(frozen=True, slots=True)
class DotPattern:
    """One picture: the projector pixels with x = ``column`` and y = ``row`` modulo ``spacing_px`` are lit."""

    name: str
    column: int
    row: int
    spacing_px: int


def dot_patterns(size_px: tuple[int, int], r: int = PAPER_SPACING_PX) -> tuple[DotPattern, ...]:
    """The patterns in which each pixel of a projector of ``size_px`` (width, height) is lit just once.

    There are r^2 of them, fewer where the projector is smaller than r. Names: ``dot-00-00``.., column first.

    Raises UsageError("dot-spacing-wrong") for ``r`` below 1, or a projector without pixels.
    """
    width, height = size_px
    if r < 1 or min(size_px) < 1:
        raise UsageError(
            "dot-spacing-wrong",
            what=f"Dots {r} pixels apart do not fit on a projector of {width}x{height}.",
            remedy=f"Choose a spacing of at least {LEAST_SPACING_PX} pixels; {PAPER_SPACING_PX} works for every focus.",
        )
    return tuple(
        DotPattern(f"dot-{column:02d}-{row:02d}", column, row, r)
        for row in range(min(r, height))
        for column in range(min(r, width))
    )


def dot_frame(pattern: DotPattern, size_px: tuple[int, int]) -> ByteImage:
    """(rows, columns, 3) uint8 device values: the dots at white, all else at black."""
    width, height = size_px
    frame = np.zeros((height, width, 3), np.uint8)
    frame[pattern.row :: pattern.spacing_px, pattern.column :: pattern.spacing_px] = 255
    return frame


def dot_spacing(largest_sigma_px: float) -> int:
    """The smallest spacing r that keeps dots apart: r >= 6.5 sigma.

    Parameters
    ----------
    largest_sigma_px : standard deviation, in projector pixels, of the most blurred metapixels that matter; the camera's
        blur counts

    Raises UsageError("dot-blur-unknown") unless it is a number of at least 0.
    """
    if not 0 <= largest_sigma_px < math.inf:
        raise UsageError(
            "dot-blur-unknown",
            what=f"No dot spacing follows from a blur of {largest_sigma_px} projector pixels.",
            remedy=f"Measure the blur first, or use the spacing of {PAPER_SPACING_PX} pixels.",
        )
    return max(LEAST_SPACING_PX, math.ceil(SIGMAS_APART * largest_sigma_px))
