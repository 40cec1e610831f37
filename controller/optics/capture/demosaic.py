"""Bilinear interpolation of a Bayer mosaic: exact, parallel, and available as data for models of it.

A colour missing at a pixel is the mean of its samples among the eight neighbours (the cross for green, the line or the
diagonals for red and blue); the colour that was measured there is kept. At the image's edge the mean is over the
neighbours that exist.
"""

from __future__ import annotations

import functools
import itertools
import math
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from controller.core.arrays import Float64, FloatImage, Mask
from controller.core.jit import compiled
from hal.runtime.compute import usable_cpus

GREEN = 1
WORTH_THREADS = 1 << 20
"""Samples; with fewer, one thread finishes before others have started."""
STRIP_ROWS = 128
NEVER = 1 << 20
"""A clipping limit above every 16-bit sample."""


@dataclass(frozen=True, slots=True)
class SensorLevels:
    """Raw values of one Bayer sensor, each (2, 2) by the row's and the column's parity.

    ``colours`` int64: 0 red, 1 green, 2 blue; ``black`` raw value without light; ``white`` of full scale; ``clip`` from
    which a sample counts as saturated
    """

    colours: npt.NDArray[np.int64]
    black: Float64
    white: Float64
    clip: Float64


def bayer_kernels(colours: npt.NDArray[np.int64]) -> Float64:
    """The weights with which ``demosaic`` makes each colour of a pixel from the 3x3 samples round it.

    ``colours`` (2, 2) as in ``SensorLevels``.

    Returns
    -------
    (2, 2, 3, 3, 3): by the pixel's row parity, its column parity, colour (R, G, B), and the sample's row and column
    offset plus 1. Each 3x3 sums to 1. Holds for every pixel but those of the image's outermost rows and columns.
    """
    kernels = np.zeros((2, 2, 3, 3, 3))
    for row in range(2):
        for column in range(2):
            site = np.array([[colours[(row + r) & 1, (column + c) & 1] for c in (-1, 0, 1)] for r in (-1, 0, 1)])
            for colour in range(3):
                chosen = site == colour
                if site[1, 1] == colour:
                    # A sample's own colour is measured there, not interpolated.
                    chosen = np.zeros((3, 3), np.bool_)
                    chosen[1, 1] = True
                kernels[row, column, colour] = chosen / np.count_nonzero(chosen)
    return kernels


def demosaic(mosaic: npt.NDArray[np.uint16], levels: SensorLevels, *, gain: float = 1.0) -> tuple[FloatImage, Mask]:
    """Interpolate raw samples into linear RGB: 0 at the black level, ``gain`` at full scale.

    Parameters
    ----------
    mosaic : (rows, columns) uint16, at least 2 by 2, in any memory order
    gain : e.g. 1 / exposure_s for full scales per second

    Returns
    -------
    image (rows, columns, 3) float32, and saturated (rows, columns) bool: some sample of the pixel's 3x3 was clipped
    """
    mosaic = np.ascontiguousarray(mosaic)
    image = np.empty((*mosaic.shape, 3), np.float32)
    saturated = np.zeros(mosaic.shape, np.bool_)
    scale = (gain / (levels.white - levels.black)).astype(np.float32)
    black = levels.black.astype(np.float32)
    limits = np.array([[_limit(value) for value in row] for row in levels.clip], np.int64)
    rows = mosaic.shape[0]

    def strip(first: int, last: int) -> None:
        _interpolate_inside(mosaic, levels.colours, black, scale, image, first, last)
        _mark_clipped(mosaic, limits, saturated, first, last)

    if mosaic.size < WORTH_THREADS:
        strip(0, rows)
    else:
        edges = [*range(0, rows, STRIP_ROWS), rows]
        for done in [_pool(os.getpid()).submit(strip, first, last) for first, last in itertools.pairwise(edges)]:
            done.result()
    _interpolate_edge(mosaic, levels.colours, black, scale, image)
    return image, saturated


@functools.cache
def _pool(process: int) -> ThreadPoolExecutor:
    """Threads of this process (a forked one has none of its parent's) that work on strips.

    The threads of a parallel loop wait for each other by spinning, which on a busy machine costs more than the work,
    and such a loop can't be entered from two threads at once.
    """
    return ThreadPoolExecutor(usable_cpus(), thread_name_prefix="demosaic")


def _limit(clip: float) -> int:
    return math.ceil(clip) if math.isfinite(clip) else NEVER


