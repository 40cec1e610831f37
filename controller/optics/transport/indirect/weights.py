"""How much of each way that light may take there is: by all projectors' whites, and by the dark parts of stripes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final, Literal

import numpy as np

from controller.core.arrays import Float64, FloatImage, Mask
from controller.optics.transport.indirect.blocks import down, down_up, parted

Part = Literal["all", "object", "room"]
LEAST_DARK: Final = 0.3
"""Share of a block that must be dark, for its light to count."""
FAINTEST: Final = 1e-3
ROUNDS: Final = 12
HEAVY: Final = 1e3
TOGETHER: Final = 0.6
"""How strongly a way's factor for the object's light is held to that for the room's, which by shape alone is the same:
so much of what all pictures say.
Without it, what the shape does not explain is put on one of them."""


@dataclass(frozen=True, slots=True, eq=False)
class Term:
    """A way of light: ``matrix`` (blocks, blocks), from a ``part`` of what is lit."""

    matrix: FloatImage
    part: Part


@dataclass(frozen=True, slots=True, eq=False)
class BlockLight:
    """A picture of one projector, by blocks: what it lights, and the indirect light that is seen.

    ``own``, ``room`` (blocks, 3): light that leaves the object, and what is none of it
    ``seen``, ``whole`` (blocks, 3): indirect light of the picture, and of all whites together, on the same pixels
    ``covered`` (blocks,): the share of the block that these are
    """

    own: FloatImage
    room: FloatImage
    seen: FloatImage
    whole: FloatImage
    covered: FloatImage

    def source(self, part: Part) -> FloatImage:
        """The light of a part of the picture."""
        return self.own + self.room if part == "all" else self.own if part == "object" else self.room


def block_light(
    light: FloatImage, seen: FloatImage, whole: FloatImage, lit: Mask, grid: tuple[int, int], side: int,
    dark: Mask | None = None,
) -> BlockLight:  # fmt: skip
    """A picture from the ``light`` that leaves surfaces and that of all whites that is indirect, (rows, columns, 3).

    ``lit`` (rows, columns): on the object; ``dark``: the pixels that ``seen`` (blocks, 3) is the sum of, None: all
    """
    own, room = parted(light, lit, grid, side)
    if dark is None:
        every = down(np.ones((*lit.shape, 1), np.float32), grid, side)[:, 0]
        return BlockLight(own, room, seen, down(whole, grid, side), every)
    covered = down(dark[..., None].astype(np.float32), grid, side)[:, 0]
    return BlockLight(own, room, seen, down(np.where(dark[..., None], whole, np.float32(0)), grid, side), covered)


def fit_weights(
    terms: Sequence[Term], whites: Sequence[BlockLight], stripes: Sequence[BlockLight], grid: tuple[int, int],
    side: int, shape: tuple[int, ...],
) -> FloatImage:  # fmt: skip
    """The factor (terms,) >= 0 of each term that tells pictures' indirect light apart best.

    What surfaces make of falling light follows from all whites together, so a picture's light is predicted as its part
    of what falls, times theirs. Least squares by blocks of pictures of ``shape``, relative to the light; the part's
    denominator is that of the round before. Neighbours in ``terms`` that differ in their part alone are held together.
    """
    from scipy.optimize import nnls

    pictures = (*whites, *stripes)
    total = whites[0].whole
    light = np.sum([one.source("all") for one in whites], axis=0)
    falling = _falling(terms, pictures, down_up(grid, side, shape))
    means = falling[: len(whites)].sum(axis=0).mean(axis=(1, 2))
    alike = np.divide(1, means, out=np.zeros_like(means), where=means > 0)
    falling = falling * alike[None, :, None, None]
    every = falling[: len(whites)].sum(axis=0)
    found = (alike > 0) / max(np.count_nonzero(alike), 1)
    use = (total > 0) & (light > FAINTEST * light.max(initial=0))
    if len(pictures) < 2 or not use.any():
        return np.asarray(found * alike, np.float32)
    relative = total / np.sqrt(np.maximum(light, 1e-30))
    # sum of terms (falling_n - part_n falling) = 0, which alone would have the answer 0; the sum of all is 1
    parts = [measured_part(one) for one in pictures]
    off = [(one - part * every) * known for one, (part, known) in zip(falling, parts, strict=True)]
    together = _together(terms, alike)
    for _ in range(ROUNDS):
        now = np.tensordot(every, found, axes=(0, 0))
        gain = np.divide(relative, now, out=np.zeros_like(total), where=use & (now > 0))
        rows = _root(np.sum([_products(one * gain) for one in off], axis=0))
        rows = np.vstack([rows, together * np.sqrt((rows**2).sum(axis=0)).mean()])
        heavy = HEAVY * max(float(np.abs(rows).max(initial=0)), 1e-30)
        after, _ = nnls(np.vstack([rows, np.where(alike > 0, heavy, 0)]), np.append(np.zeros(len(rows)), heavy))
        found = np.where(alike > 0, after, 0) / max(float(after[alike > 0].sum()), 1e-30)
    return np.asarray(found * alike, np.float32)


def _falling(
    terms: Sequence[Term], pictures: Sequence[BlockLight], across: Callable[[FloatImage], FloatImage]
) -> FloatImage:
    """(pictures, terms, blocks, 3): what each term makes of each picture's light."""
    found = []
    for term in terms:
        arriving = term.matrix @ np.concatenate([one.source(term.part) for one in pictures], axis=1)
        found.append([across(one) for one in np.split(arriving, len(pictures), axis=1)])
    return np.asarray(found, np.float32).swapaxes(0, 1)


def _together(terms: Sequence[Term], alike: Float64) -> Float64:
    """(pairs, terms): how much more a way gives of the object's light than of the room's, in shares of the light."""
    rows = []
    for n, (one, other) in enumerate(pairwise(terms)):
        if one.matrix is other.matrix and alike[n] > 0 and alike[n + 1] > 0:
            row = np.zeros(len(terms))
            row[n], row[n + 1] = 2 * alike[n : n + 2] / alike[n : n + 2].sum() * (TOGETHER, -TOGETHER)
            rows.append(row)
    return np.reshape(rows, (-1, len(terms)))


def _products(equations: FloatImage) -> Float64:
    """(terms, terms): of equations (terms, blocks, 3)."""
    rows = equations.reshape(len(equations), -1).astype(np.float64)
    return np.asarray(rows @ rows.T)


def _root(products: Float64) -> Float64:
    """A few equations with the same least squares."""
    values, vectors = np.linalg.eigh(products)
    return np.asarray(np.sqrt(np.maximum(values, 0))[:, None] * vectors.T)


def measured_part(one: BlockLight) -> tuple[FloatImage, FloatImage]:
    """(blocks, 3): a picture's share of all whites' indirect light, and 1 where that is known."""
    known = ((one.covered[:, None] > LEAST_DARK) & (one.whole > 0)).astype(np.float32)
    return np.divide(one.seen, one.whole, out=np.zeros_like(one.whole), where=one.whole > 0), known
