"""The maps of indirect light for live targets (``bundle.live_indirect``), from the stage's G.

Live targets have few, large blocks: indirect light is smooth but for the paint, which stays in the target's own pixels
(docs/decisions/0014).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np
import numpy.typing as npt

from controller.bundle.live_indirect import SAMPLES, LiveIndirect
from controller.core import channels
from controller.core.arrays import FloatImage
from controller.optics.transport.indirect.indirect_light import IndirectLight

LIVE_BLOCKS: Final = 300
"""At most about so many in the whole picture: their products cost less than a tenth of a millisecond."""
GENERATOR: Final = 27
"""Of the lattice of samples in a block: even along both sides."""
MOST_CORRECTION: Final = 2.0
"""By which large blocks are made to throw back as much white as small ones."""
MOST_PAINT: Final = 8.0
"""Of another colour's scale that is added: paints that throw back nearly one colour would need more."""

Reduce = Callable[[FloatImage], FloatImage]


def indirect_maps(
    indirect: IndirectLight,
    reach: FloatImage,
    black: FloatImage,
    inverse: FloatImage,
    unit: float,
    factor: int,
    reduce: Reduce,
) -> LiveIndirect:
    """The live maps of ``indirect``.

    Parameters
    ----------
    reach, black : (rows, columns, 3) all direct light of the projectors as the paint shows it, and the black image
    inverse : (rows, columns, 3) 1 / base light, 0 where there is none
    unit : radiance by which ``LiveMaps.gain`` was multiplied
    factor : camera pixels along a target pixel; ``reduce``: from those of the camera to those of the target
    """
    merged = max(1, round(float(np.sqrt(len(indirect.factors) / LIVE_BLOCKS))))
    factors, grid = _merged(indirect.factors, indirect.grid, merged)
    most = reduce(np.where(indirect.lit[..., None], reach, 0).astype(np.float32))
    high, wide = most.shape[:2]
    side = float(np.float32(merged * indirect.side / factor))
    places, inside = _places(grid, side, (high, wide))
    empty = np.zeros((3, SAMPLES, len(factors), 3), np.float32)
    bare = LiveIndirect(factors, grid, side, places, empty, np.zeros((high, wide, 3), np.float16))
    direct = np.where(inside[..., None], bare.samples(most), 0).astype(np.float32)
    white = bare.spread((factors @ direct.mean(axis=0)).reshape(*grid, 3))
    exact = reduce(indirect.falling(np.where(indirect.lit[..., None], reach, 0).astype(np.float32)))
    ratio = np.divide(exact, white, out=np.ones_like(white), where=white > 0)
    ratio = np.clip(ratio, 1 / MOST_CORRECTION, MOST_CORRECTION)
    sampled = np.stack([bare.samples(image) for image in (reduce(indirect.scale) * ratio, reduce(black))] + [direct])
    surface = reduce(indirect.scale * inverse) * ratio * np.float32(unit)
    return LiveIndirect(factors, grid, side, places, sampled.astype(np.float32), surface.astype(np.float16))


def paint_map(indirect: IndirectLight, inverse: FloatImage, reduce: Reduce) -> npt.NDArray[np.float16] | None:
    """``LiveMaps.paint`` of colours that depend on the paint; None where they do not.

    ``inverse``, ``reduce``: as of ``indirect_maps``
    """
    unpainted = indirect.unpainted()
    if unpainted is None:
        return None
    base = np.divide(1, inverse, out=np.zeros_like(inverse), where=inverse > 0)
    rows = []
    for colour, of_each in enumerate(unpainted):
        added = np.moveaxis(of_each, 0, 2).astype(np.float32) * base * inverse[..., colour, None]
        rows.append(reduce(np.clip(added, -MOST_PAINT, MOST_PAINT)))
    return np.stack(rows, axis=2).astype(np.float16)


def _merged(factors: FloatImage, grid: tuple[int, int], merged: int) -> tuple[FloatImage, tuple[int, int]]:
    """Of blocks ``merged`` times as wide and high, whose means count what lies beyond the picture as dark."""
    coarse = -(-grid[0] // merged), -(-grid[1] // merged)
    row, column = np.divmod(np.arange(grid[0] * grid[1]), grid[1])
    member = np.zeros((coarse[0] * coarse[1], len(row)), np.float32)
    member[(row // merged) * coarse[1] + column // merged, np.arange(len(row))] = 1
    count = member.sum(axis=1)
    found = (member / count[:, None]) @ factors @ (member.T * (merged**2 / count))
    return np.ascontiguousarray(found, np.float32), coarse


def _places(
    grid: tuple[int, int], side: float, size: tuple[int, int]
) -> tuple[npt.NDArray[np.uint16], npt.NDArray[np.bool_]]:
    """(samples, blocks, 2) rows and columns of an even lattice in each block; whether they lie in the picture."""
    number = np.arange(SAMPLES)
    part = (np.stack([number, GENERATOR * number % SAMPLES], axis=-1) + 0.5) / SAMPLES
    first = np.stack(np.divmod(np.arange(grid[0] * grid[1]), grid[1]), axis=-1)
    at = np.floor((first + part[:, None]) * side).astype(np.int64)
    inside = channels.every(at < np.array(size))
    return np.minimum(at, np.array(size) - 1).astype(np.uint16), inside