@compiled()
def _interpolate_inside(
    mosaic: npt.NDArray[np.uint16],
    colours: npt.NDArray[np.int64],
    black: FloatImage,
    scale: FloatImage,
    image: FloatImage,
    first: int,
    last: int,
) -> None:
    """All but the outermost rows and columns. Sums of samples of one site are whole numbers, so they are exact."""
    rows, columns = mosaic.shape
    quarter, half = np.float32(0.25), np.float32(0.5)
    for row in range(max(first, 1), min(last, rows - 1)):
        own, next_to = row & 1, 1 - (row & 1)
        green = 0 if colours[own, 0] == GREEN else 1
        along, across = colours[own, 1 - green], 2 - colours[own, 1 - green]
        # Sites: green of this row, the other colour of this row, and above or below each of the two.
        black_g, scale_g = black[own, green], scale[own, green]
        black_a, scale_a = black[own, 1 - green], scale[own, 1 - green]
        black_x, scale_x = black[next_to, green], scale[next_to, green]
        black_h, scale_h = black[next_to, 1 - green], scale[next_to, 1 - green]
        above, line, below = mosaic[row - 1], mosaic[row], mosaic[row + 1]
        out = image[row]
        for c in range(2 - green, columns - 1, 2):
            beside = np.int32(line[c - 1]) + np.int32(line[c + 1])
            upright = np.int32(above[c]) + np.int32(below[c])
            out[c, GREEN] = (np.float32(line[c]) - black_g) * scale_g
            out[c, along] = (np.float32(beside) * half - black_a) * scale_a
            out[c, across] = (np.float32(upright) * half - black_x) * scale_x
        for c in range(1 + green, columns - 1, 2):
            beside = np.int32(line[c - 1]) + np.int32(line[c + 1])
            upright = np.int32(above[c]) + np.int32(below[c])
            corners = np.int32(above[c - 1]) + np.int32(above[c + 1]) + np.int32(below[c - 1]) + np.int32(below[c + 1])
            of_line = (np.float32(beside) * half - black_g) * scale_g
            of_column = (np.float32(upright) * half - black_h) * scale_h
            out[c, GREEN] = half * (of_line + of_column)
            out[c, along] = (np.float32(line[c]) - black_a) * scale_a
            out[c, across] = (np.float32(corners) * quarter - black_x) * scale_x


@compiled()
def _interpolate_edge(
    mosaic: npt.NDArray[np.uint16],
    colours: npt.NDArray[np.int64],
    black: FloatImage,
    scale: FloatImage,
    image: FloatImage,
) -> None:
    rows, columns = mosaic.shape
    total, count = np.zeros(3, np.float32), np.zeros(3, np.float32)
    for row in range(rows):
        step = 1 if row in (0, rows - 1) else max(columns - 1, 1)
        for column in range(0, columns, step):
            total[:] = 0
            count[:] = 0
            for r in range(max(row - 1, 0), min(row + 2, rows)):
                for c in range(max(column - 1, 0), min(column + 2, columns)):
                    colour = colours[r & 1, c & 1]
                    total[colour] += (np.float32(mosaic[r, c]) - black[r & 1, c & 1]) * scale[r & 1, c & 1]
                    count[colour] += 1
            for colour in range(3):
                image[row, column, colour] = total[colour] / count[colour]
            own = (np.float32(mosaic[row, column]) - black[row & 1, column & 1]) * scale[row & 1, column & 1]
            image[row, column, colours[row & 1, column & 1]] = own


@compiled()
def _mark_clipped(
    mosaic: npt.NDArray[np.uint16], limits: npt.NDArray[np.int64], saturated: Mask, first: int, last: int
) -> None:
    """A pixel is marked by any clipped sample of its 3x3. Most rows have none: those are only looked through."""
    rows, columns = mosaic.shape
    lowest = min(limits[0, 0], limits[0, 1], limits[1, 0], limits[1, 1])
    # A strip writes its own rows alone, and so looks at one row more on both sides.
    for r in range(max(first - 1, 0), min(last + 1, rows)):
        brightest = mosaic[r, 0]
        for c in range(columns):
            brightest = max(brightest, mosaic[r, c])
        if brightest >= lowest:
            for c in range(columns):
                if mosaic[r, c] >= limits[r & 1, c & 1]:
                    low, high = max(r - 1, first), min(r + 2, last)
                    saturated[low:high, max(c - 1, 0) : min(c + 2, columns)] = True


def fill_bad(mosaic: npt.NDArray[np.uint16], bad_px: npt.NDArray[np.int64]) -> npt.NDArray[np.uint16]:
    """The mosaic with each bad sample replaced by the median of its good neighbours of the same site, two pixels away.

    ``bad_px`` (n, 2) column and row of each; those outside the image are ignored. The mosaic itself stays as it is.
    """
    if not len(bad_px):
        return mosaic
    filled = mosaic.copy()
    rows, columns = mosaic.shape
    bad = {(int(row), int(column)) for column, row in bad_px}
    for row, column in bad:
        if not (0 <= row < rows and 0 <= column < columns):
            continue
        around = [(row + r, column + c) for r in (-2, 0, 2) for c in (-2, 0, 2)]
        good = [mosaic[r, c] for r, c in around if 0 <= r < rows and 0 <= c < columns and (r, c) not in bad]
        if good:
            filled[row, column] = np.uint16(np.median(good))
    return filled
