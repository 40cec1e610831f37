"""The shape of G, corrected by what the weights of its terms leave of whites and stripes.

Form factors do not know what hides what, nor surfaces that the camera does not see. What a block gets is predicted for
every picture of which indirect light was measured; where the measured part differs, the light of some sources counts
too little or too much. Of all factors that explain it, those are taken that change least, and alike for neighbouring
sources: the mean of a Gaussian process (Rasmussen and Williams 2006, eq. 2.25), block by block.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from controller.core.arrays import Float64, FloatImage
from controller.transport.indirect_weights import FAINTEST, BlockLight, measured_part
from controller.transport.surfaces.blocks import down_up

UNSURE: Final = 1.0
"""Standard deviation of a factor: how much of a source's light arrives, over what the terms say."""
ALIKE_BLOCKS: Final = 4.0
"""Distance of sources, in blocks, within which factors are alike (standard deviation of the correlation's Gaussian)."""
PART_NOISE: Final = 0.045
"""Standard deviation of a picture's part of a block's indirect light, from noise and what factors can't tell."""
LEAST_VARIANCE: Final = 1e-3
"""Of the largest: what varies less along the grid is left out."""


def shaped(
    own: FloatImage, room: FloatImage, pictures: Sequence[BlockLight], whites: int, grid: tuple[int, int], side: int,
    shape: tuple[int, ...],
) -> tuple[FloatImage, FloatImage]:  # fmt: skip
    """``own`` and ``room`` (blocks, blocks), light from the object's and the room's blocks, corrected; none below 0.

    ``pictures``: of which the first are all ``whites``; ``grid``, ``side``: of blocks in camera pictures of ``shape``
    """
    lights = np.stack([np.concatenate([one.own, one.room]) for one in pictures])
    every = lights[:whites].sum(axis=0)
    both = np.concatenate([own, room], axis=1)
    falling = np.stack([both @ light for light in (*lights, every)])
    across = down_up(grid, side, shape)
    *seen, whole = (across(np.asarray(one, np.float32)) for one in falling)
    parts, known = (np.stack(images) for images in zip(*(measured_part(one) for one in pictures), strict=True))
    bright = pictures[0].whole + every[: len(own)] + every[len(own) :]
    known = known * ((whole > 0) & (pictures[0].whole > 0) & (bright > FAINTEST * bright.max(initial=0)))
    left = parts - np.divide(seen, whole, out=np.zeros_like(parts), where=known > 0)
    smooth = _smooth_factors(grid)
    out = both.copy()
    for block in range(len(both)):
        picture, channel = np.nonzero(known[:, block])
        if picture.size:
            # the part of each source in the picture, less that which it would need to have
            sources = lights[picture, :, channel] - parts[picture, block, channel][:, None] * every[:, channel].T
            sources = sources * (both[block] / whole[block, channel][:, None])
            out[block] *= np.maximum(1 + _change(sources, left[picture, block, channel], smooth), 0)
    return out[:, : len(own)], out[:, len(own) :]


def _change(sources: FloatImage, left: FloatImage, smooth: FloatImage) -> FloatImage:
    """The change of each source's factor (sources,): of ``sources`` (equations, sources), what is ``left`` of them.

    ``smooth`` (blocks, k): see ``_smooth_factors``; object and room have factors of their own.
    """
    count = len(smooth)
    by_part = [UNSURE * (sources[:, first : first + count] @ smooth) for first in (0, count)]
    gram = sum(one @ one.T for one in by_part) + PART_NOISE**2 * np.eye(len(left))
    answer = np.linalg.solve(gram, left)
    return np.asarray(UNSURE * np.concatenate([smooth @ (one.T @ answer) for one in by_part]), np.float32)


def _smooth_factors(grid: tuple[int, int]) -> FloatImage:
    """(blocks, k) B with B B' the correlation between blocks of the ``grid``."""
    along = []
    for count in grid:
        apart = np.subtract.outer(np.arange(count), np.arange(count)) / ALIKE_BLOCKS
        values, vectors = np.linalg.eigh(np.exp(-0.5 * apart**2))
        use = values > LEAST_VARIANCE * values.max()
        root: Float64 = vectors[:, use] * np.sqrt(values[use])
        along.append(root)
    return np.asarray(np.kron(*along), np.float32)


__all__ = ["shaped"]
