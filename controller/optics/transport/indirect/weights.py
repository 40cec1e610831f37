"""How much of each way that light may take there is, by all projectors' whites and by the dark parts of stripes.

1. The colour of the light that falls on blocks (``falling_colours``). Paint throws back the light of other surfaces as
   it throws back that of the projectors. So the indirect part of white, over its direct part, has the colour of what
   falls there, in units of the lamp's white. Where surfaces around have other colours, that says how much each of them
   gives (docs/decisions/0015).
2. The weight of each term (``fit_weights``).
3. The shape of G, corrected by what the weights leave of whites and stripes (``corrected_factors``). Form factors do
   not know surfaces that the camera does not see. What a block gets is predicted for every picture of which indirect
   light was measured; where the measured part differs, the light of some sources counts too little or too much. Of all
   factors that explain it, those are taken that change least, and alike for neighbouring sources: the mean of a
   Gaussian process (Rasmussen and Williams 2006, eq. 2.25), block by block. Where the colour of the light that
   falls is known, it is predicted, too.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise
from typing import Final, Literal

import numpy as np

from controller.core import channels
from controller.core.arrays import Float64, FloatImage, Mask
from controller.optics.transport.indirect.blocks import BlockGrid, down, down_up, parted

BRIGHT: Final = 0.1
"""Of a projector's mean light: where two are brighter, their colours are compared."""
ENOUGH_PIXELS: Final = 100
DARKEST_PAINT: Final = 0.02
"""Of the bright light's largest tenth: darker paint has mostly noise and what lenses spread."""
LEAST_KNOWN: Final = 0.3
"""Share of a block."""
WHITE_ROUNDS: Final = 20


@dataclass(frozen=True, slots=True, eq=False)
class FallingColours:
    """``part`` (blocks, 3): of each colour in the light that falls, which add up to 1; ``known`` (blocks,): where.

    In units of the lamps' white, which is the same for all blocks, but not known.
    """

    part: Float64
    known: Mask

    def white(self, falling: Float64) -> Float64:
        """(3,) of mean 1: the lamps' white for which ``falling`` (blocks, 3), by a model, has these colours best."""
        white = np.ones(3)
        for _ in range(WHITE_ROUNDS if self.known.any() else 0):
            modelled = falling[self.known] / white
            modelled /= np.maximum(modelled.sum(axis=1, keepdims=True), 1e-30)
            white *= np.median(modelled / np.maximum(self.part[self.known], 1e-9), axis=0)
            white /= white.mean()
        return white


def lamp_colours(whites: Sequence[FloatImage], lit: Mask) -> Float64:
    """(projectors, 3): the white of each lamp over that of all, by paint that several of them light.

    Lamps whose light overlaps with no other's, directly or by way of others, count as like the mean of all.

    ``whites``: direct light (rows, columns, 3) of each; ``lit`` (rows, columns): on the object
    """
    bright = [lit & (channels.smallest(one) > BRIGHT * float(one[lit].mean())) if lit.any() else lit for one in whites]
    pairs, ratios = [], []
    for one, other in combinations(range(len(whites)), 2):
        both = bright[one] & bright[other]
        if np.count_nonzero(both) >= ENOUGH_PIXELS:
            ratio = np.log(whites[one][both]) - np.log(whites[other][both])
            pairs.append(np.eye(len(whites))[one] - np.eye(len(whites))[other])
            ratios.append(np.median(ratio - channels.mean(ratio)[:, None], axis=0))
    if not pairs:
        return np.ones((len(whites), 3))
    return np.asarray(np.exp(np.linalg.lstsq(np.array(pairs), np.array(ratios, np.float64), rcond=None)[0]))


