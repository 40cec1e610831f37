"""Cost of steps in seconds on the reference machine (2 cores, emulated stage), to estimate the time left.

Measured at the sizes small and medium. Work on every pixel grows with the number of pixels; a photograph also has a
constant part.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

RADIOMETRY_S: Final = 0.7
"""This and the following at size small; times ``scale`` elsewhere."""
PIXELS_S: Final = 0.8
INDIRECT_S: Final = 4.0
VERIFY_S: Final = 1.0
BASE_S: Final = 3.0
APPEARANCE_S: Final = 4.0

_SMALL_PX: Final = 280 * 210


def scale(sizes_px: Iterable[tuple[int, int]]) -> float:
    """The pixels of the projectors, (width, height) each, on average, relative to size small."""
    pixels = [width * height for width, height in sizes_px]
    return sum(pixels) / len(pixels) / _SMALL_PX


def shot_s(of_scale: float) -> float:
    """A photograph: show, settle, expose, transfer."""
    return 0.18 + 0.05 * of_scale


def geometry_s(of_scale: float) -> float:
    """The reconstruction; most of it works on a sample of the points."""
    return 3.5 + 0.5 * of_scale


def dots_s(of_scale: float, photographs: int) -> float:
    """Metapixels from so many photographs of dots: the fits, and the development of each photograph."""
    return of_scale * (0.8 + 0.06 * photographs)
