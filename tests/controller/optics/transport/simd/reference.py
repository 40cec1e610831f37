"""Every kernel of ``controller.optics.transport.simd`` in plain NumPy, in double precision, as their oracle."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from controller.optics.transport.simd.gaussians import LANES as WEIGHTS
from controller.optics.transport.simd.scaling import SIDE, STEPS
from controller.optics.transport.windows.profiles import (
    GROUP,
    LANES,
    PHASES,
    SHEARS,
    SKEW_STEPS,
    STRIP,
    SmallProfiles,
    Windows,
)

Array = npt.NDArray[Any]
Double = npt.NDArray[np.float64]


def spread_lanes(planes: list[Array], at: int, weights: Array, k: int, light: Array) -> None:
    for plane, value in zip(planes, light, strict=True):
        plane[at : at + WEIGHTS] += weights[k : k + WEIGHTS] * value


def collect_lanes(planes: list[Array], at: int, weights: Array, k: int, sums: Array) -> None:
    for i, plane in enumerate(planes):
        sums[WEIGHTS * i : WEIGHTS * (i + 1)] += weights[k : k + WEIGHTS] * plane[at : at + WEIGHTS]


def rows_of_window(
    side: int, table: Array, shares: int, down: int, size: tuple[int, int], sheared: tuple[int, int, int] | None
) -> tuple[npt.NDArray[np.int64], Double]:
    """(height, width): where a large window's values lie, from its first on, and its weights.

    ``sheared``: where its first row lies along x, its shear, and what row 0 lies below, as ``sheared_sum`` takes them.
    """
    height, width = size
    row, column = np.mgrid[:height, :width]
    step, phase = np.zeros_like(row), np.zeros_like(row)
    if sheared is not None:
        along, shear, below = sheared
        step, phase = np.divmod(along + np.floor(shear * (PHASES * row + below) / SHEARS).astype(np.int64), PHASES)
    weights = table[down + row].astype(np.float64) * table[shares + width * phase + column]
    return row * side + column + step, weights


def shares_of_window(windows: Windows, small: SmallProfiles, e: int, *, skewed: bool) -> Double:
    """(16,): the shares of a small window, row by row."""
    along, upright = (LANES * int(part[e]) for part in (windows.across, windows.down))
    table = small.table.astype(np.float64)
    shares = np.outer(table[upright : upright + LANES], table[along : along + LANES]).ravel()
    first = GROUP * (SKEW_STEPS + int(windows.skew[e]))
    return shares * small.skews[first : first + GROUP] if skewed else shares


def see(windows: Windows, small: SmallProfiles, e: int, strips: Array, out: Array, *, skewed: bool) -> None:
    for k in range(e, e + GROUP):
        at = LANES * int(windows.at[k])
        seen = strips[at : at + GROUP] @ shares_of_window(windows, small, k, skewed=skewed)
        out[windows.site[k]] += windows.gain[k] * seen


def spread(windows: Windows, small: SmallProfiles, e: int, values: Array, strips: Array, *, skewed: bool) -> None:
    for k in range(e, e + GROUP):
        at = LANES * int(windows.at[k])
        value = values[windows.site[k]] * windows.gain[k]
        strips[at : at + GROUP] += value * shares_of_window(windows, small, k, skewed=skewed)


def fill_strips(light: Array, at: int, side: int, strips: Array, to: int) -> None:
    for row in range(LANES):
        strips[to + LANES * row : to + LANES * (row + 1)] = light[at + side * row : at + side * row + LANES]


def pour_strips(strips: Array, at: int, sums: Array, to: int, side: int) -> None:
    for row in range(LANES):
        total = np.zeros(STRIP)
        for x in range(STRIP - LANES):
            first = at + LANES * STRIP * x + LANES * row
            total[x : x + LANES] += strips[first : first + LANES]
        sums[to + side * row : to + side * row + STRIP] = total


def window_light(scale: Array, at: int, side: int, shares: Array, i: int, gain: Array, unmix: Array) -> Double:
    """(3,): the light whose root ``window_steps`` looks up."""
    blocks, total = scale.reshape(-1, 4).astype(np.float64), np.zeros(3)
    for row in range(SIDE):
        for k in range(SIDE):
            share = float(shares[SIDE * SIDE * i + SIDE * row + k])
            total += share * blocks[at + row * side + k, :3]
    columns: Double = unmix.reshape(3, 4)[:, :3].astype(np.float64)
    return np.asarray((total * gain[3 * i : 3 * i + 3]) @ columns)


def own_light(light: Double, segment: float) -> Double:
    """(3,): what three channels make so that, with a white segment's share of their least, they show ``light``."""
    shown = np.clip(light, 0, 1)
    common = shown.min()  # the least channel is shown as it is
    return np.asarray([(value - segment * common) / (1 - segment) for value in shown])


def table_steps(light: Double) -> Double:
    """Steps of the device table before they are rounded."""
    return np.asarray(np.sqrt(np.clip(light, 0, 1)) * STEPS)


def above_black(light: Array, gain: Array, offset: Array, i: int) -> Double:
    """(3,): light gain - offset, 0 where it is less or no number."""
    found = light * gain[3 * i : 3 * i + 3] - offset[3 * i : 3 * i + 3]
    return np.where(found > 0, found, 0)


def mean_of_four(picture: Array, a: int, b: int) -> Double:
    """(3,): of two neighbours in each of two rows."""
    return np.asarray(sum(picture[k : k + 3].astype(np.float64) for k in (a, a + 3, b, b + 3)) / 4)
