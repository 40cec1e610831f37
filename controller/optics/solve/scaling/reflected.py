"""Light by way of other surfaces for live targets, at speed; ``bundle.live_maps`` is the definition.

What a target's pixel makes of falling light is kept in 16 bits: the loop over all pixels waits for memory, and these
are half of what floats take.
"""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import prange

from controller.bundle.live_maps import FULL, ROUNDS, LiveIndirect, between
from controller.core.arrays import FloatImage
from controller.core.jit import compiled
from controller.optics.transport.simd.scaling import Index

PART: Final = 96
"""Numbers a block of samples is worked on at once: they and their sums stay in the nearest cache."""


class ReflectedLight(NamedTuple):
    """Light by way of other surfaces, as loops take it off the wanted light; of no size where there is none.

    ``surface`` (3 x target pixels,): what a pixel makes of falling light, of 65535; ``falling`` (grid rows,
    3 x columns): that light over 65535, in the rows of blocks' middles; ``up``, ``part_up``: the row of blocks before
    each row of the target, and the part of the way to the next
    """

    surface: npt.NDArray[np.uint16]
    falling: FloatImage
    up: npt.NDArray[np.int32]
    part_up: FloatImage


NOTHING: Final = ReflectedLight(
    np.zeros(0, np.uint16), np.zeros((0, 0), np.float32), np.zeros(0, np.int32), np.zeros(0, np.float32)
)


class Surfaces:
    """A stage's maps of indirect light, ready. Not for two threads at once: working memory is kept.

    ``gain`` (height, width, 3) float32: as of ``LiveMaps``
    """

    def __init__(self, indirect: LiveIndirect, gain: FloatImage) -> None:
        height, width, _ = gain.shape
        surface = np.divide(indirect.surface.astype(np.float32), gain, out=np.zeros_like(gain), where=gain > 0)
        most = max(float(surface.max()), 1e-30)
        self._unit = FULL / np.float32(most)
        self._surface = np.rint(surface * self._unit).astype(np.uint16).ravel()
        self._factors = indirect.factors / self._unit
        self._samples = indirect.sampled.reshape(3, len(indirect.places), -1)
        self._places = indirect.places[..., 0].astype(np.int64) * width + indirect.places[..., 1]
        self._grid = indirect.grid
        self._up = between(height, indirect.grid[0], indirect.side)
        self._across = between(width, indirect.grid[1], indirect.side)
        self._rows = np.empty((indirect.grid[0], 3 * width), np.float32)

    def samples(self, image: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """As ``LiveIndirect.samples``, whose places are found once here and not for each picture."""
        return np.asarray(image.reshape(-1, 3).take(self._places, axis=0))

    def reflect(self, light: FloatImage) -> ReflectedLight:
        """What all pixels throw back where samples (samples, blocks, 3) of a target have that radiance."""
        wanted = np.ascontiguousarray(light, np.float32).reshape(len(light), -1)
        means, found = np.empty(wanted.shape[1], np.float32), np.zeros(wanted.shape[1], np.float32)
        for _ in range(ROUNDS):
            _direct_means(wanted, self._samples, found * self._unit, means)
            found = np.asarray(self._factors @ means.reshape(-1, 3), np.float32).ravel()
        _between_columns(found.reshape(*self._grid, 3), *self._across, self._rows)
        return ReflectedLight(self._surface, self._rows, *self._up)


@compiled()
def reflected_row(reflected: ReflectedLight, row: int, first: Index, last: Index, out: FloatImage) -> None:
    """Light by way of other surfaces in a row of the target, at columns ``first`` to ``last``; ``out`` is a row."""
    i, part, values = np.int64(reflected.up[row]), reflected.part_up[row], reflected.falling.shape[1]
    # slices that begin with the first element: an index that might be negative can't be vectorised
    start, end = 3 * first, 3 * last
    above = reflected.falling[i, start:end]
    below = reflected.falling[min(i + 1, reflected.falling.shape[0] - 1), start:end]
    surface = reflected.surface[row * values + start : row * values + end]
    taken = out[start:end]
    for k in range(taken.size):
        taken[k] = np.float32(surface[k]) * (above[k] + part * (below[k] - above[k]))


@compiled(parallel=True)
def _direct_means(wanted: FloatImage, samples: FloatImage, falling: FloatImage, out: FloatImage) -> None:
    """Means over samples of the direct light that is left to be made, where ``falling`` light comes to the blocks.

    ``wanted`` (samples, 3 x blocks); ``samples`` (3, samples, 3 x blocks): as ``LiveIndirect.sampled``
    """
    count, values = wanted.shape
    share = np.float32(1 / count)
    for piece in prange(-(-values // PART)):
        first, last = piece * PART, min((piece + 1) * PART, values)
        total, light = out[first:last], falling[first:last]
        total[:] = 0
        for s in range(count):
            here, thrown = wanted[s, first:last], samples[0, s, first:last]
            black, most = samples[1, s, first:last], samples[2, s, first:last]
            for k in range(total.size):
                direct = here[k] - black[k] - thrown[k] * light[k]
                total[k] += min(max(direct, np.float32(0)), most[k])
        for k in range(total.size):
            total[k] *= share


@compiled(parallel=True)
def _between_columns(falling: FloatImage, left: npt.NDArray[np.int32], part: FloatImage, out: FloatImage) -> None:
    """Light on blocks (grid rows, columns, 3) in the columns of the target: (grid rows, 3 x width)."""
    rows, columns, _ = falling.shape
    for row in prange(rows):
        for x in range(left.size):
            i = np.int64(left[x])
            j, k = min(i + 1, columns - 1), 3 * x
            for c in range(3):
                out[row, k + c] = falling[row, i, c] + part[x] * (falling[row, j, c] - falling[row, i, c])
