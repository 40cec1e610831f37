"""CIEDE2000 of many pairs of linear colours (CIE 142-2001), as Sharma, Wu and Dalal 2005 write it out."""

from __future__ import annotations

import math
from typing import Final

import numba
import numpy as np

from controller.core.arrays import Float64
from controller.core.jit import compiled

TURN: Final = 2 * math.pi
POWER_25: Final = 25.0**7


@compiled(parallel=True)
def ciede2000(first: Float64, second: Float64, to_relative: Float64, out: Float64) -> None:
    """Write the difference of each pair to ``out`` (N,); ``first``, ``second`` (N, 3) are linear.

    ``to_relative`` (3, 3): of them to XYZ, where white is 1
    """
    for n in numba.prange(len(out)):
        out[n] = _difference(_lab(first, n, to_relative), _lab(second, n, to_relative))


@compiled()
def _lab(colours: Float64, n: int, to_relative: Float64) -> tuple[float, float, float]:
    x, y, z = _root(colours, n, to_relative[0]), _root(colours, n, to_relative[1]), _root(colours, n, to_relative[2])
    return 116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)


@compiled()
def _root(colours: Float64, n: int, row: Float64) -> float:
    t = max(colours[n, 0] * row[0] + colours[n, 1] * row[1] + colours[n, 2] * row[2], 0.0)
    return float(np.cbrt(t)) if t > (6.0 / 29.0) ** 3 else t / (3.0 * (6.0 / 29.0) ** 2) + 4.0 / 29.0


@compiled()
def _saturation(chroma: float) -> float:
    power = chroma**7
    return math.sqrt(power / (power + POWER_25))


@compiled()
def _difference(one: tuple[float, float, float], other: tuple[float, float, float]) -> float:
    stretch = 1.5 - 0.5 * _saturation(0.5 * (math.hypot(one[1], one[2]) + math.hypot(other[1], other[2])))
    a1, a2 = stretch * one[1], stretch * other[1]
    c1, c2 = math.hypot(a1, one[2]), math.hypot(a2, other[2])
    h1, h2 = math.atan2(one[2], a1) % TURN, math.atan2(other[2], a2) % TURN
    apart, hue = h2 - h1, h1 + h2
    if c1 * c2 == 0.0:
        apart = 0.0
    else:
        if abs(apart) > math.pi:
            hue += TURN if hue < TURN else -TURN
            apart -= TURN if apart > 0.0 else -TURN
        hue *= 0.5
    lightness, chroma = 0.5 * (one[0] + other[0]) - 50.0, 0.5 * (c1 + c2)
    weight = (
        1.0
        - 0.17 * math.cos(hue - math.radians(30.0))
        + 0.24 * math.cos(2.0 * hue)
        + 0.32 * math.cos(3.0 * hue + math.radians(6.0))
        - 0.20 * math.cos(4.0 * hue - math.radians(63.0))
    )
    bend = math.radians(60.0) * math.exp(-(((math.degrees(hue) - 275.0) / 25.0) ** 2))
    by_lightness = (other[0] - one[0]) / (1.0 + 0.015 * lightness**2 / math.sqrt(20.0 + lightness**2))
    by_chroma = (c2 - c1) / (1.0 + 0.045 * chroma)
    by_hue = 2.0 * math.sqrt(c1 * c2) * math.sin(0.5 * apart) / (1.0 + 0.015 * chroma * weight)
    turned = -2.0 * math.sin(bend) * _saturation(chroma) * by_chroma * by_hue
    return math.sqrt(max(by_lightness**2 + by_chroma**2 + by_hue**2 + turned, 0.0))
