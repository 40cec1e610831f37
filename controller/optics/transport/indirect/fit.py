"""G from what was measured: form factors of the reconstructed surface, and the indirect part of each white image.

Surfaces give each other all light that leaves them, and so that by way of others, too. How much each gives is found
for all light of whites and stripes; G, which begins with direct light, adds up all ways (docs/decisions/0015). What a
paint changes of the colours that the local transport predicts is part of it (``paint_colours``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import cv2
import numpy as np

from controller.core import channels
from controller.core.arrays import Float64, FloatImage, Mask, strips, summed
from controller.optics.calibrate.photometry.surface_spread import typical_spread
from controller.optics.calibrate.photometry.tile_fit import colour_of
from controller.optics.calibrate.values import Calibration, ProjectorCalibration, Radiometry
from controller.optics.capture.patterns import plan_patterns
from controller.optics.transport.indirect.blocks import BlockGrid, down, parted, up
from controller.optics.transport.indirect.form_factors import form_factors
from controller.optics.transport.indirect.indirect_light import Colours, IndirectLight
from controller.optics.transport.indirect.stripes import blocks_of, coarse_stripes, stride_of, stripe_parts, thinned
from controller.optics.transport.indirect.surface_light import SurfaceLight
from controller.optics.transport.indirect.weights import (
    BlockLight,
    Part,
    Term,
    block_light,
    corrected_factors,
    falling_colours,
    fit_weights,
)


def paint_colours(calibration: Calibration, lit: Mask) -> Colours | None:
    """D (3, 3, rows, columns) of ``IndirectLight``; None where one mixing holds for all paints.

    One D stands for all projectors: their mean, weighted by their white light. Lamps of one kind have the same.

    Parameters
    ----------
    calibration : with ``Radiometry.paint`` of each projector, or of none
    lit : (rows, columns) camera pixels whose direct light the transport knows; D is 0 elsewhere
    """
    if any(part.radiometry.paint is None for part in calibration.projectors):
        return None
    found = np.zeros((3, 3, *lit.shape), np.float16)
    for rows in strips(len(lit)):
        light, total = np.zeros((3, 3, *lit[rows].shape)), np.full(lit[rows].shape, 1e-30)
        for part in calibration.projectors:
            white = np.maximum(part.white[rows], 0).astype(np.float64)
            strength = channels.total(white)
            light += strength * _deviation(part.radiometry, colour_of(white))
            total += strength
        found[:, :, rows] = np.where(lit[rows], light / total, 0)
    return found


def _deviation(radiometry: Radiometry, colour: Float64) -> Float64:
    """D (3, 3, rows, columns) of one projector; ``colour`` (rows, columns, 3, 3) of its white, as of ``colour_of``."""
    assert radiometry.paint is not None
    mixing = np.einsum("yxkj,kcj->yxkc", colour, radiometry.paint)
    # No colour takes light away: what says so is the error of B, on paints that are nearly black in one channel.
    mixing = np.maximum(mixing, 0.0)
    mixing /= mixing.sum(axis=-1, keepdims=True)
    relative = mixing @ np.linalg.inv(radiometry.mixing) - np.eye(3)
    return np.asarray(np.einsum("yxkm,yxmk->kmyx", relative, colour), np.float64)


Both = tuple[FloatImage, FloatImage]
"""Of the object, and of surfaces that are none of it."""
DOUBLED: Final = 3
"""2^3 bounces are counted. Surfaces throw back less than half of what falls on them on the mean, so 1 % is left."""


def with_bounces(direct: Both, factors: Both, back: Both) -> Both:
    """All light that leaves blocks (blocks, pictures, 3), where ``direct`` light is that of projectors.

    ``factors`` (blocks, blocks): light that falls from blocks of object and room; ``back`` (blocks, 1, 3): what they
    make of light that falls on them
    """
    own, room = direct
    shape = own.shape
    for _ in range(2**DOUBLED):
        falling = sum(one @ light.reshape(len(light), -1) for one, light in zip(factors, (own, room), strict=True))
        falling = np.asarray(falling, np.float32).reshape(shape)
        own, room = direct[0] + back[0] * falling, direct[1] + back[1] * falling
    return own, room


def by_all_ways(factors: Both, back: Both) -> Both:
    """(blocks, blocks) each: light that falls by way of any number of surfaces, for light of projectors alone.

    One matrix for all colours: what is thrown back is the mean of them, and white is made right by colour afterwards.
    ``factors``, ``back``: see ``with_bounces``. A series, and so never negative.
    """
    step = factors[0] * back[0].mean(axis=1) + factors[1] * back[1].mean(axis=1)
    found = np.concatenate(factors, axis=1)
    for number in range(DOUBLED):
        found += step @ found
        step = step @ step if number + 1 < DOUBLED else step
    return found[:, : len(step)], found[:, len(step) :]


NEAR_BLOCKS: Final = (1.0, 3.0)
"""Standard deviations of near light, in blocks: what spreads under the surface, or between neighbours."""
FAINTEST: Final = 1e-4
"""Of the brightest: less falling light says nothing of what a surface makes of it."""


def fit_indirect(
    calibration: Calibration, lit: Mask, points_m: FloatImage | None, normals: FloatImage | None
) -> IndirectLight | None:
    """G of a stage; None where none was measured, no colour depends on the paint, and none spreads under the surface.

    Parameters
    ----------
    calibration : with the indirect light of each projector's white, camera (rows, columns, 3), and what coarse stripes
        throw back, where that is known
    lit : (rows, columns) camera pixels whose direct light the transport knows
    points_m, normals : (rows, columns, 3) of the surface in the camera's frame, NaN where unknown; None: not known
    """
    indirect = [part.indirect for part in calibration.projectors if part.indirect is not None]
    paint, surface = paint_colours(calibration, lit), _surface(calibration, lit)
    if len(indirect) < len(calibration.projectors) or not indirect:
        return None if paint is None and surface is None else replace(_nothing(lit), paint=paint, surface=surface)
    grid, side = blocks_of(calibration.black.shape)
    whole, stride = summed(indirect), stride_of(calibration.black.shape)
    few = _View(lit[::stride, ::stride], grid, side // stride, thinned(whole, stride))
    kinds = [_even(grid), *(_near(grid, deviation) for deviation in NEAR_BLOCKS)]
    if points_m is not None and normals is not None:
        kinds.append(form_factors(thinned(points_m, stride), thinned(normals, stride), grid, few.side))
    factors = _factors(kinds, calibration.projectors, few, stride)
    directly = summed([part.white for part in calibration.projectors])
    view = _View(lit, grid, side, whole)
    scale = view.scale(factors, parted(directly, lit, grid, side))
    return IndirectLight(factors[0], scale, lit, grid, side, factors[1], paint, surface)


@dataclass(frozen=True, slots=True, eq=False)
class _View:
    """A camera picture by blocks, or some of its pixels: ``whole`` (rows, columns, 3), all whites' indirect light.

    ``lit`` (rows, columns): on the object; ``grid`` (rows, columns) of blocks of ``side`` x ``side`` pixels
    """

    lit: Mask
    grid: tuple[int, int]
    side: int
    whole: FloatImage

    def blocks(self, light: FloatImage, indirect: FloatImage) -> BlockLight:
        """A picture of ``light`` that leaves surfaces, and of its ``indirect`` light, (rows, columns, 3)."""
        return block_light(light, down(indirect, self.grid, self.side), self.whole, self.lit, self.grid, self.side)

    def scale(self, factors: Both, light: Both) -> FloatImage:
        """S (rows, columns, 3), which makes whites' indirect light of their ``light`` (blocks, 3) the measured one."""
        arriving = np.asarray(factors[0] @ light[0] + factors[1] @ light[1], np.float32)
        falling = up(arriving, self.grid, self.side, self.lit.shape)
        faint = FAINTEST * falling.max(initial=0)
        scale = np.divide(self.whole, falling, out=np.zeros_like(self.whole), where=falling > faint)
        return np.asarray(scale, np.float32)

    def back(self, factors: Both, light: Both) -> Both:
        """What blocks make of light that falls on them."""
        return parted(self.scale(factors, light), self.lit, self.grid, self.side)