def falling_colours(
    whites: Sequence[FloatImage], indirect: FloatImage, lit: Mask, grid: tuple[int, int], side: int
) -> FallingColours:
    """From each projector's direct white, and from the ``indirect`` light of all of them, (rows, columns, 3).

    ``lit`` (rows, columns): on the object; ``grid`` (rows, columns) of blocks of ``side`` x ``side`` pixels
    """
    lamps = lamp_colours(whites, lit)
    paint = np.sum([one / lamp.astype(np.float32) for one, lamp in zip(whites, lamps, strict=True)], axis=0)
    faint = DARKEST_PAINT * float(np.percentile(channels.mean(paint)[lit], 90)) if lit.any() else 0.0
    good = lit & (channels.smallest(paint) > faint)
    colour = np.where(good[..., None], indirect / np.maximum(paint, np.float32(1e-12)), np.float32(0))
    colour /= np.maximum(channels.total(colour), np.float32(1e-12))[..., None]
    light = np.where(good, channels.total(indirect), np.float32(0))[..., None]
    weight = down(light, grid, side).astype(np.float64)
    part = down(colour * light, grid, side) / np.maximum(weight, 1e-30)
    share = down(good[..., None].astype(np.float32), grid, side)[:, 0]
    return FallingColours(part, np.asarray((share > LEAST_KNOWN) & (weight[:, 0] > 0)))


Part = Literal["all", "object", "room"]
LEAST_DARK: Final = 0.3
"""Share of a block that must be dark, for its light to count."""
FAINTEST: Final = 1e-3
NO_LIGHT: Final = 1e-9
"""Of the mean light that falls on blocks."""
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
    terms: Sequence[Term], whites: Sequence[BlockLight], stripes: Sequence[BlockLight], blocks: BlockGrid
) -> FloatImage:  # fmt: skip
    """The factor (terms,) >= 0 of each term that separates pictures' indirect light best.

    What surfaces make of falling light follows from all whites together, so a picture's light is predicted as its part
    of what falls, times theirs. Least squares by ``blocks``, relative to the light; the part's
    denominator is that of the round before. Neighbours in ``terms`` that differ in their part alone are held together.
    """
    from scipy.optimize import nnls

    pictures = (*whites, *stripes)
    total = whites[0].whole
    light = np.sum([one.source("all") for one in whites], axis=0)
    falling = _falling(terms, pictures, down_up(*blocks))
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
        gain = np.divide(relative, now, out=np.zeros_like(total), where=use & (now > NO_LIGHT))
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


def corrected_factors(
    own: FloatImage, room: FloatImage, pictures: Sequence[BlockLight], whites: int, blocks: BlockGrid,
    colours: FallingColours | None = None,
) -> tuple[FloatImage, FloatImage]:  # fmt: skip
    """``own`` and ``room`` (blocks, blocks), light from the object's and the room's blocks, corrected; none below 0.

    ``pictures``: of which the first are all ``whites``; ``blocks``: those of own and room
    ``colours``: of what falls, of all whites together
    """
    lights = np.stack([np.concatenate([one.own, one.room]) for one in pictures])
    every = lights[:whites].sum(axis=0)
    both = np.concatenate([own, room], axis=1)
    falling = np.stack([both @ light for light in (*lights, every)])
    across = down_up(*blocks)
    *seen, whole = (across(np.asarray(one, np.float32)) for one in falling)
    parts, known = (np.stack(images) for images in zip(*(measured_part(one) for one in pictures), strict=True))
    bright = every[: len(own)] + every[len(own) :]
    known = known * ((whole > 0) & (pictures[0].whole > 0) & (bright > FAINTEST * bright.max(initial=0)))
    left = parts - np.divide(seen, whole, out=np.zeros_like(parts), where=known > 0)
    coloured = _Coloured(colours, both, every)
    smooth = _SmoothFactors(blocks.grid)
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
        self._rows, self._columns = (_correlation_root(count) for count in grid)

    def of(self, sources: FloatImage) -> FloatImage:
        """``sources`` (equations, blocks) times B."""
        image = sources.reshape(len(sources), len(self._rows), len(self._columns))
        return np.asarray(np.matmul(self._rows.T, image @ self._columns).reshape(len(sources), -1), np.float32)

    def back(self, values: Float64) -> Float64:
        """B times ``values`` (k,)."""
        along = values.reshape(self._rows.shape[1], self._columns.shape[1])
        return np.asarray((self._rows @ along @ self._columns.T).reshape(-1), np.float64)


def _correlation_root(count: int) -> FloatImage:
    """(count, k) R with R R' the correlation along so many blocks."""
    apart = np.subtract.outer(np.arange(count), np.arange(count)) / ALIKE_BLOCKS
    values, vectors = np.linalg.eigh(np.exp(-0.5 * apart**2))
    use = values > LEAST_VARIANCE * values.max()
    return np.asarray(vectors[:, use] * np.sqrt(values[use]), np.float32)
