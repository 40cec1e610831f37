"""The colour of the light that falls on blocks of a surface, by what it becomes on paint that is known.

Paint throws back the light of other surfaces as it throws back that of the projectors. So the indirect part of white,
over its direct part, has the colour of what falls there, in units of the lamp's white. Where surfaces around have other
colours, that says how much each of them gives (docs/decisions/0015).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Final

import numpy as np

from controller.core import channels
from controller.core.arrays import Float64, FloatImage, Mask
from controller.optics.transport.indirect.blocks import down

BRIGHT: Final = 0.1
"""Of a projector's mean light: where two are brighter, their colours are compared."""
ENOUGH_PIXELS: Final = 100
FAINTEST: Final = 0.02
"""Of the bright light's largest tenth: darker paint has mostly noise and what lenses spread."""
LEAST_KNOWN: Final = 0.3
"""Share of a block."""
ROUNDS: Final = 20


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
        for _ in range(ROUNDS if self.known.any() else 0):
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
    faint = FAINTEST * float(np.percentile(channels.mean(paint)[lit], 90)) if lit.any() else 0.0
    good = lit & (channels.smallest(paint) > faint)
    colour = np.where(good[..., None], indirect / np.maximum(paint, np.float32(1e-12)), np.float32(0))
    colour /= np.maximum(channels.total(colour), np.float32(1e-12))[..., None]
    light = np.where(good, channels.total(indirect), np.float32(0))[..., None]
    weight = down(light, grid, side).astype(np.float64)
    part = down(colour * light, grid, side) / np.maximum(weight, 1e-30)
    share = down(good[..., None].astype(np.float32), grid, side)[:, 0]
    return FallingColours(part, np.asarray((share > LEAST_KNOWN) & (weight[:, 0] > 0)))


__all__ = ["FallingColours", "falling_colours", "lamp_colours"]