def _factors(kinds: Sequence[FloatImage], projectors: Sequence[ProjectorCalibration], view: _View, stride: int) -> Both:
    """(blocks, blocks) of object and room, from direct light: of all ``kinds``, of which the last tells most.

    ``view``: every ``stride``-th camera pixel
    """
    directs = [thinned(part.white, stride) for part in projectors]
    indirects = [thinned(part.indirect, stride) for part in projectors if part.indirect is not None]
    whites = [view.blocks(one + other, other) for one, other in zip(directs, indirects, strict=True)]
    every = np.sum([one.own for one in whites], axis=0), np.sum([one.room for one in whites], axis=0)
    first = (kinds[-1], kinds[-1])
    back = view.back(first, every)
    stripes = _with_indirect(
        [one for part, direct in zip(projectors, directs, strict=True) for one in _striped(part, direct, view, stride)],
        first,
        back,
    )
    # Only stripes tell the light of the object from that of table and walls.
    parts: tuple[Part, ...] = ("object", "room") if stripes else ("all",)
    terms = [Term(kind, part) for kind in kinds for part in parts]
    blocks = BlockGrid(view.grid, view.side, view.whole.shape)
    weights = fit_weights(terms, whites, stripes, blocks)
    own, room = (
        np.sum([w * t.matrix for w, t in zip(weights, terms, strict=True) if t.part in (part, "all")], axis=0)
        for part in ("object", "room")
    )
    if stripes:
        colours = falling_colours(directs, view.whole, view.lit, view.grid, view.side)
        own, room = corrected_factors(own, room, (*whites, *stripes), len(whites), blocks, colours)
    return by_all_ways((own, room), view.back((own, room), every))


