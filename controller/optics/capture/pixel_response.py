"""How far a sensor's pixels differ in their response (photo response non-uniformity), from whites of two projectors.

A pixel's own response is in all photographs alike, and its neighbours do not share it: so it is in the finest detail
that two photographs have in common. Noise is not in both. Each projector's own pixels lie elsewhere, so their gaps
are not in both, either. Paint is, but a lens passes less of it the finer it is: where coarser detail is much stronger
than the finest, it is the paint.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
import numpy.typing as npt

from controller.core.arrays import Float64, FloatImage, Mask

GREEN: Final = 1
ENOUGH_SAMPLES: Final = 1_000_000
"""So many stand for a larger picture."""
BAND_PX, GAP_PX = 96, 2
"""Rows that are kept together, and how many of them, the last, are not used, so that no detail spans two bands."""
BLOCK_PX: Final = 24
WHOLE: Final = 0.9
"""Of a block's green samples that must be known in both photographs."""
FAINTEST: Final = 0.05
"""Of full scale, summed over the exposures: below it noise hides all else."""
AROUND_PX: Final = 7
MOST_COARSER: Final = 2.0
"""Coarser detail over the finest, as variances, up to which a block is taken for even paint: independent pixels have
1."""
ALIKE: Final = 1.3
"""The same of the median block that is left: grain of paint, however fine, has 2 and more behind a lens that blurs by
half a pixel."""
ROUNDS: Final = 30
FEWEST: Final = 20
"""Blocks, each pair of photographs counted."""
SURE: Final = 4.0
"""Standard errors of the median from which it is believed."""


@dataclass(frozen=True, slots=True, eq=False)
class _Detail:
    """(rows, columns) of green samples, relative to the light around, each of variance 1 for white noise of variance 1;
    NaN where it is not known, and at samples of other colours."""

    finest: Float64
    coarser: Float64


def response_spread(whites: Sequence[Sequence[FloatImage]], colours: npt.NDArray[np.int64]) -> float:
    """Standard deviation of the pixels' response, relative; 0 where there is none, or too little is known.

    Parameters
    ----------
    whites : for each projector its photographs of white, one or more exposures: (rows, columns) samples of a Bayer
        sensor in full scale, NaN where clipped
    colours : (2, 2) of the sensor's sites, 1 green
    """
    details = [_detail(exposures, colours) for exposures in whites if exposures]
    pairs = list(itertools.combinations(details, 2))
    if not pairs:
        return 0.0
    finest = np.concatenate([_block_means(one.finest * other.finest) for one, other in pairs])
    coarser = np.concatenate([_block_means(one.coarser * other.coarser) for one, other in pairs])
    known = np.isfinite(finest) & np.isfinite(coarser)
    return _of_even_paint(finest[known], np.abs(coarser[known]))


def some_rows(samples: FloatImage) -> FloatImage:
    """Bands of rows from all over a picture (rows, columns), about ``ENOUGH_SAMPLES``; all of a small one."""
    step = int(np.ceil(samples.size / ENOUGH_SAMPLES))
    if step < 2:
        return samples
    bands = samples[: len(samples) // BAND_PX * BAND_PX].reshape(-1, BAND_PX, samples.shape[1])[::step].copy()
    bands[:, -GAP_PX:] = np.nan
    return bands.reshape(-1, samples.shape[1])


def _of_even_paint(finest: Float64, coarser: Float64) -> float:
    """From the variance that blocks have in common, in turns: what even paint is follows from the response found."""
    used, middle = np.ones(finest.size, np.bool_), np.inf
    for _ in range(ROUNDS):
        if np.count_nonzero(used) < FEWEST:
            return 0.0
        # a median: some blocks have edges in them
        middle = float(np.median(finest[used]))
        before, used = used, coarser < MOST_COARSER * middle
        if np.array_equal(before, used):
            break
    if np.count_nonzero(used) < FEWEST:
        return 0.0
    if np.median(coarser[used]) > ALIKE * middle:
        return 0.0
    error = 1.25 * 1.4826 * float(np.median(np.abs(finest[used] - middle))) / np.sqrt(np.count_nonzero(used))
    return float(np.sqrt(middle)) if middle > SURE * error else 0.0


def _detail(exposures: Sequence[FloatImage], colours: npt.NDArray[np.int64]) -> _Detail:
    shape = exposures[0].shape
    green = np.zeros(shape, np.bool_)
    for row, column in np.argwhere(colours == GREEN):
        green[row::2, column::2] = True
    size = (AROUND_PX, AROUND_PX)
    count = cv2.blur(green.astype(np.float64), size)
    kernels = _kernels()
    sums, around = [np.zeros(shape) for _ in kernels], np.zeros(shape)
    for samples in exposures:
        clipped = green & ~np.isfinite(samples)
        clear: Mask = cv2.dilate(clipped.astype(np.uint8), np.ones(size, np.uint8)) == 0
        light = np.where(green & ~clipped, samples, 0).astype(np.float64)
        for n, kernel in enumerate(kernels):
            sums[n] += np.where(clear, cv2.filter2D(light, -1, kernel), 0)
        around += np.where(clear, cv2.blur(light, size) / count, 0)
    known = green & (around > FAINTEST)
    finest, coarser = (np.divide(one, around, out=np.full(shape, np.nan), where=known) for one in sums)
    return _Detail(finest, coarser)


def _kernels() -> tuple[Float64, Float64]:
    """(7, 7) and (5, 5), on green samples: the finest detail that their grid can show, and that of twice the period.

    The first passes (1 - cos x cos y)^3 of frequencies x, y, the second 1 - (cos 2x + cos 2y) / 2, up to a factor.
    """
    corners = np.zeros((3, 3))
    corners[1, 1], corners[::2, ::2] = 1, -1 / 4
    twice = cv2.filter2D(np.pad(corners, 2), -1, corners, borderType=cv2.BORDER_CONSTANT)
    finest = np.asarray(cv2.filter2D(twice, -1, corners, borderType=cv2.BORDER_CONSTANT), np.float64)
    coarser = np.zeros((5, 5))
    coarser[2, 2] = 1
    coarser[[0, 4, 2, 2], [2, 2, 0, 4]] = -1 / 4
    return finest / np.linalg.norm(finest), coarser / np.linalg.norm(coarser)


def _block_means(products: Float64) -> Float64:
    """(blocks,): the mean of each block; NaN where too little of it is known."""
    rows, columns = (size // BLOCK_PX for size in products.shape)
    cut = products[: rows * BLOCK_PX, : columns * BLOCK_PX].reshape(rows, BLOCK_PX, columns, BLOCK_PX)
    blocks = cut.swapaxes(1, 2).reshape(-1, BLOCK_PX**2)
    known = np.isfinite(blocks)
    count = known.sum(axis=1)
    enough = count > WHOLE * BLOCK_PX**2 / 2
    total = np.where(known, blocks, 0).sum(axis=1)
    return np.asarray(np.divide(total, count, out=np.full(len(blocks), np.nan), where=enough), np.float64)
