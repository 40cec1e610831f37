"""The shape of G, corrected by what the weights of its terms leave of whites and stripes.

Form factors do not know surfaces that the camera does not see. What a block gets is predicted for
every picture of which indirect light was measured; where the measured part differs, the light of some sources counts
too little or too much. Of all factors that explain it, those are taken that change least, and alike for neighbouring
sources: the mean of a Gaussian process (Rasmussen and Williams 2006, eq. 2.25), block by block. Where the colour of
the light that falls is known, it is predicted, too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from controller.core.arrays import Float64, FloatImage
from controller.optics.transport.indirect.blocks import down_up
from controller.optics.transport.indirect.falling_colours import FallingColours
from controller.optics.transport.indirect.weights import FAINTEST, BlockLight, measured_part

UNSURE: Final = 0.7
"""Standard deviation of a factor: how much of a source's light arrives, over what the terms say."""
ALIKE_BLOCKS: Final = 4.0
"""Distance of sources, in blocks, within which factors are alike (standard deviation of the correlation's Gaussian)."""
PART_NOISE: Final = 0.045
"""Standard deviation of a picture's part of a block's indirect light, from noise and what factors can't tell."""
COLOUR_NOISE: Final = 0.02
"""Standard deviation of a colour's part of the light that falls on a block."""
LEAST_VARIANCE: Final = 1e-3
"""Of the largest: what varies less along the grid is left out."""


def shaped(
    own: FloatImage, room: FloatImage, pictures: Sequence[BlockLight], whites: int, grid: tuple[int, int], side: int,
    shape: tuple[int, ...], colours: FallingColours | None = None,
) -> tuple[FloatImage, FloatImage]:  # fmt: skip
    """``own`` and ``room`` (blocks, blocks), light from the object's and the room's blocks, corrected; none below 0.

    ``pictures``: of which the first are all ``whites``; ``grid``, ``side``: of blocks in camera pictures of ``shape``;
    ``colours``: of what falls, of all whites together
    """
    lights = np.stack([np.concatenate([one.own, one.room]) for one in pictures])
    every = lights[:whites].sum(axis=0)
    both = np.concatenate([own, room], axis=1)
    falling = np.stack([both @ light for light in (*lights, every)])
    across = down_up(grid, side, shape)
    *seen, whole = (across(np.asarray(one, np.float32)) for one in falling)
    parts, known = (np.stack(images) for images in zip(*(measured_part(one) for one in pictures), strict=True))
    bright = every[: len(own)] + every[len(own) :]
    known = known * ((whole > 0) & (pictures[0].whole > 0) & (bright > FAINTEST * bright.max(initial=0)))
    left = parts - np.divide(seen, whole, out=np.zeros_like(parts), where=known > 0)
    coloured = _Coloured(colours, both, every)
    smooth = _SmoothFactors(grid)
    out = both.copy()
    for block in range(len(both)):
        picture, channel = np.nonzero(known[:, block])
        # the part of each source in the picture, less that which it would need to have
        sources = lights[picture, :, channel] - parts[picture, block, channel][:, None] * every[:, channel].T
        sources = sources * (both[block] / whole[block, channel][:, None])
        equations = _Equations(sources, left[picture, block, channel], PART_NOISE).and_also(coloured.of(block))
        if len(equations.left):
            out[block] *= np.maximum(1 + _change(equations, smooth), 0)
    return out[:, : len(own)], out[:, len(own) :]


@dataclass(frozen=True, slots=True, eq=False)
class _Equations:
    """What is ``left`` (equations,) of the sum of ``sources`` (equations, sources) times the change of their factors.

    ``noise``: the standard deviation of all of ``left``
    """

    sources: FloatImage
    left: FloatImage
    noise: float = 1.0

    def and_also(self, other: _Equations | None) -> _Equations:
        """All of them, in units of their noise."""
        every = (self,) if other is None else (self, other)
        sources = np.concatenate([one.sources / one.noise for one in every])
        return _Equations(np.asarray(sources, np.float32), np.concatenate([one.left / one.noise for one in every]))


class _Coloured:
    """Equations of the colour of what falls by ``both`` (blocks, sources) from ``every`` (sources, 3)."""

    def __init__(self, colours: FallingColours | None, both: FloatImage, every: FloatImage) -> None:
        self._colours, self._both = colours, both
        if colours is not None:
            self._sources = every / colours.white(both.astype(np.float64) @ every).astype(np.float32)
            self._falling = both @ self._sources

    def of(self, block: int) -> _Equations | None:
        """Of one block, where its colour is known."""
        if self._colours is None or not self._colours.known[block]:
            return None
        total = self._falling[block].sum()
        if not total > 0:
            return None
        part = self._colours.part[block].astype(np.float32)
        sources = (self._sources - part * self._sources.sum(axis=1, keepdims=True)).T * (self._both[block] / total)
        return _Equations(sources, part - self._falling[block] / total, COLOUR_NOISE)


def _change(equations: _Equations, smooth: _SmoothFactors) -> FloatImage:
    """The change of each source's factor (sources,), by equations in units of their noise.

    Object and room have factors of their own.
    """
    by_part = [UNSURE * smooth.of(one) for one in np.split(equations.sources, 2, axis=1)]
    gram = sum(one @ one.T for one in by_part) + np.eye(len(equations.left))
    answer = np.linalg.solve(gram, equations.left)
    return np.asarray(UNSURE * np.concatenate([smooth.back(one.T @ answer) for one in by_part]), np.float32)


class _SmoothFactors:
    """B (blocks, k) with B B' the correlation between blocks of a ``grid``: of its rows times that of its columns."""

    def __init__(self, grid: tuple[int, int]) -> None:
        self._rows, self._columns = (_root(count) for count in grid)

    def of(self, sources: FloatImage) -> FloatImage:
        """``sources`` (equations, blocks) times B."""
        image = sources.reshape(len(sources), len(self._rows), len(self._columns))
        return np.asarray(np.matmul(self._rows.T, image @ self._columns).reshape(len(sources), -1), np.float32)

    def back(self, values: Float64) -> Float64:
        """B times ``values`` (k,)."""
        along = values.reshape(self._rows.shape[1], self._columns.shape[1])
        return np.asarray((self._rows @ along @ self._columns.T).reshape(-1), np.float64)


def _root(count: int) -> FloatImage:
    """(count, k) R with R R' the correlation along so many blocks."""
    apart = np.subtract.outer(np.arange(count), np.arange(count)) / ALIKE_BLOCKS
    values, vectors = np.linalg.eigh(np.exp(-0.5 * apart**2))
    use = values > LEAST_VARIANCE * values.max()
    return np.asarray(vectors[:, use] * np.sqrt(values[use]), np.float32)


__all__ = ["shaped"]