def _with_indirect(pictures: Sequence[BlockLight], factors: Both, back: Both) -> list[BlockLight]:
    """With what surfaces throw back of the direct light of each picture, as far as is known yet."""
    if not pictures:
        return []
    # all pictures at once: the factors are read for all of them, not for each
    direct = tuple(np.stack(lights, axis=1) for lights in zip(*((one.own, one.room) for one in pictures), strict=True))
    own, room = with_bounces((direct[0], direct[1]), factors, (back[0][:, None], back[1][:, None]))
    return [replace(one, own=own[:, n], room=room[:, n]) for n, one in enumerate(pictures)]


def _nothing(lit: Mask) -> IndirectLight:
    """G where no surface lights another."""
    nothing = np.zeros((1, 1), np.float32)
    return IndirectLight(nothing, np.zeros((*lit.shape, 3), np.float32), lit, (1, 1), max(lit.shape))


def _surface(calibration: Calibration, lit: Mask) -> SurfaceLight | None:
    spread = typical_spread([part.spread for part in calibration.projectors])
    if spread is None:
        return None
    return SurfaceLight.of(spread, summed([part.white for part in calibration.projectors]), lit)


def _striped(part: ProjectorCalibration, white: FloatImage, view: _View, stride: int) -> list[BlockLight]:
    """What a projector's coarse stripes throw back; ``white``: its direct light on the pixels of ``view``."""
    if part.stripes is None or part.phase_map is None:
        return []
    rows, columns = part.metapixels.valid.shape
    at, found = thinned(part.phase_map.projector_px, stride), []
    for pattern, seen in zip(coarse_stripes(plan_patterns((columns, rows))), part.stripes, strict=True):
        light, dark = stripe_parts(pattern, (columns, rows), at)
        direct = white * light[..., None]
        found.append(block_light(direct, seen, view.whole, view.lit, view.grid, view.side, dark))
    return found


def beside(part: ProjectorCalibration, frame: FloatImage, lit: Mask) -> FloatImage:
    """Direct light (rows, columns, 3) of a projector's frame where the transport knows none: on table and walls."""
    if part.phase_map is None:
        light = np.broadcast_to(frame.mean(axis=(0, 1)), part.white.shape)
    else:
        at = np.nan_to_num(part.phase_map.projector_px, nan=-1e4)
        light = cv2.remap(frame, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    mixed = part.white * (light @ part.radiometry.mixing.T.astype(np.float32))
    return np.where(lit[..., None], np.float32(0), mixed).astype(np.float32)


def _even(grid: tuple[int, int]) -> FloatImage:
    """All blocks give the same to all: surroundings that no one sees, and glare in lenses."""
    count = grid[0] * grid[1]
    return np.full((count, count), 1 / count, np.float32)


def _near(grid: tuple[int, int], deviation: float) -> FloatImage:
    """A block's neighbourhood, as a Gaussian."""
    one = [np.exp(-0.5 * (np.subtract.outer(np.arange(n), np.arange(n)) / deviation) ** 2) for n in grid]
    return np.asarray(np.kron(*(part / part.sum(axis=1, keepdims=True) for part in one)), np.float32)
