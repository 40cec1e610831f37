"""Gray code and phase shift as other programs show them, to correspondences."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from controller.core.arrays import FloatImage, Mask
from controller.optics.calibrate.values import Correspondence

WEAK: Final = 0.1
"""Of a camera pixel's largest difference between two opposite pictures: a smaller one tells no bit."""
DARKEST: Final = 0.05
"""Of the same, 99th percentile of the picture: below it the projector does not light the camera pixel.

Beside bright parts a JPEG differs by 2 to 3 % of them from one picture to the next.
"""


@dataclass(frozen=True, slots=True)
class Bits:
    """One coordinate in Gray code.

    ``pairs``: for each bit, coarsest first, its picture and the opposite one (or the threshold between dark and
    light), (rows, columns) float32 linear light; ``cell_px``: projector pixels of the finest cell
    """

    pairs: Sequence[tuple[FloatImage, FloatImage]]
    cell_px: int = 1


@dataclass(frozen=True, slots=True)
class Sinusoid:
    """One coordinate in shifted sinusoids: picture n shows A + B cos(2 pi x / period_px + phases_rad[n]).

    ``pictures``: (rows, columns) float32, at least three
    """

    pictures: Sequence[FloatImage]
    phases_rad: Sequence[float]
    period_px: float


def decode_any(
    bits: tuple[Bits, Bits], sinusoids: tuple[Sinusoid | None, Sinusoid | None], projector_px: tuple[int, int]
) -> Correspondence:
    """Where each camera pixel looks, from the Gray code of x and y; a sinusoid measures inside its period.

    The period of a sinusoid has to be at least two cells of the Gray code. Returns ``Correspondence``:
    ``modulation`` is the contrast of the sinusoids, 1 where there is none; a pixel is valid where every bit is clear.
    """
    shape = bits[0].pairs[0][0].shape
    position = np.full((*shape, 2), np.nan, np.float32)
    valid, modulation = np.ones(shape, np.bool_), np.ones(shape, np.float32)
    for axis in range(2):
        cell, clear = _cells(bits[axis])
        size = bits[axis].cell_px
        middle = cell * size + (size - 1) / 2
        wave = sinusoids[axis]
        if wave is not None:
            turn, contrast = _phase(wave)
            within = turn * wave.period_px
            measured = within + wave.period_px * np.round((middle - within) / wave.period_px)
            clear &= np.abs(measured - middle) <= size / 2 + wave.period_px / 8
            modulation = np.minimum(modulation, contrast)
            middle = measured
        position[..., axis] = middle
        valid &= clear & (middle > -0.5) & (middle < projector_px[axis] - 0.5)
    position[~valid] = np.nan
    return Correspondence(position, np.where(valid, modulation, 0).astype(np.float32), valid)


def _cells(bits: Bits) -> tuple[npt.NDArray[np.int64], Mask]:
    """(rows, columns) number of the cell, and where all bits are clear."""
    shape = bits.pairs[0][0].shape
    cell, bit = np.zeros(shape, np.int64), np.zeros(shape, np.bool_)
    largest = np.zeros(shape, np.float32)
    smallest = np.full(shape, np.inf, np.float32)
    for picture, opposite in bits.pairs:
        difference = picture - opposite
        bit ^= difference > 0
        cell = 2 * cell + bit
        size = np.abs(np.nan_to_num(difference, nan=0.0))
        largest, smallest = np.maximum(largest, size), np.minimum(smallest, size)
    brightest = float(np.percentile(largest, 99))
    return cell, (smallest > WEAK * largest) & (largest > DARKEST * brightest)


def _phase(wave: Sinusoid) -> tuple[npt.NDArray[np.float64], FloatImage]:
    """(rows, columns): the place within the period, in turns; and the contrast B / A, 0 to 1. By least squares."""
    phases = np.asarray(wave.phases_rad, np.float64)
    basis = np.stack([np.ones_like(phases), np.cos(phases), -np.sin(phases)], axis=1)
    pictures = np.stack([np.asarray(picture, np.float64) for picture in wave.pictures])
    mean, cosine, sine = np.tensordot(np.linalg.pinv(basis), pictures, axes=1)
    contrast = np.hypot(cosine, sine) / np.maximum(mean, 1e-12)
    turn = np.arctan2(sine, cosine) / (2 * np.pi)
    return np.asarray(turn), np.clip(np.nan_to_num(contrast), 0, 1).astype(np.float32)
