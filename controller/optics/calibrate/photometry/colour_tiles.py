"""The colour tiles as the camera sees them: one measurement of light for each, away from the tile's border."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from controller.core import channels
from controller.core.arrays import Float64, FloatImage, Mask
from controller.optics.calibrate.correspondence.captures import Captures, coloured, lit_pixels
from controller.optics.calibrate.correspondence.gray_code import Cells, read_code
from controller.optics.calibrate.values import Radiometry
from controller.optics.capture.pattern_frames import tile_levels
from controller.optics.capture.patterns import TILE_MARGIN, PatternKind, PatternPlan, cells_of_frame
from controller.optics.capture.profile import CameraNoise

FEWEST_PIXELS = 4
NOISE = 1e-4
"""Variance of a photograph's value at the white of the brightest pixels, relative; shot noise falls with the light."""
DOUBT = 0.1
"""Standard deviation of a tile's indirect light, relative: dark tiles count where little of their light is indirect."""
SYSTEMATIC = 0.002
"""Standard deviation of tiles apart from noise, of full scale."""


@dataclass(frozen=True, slots=True)
class TileMeasurements:
    """Measurements of all colour tiles, one for each tile.

    ``levels`` (tiles, 3) int64 device values shown; ``ratio`` (tiles, 3) light per camera channel, white being 1;
    ``weight`` (tiles, 3): inverse of its variance; ``photograph`` (tiles,) int64: which one of the tiles' photographs
    it is from, from 0; ``pixels``: camera pixels that they come from; ``indirect`` (tiles, 3): light that was taken
    away from ``ratio``, as it is when the lamp is as strong as at white; ``place`` (tiles, 2) int64: the tile's column
    and row in the projector's image; ``white`` (tiles, 3): mean light of white there, by which light was divided
    """

    levels: npt.NDArray[np.int64]
    ratio: Float64
    weight: Float64
    photograph: npt.NDArray[np.int64]
    pixels: int
    indirect: Float64
    place: npt.NDArray[np.int64]
    white: Float64

    def at(self, strength: Float64) -> TileMeasurements:
        """As they would be had the lamp been as strong as at white; ``strength`` of it in each photograph."""
        # a stronger lamp throws more light at other surfaces, too
        seen = (self.ratio + self.indirect) / strength[self.photograph][:, None]
        return dataclasses.replace(self, ratio=seen - self.indirect)


@dataclass(frozen=True, slots=True)
class KnownIndirect:
    """What is known already of indirect light: that of white, (rows, columns, 3), and the projector's radiometry."""

    white: FloatImage
    radiometry: Radiometry

    def of(self, levels: npt.NDArray[np.uint8]) -> FloatImage:
        """Indirect light of a picture of device values (..., 3): that of white, times the picture's mean light."""
        light = np.stack([self.radiometry.response[c][levels[..., c]] for c in range(3)], axis=-1)
        mean = self.radiometry.emitted(light).mean(axis=tuple(range(light.ndim - 1)))
        return np.asarray(self.white * (self.radiometry.mixing @ mean).astype(np.float32), np.float32)


def measure_tiles(
    captures: Captures,
    plan: PatternPlan,
    black: FloatImage,
    white: FloatImage,
    *,
    code: tuple[Cells, Cells],
    indirect: KnownIndirect | None = None,
) -> TileMeasurements:
    """Find the tiles by the code and measure each.

    Parameters
    ----------
    captures : needs ``mosaic-*``
    black, white : (rows, columns, 3) linear light of black, and of white above black; NaN where not known
    code : the cells of both axes, from ``tile_code``
    indirect : is taken away from tiles and white

    Raises CalibrationError("capture-missing") or CalibrationError("capture-shape-wrong").
    """
    tiles_patterns = plan.of_kind(PatternKind.COLOUR_TILES)
    side = tiles_patterns[0].tile_cells
    across, down = cells_of_frame(plan.size_px)
    column, row = code
    tile = (row.cell // side) * -(-across // side) + column.cell // side
    framed = (column.cell < across) & (row.cell < down)
    seen = (column.weak == 0) & (row.weak == 0) & framed
    # At a border of cells: of two tiles, or of two cells of one tile. Their neighbours tell which.
    between = column.sure & row.sure & framed & ~seen
    if indirect is not None:
        white = white - indirect.white
    inside = _interior(np.where(seen, tile, -1).astype(np.int32), between, lit_pixels(white))
    number = -(-across // side) * -(-down // side)
    which = tile[inside]
    count = np.bincount(which, minlength=number)
    total = _sums(white[inside], which, number)
    full = np.maximum(np.percentile(white[inside], 99, axis=0), 1e-12) if which.size else np.ones(3)
    used = np.flatnonzero((count >= FEWEST_PIXELS) & np.all(total > 0, axis=1))
    levels, ratios, weights, photographs, thrown, places, whites = [], [], [], [], [], [], []
    for photograph, pattern in enumerate(tiles_patterns):
        shown = tile_levels(pattern, plan.size_px)
        light = coloured(captures, pattern.name, black.shape[:2])[inside] - black[inside]
        away = np.zeros((number, 3))
        if indirect is not None:
            thrown_light = indirect.of(shown)[inside]
            light -= thrown_light
            away = _sums(thrown_light, which, number)
        with np.errstate(invalid="ignore", divide="ignore"):
            ratio = (_sums(light, which, number) / total)[used]
            variance = NOISE * (np.maximum(ratio, 0) + ratio**2 + 0.02) * full / total[used] + SYSTEMATIC**2
            taken = (away / total)[used]
            variance += (DOUBT * taken) ** 2
        measured = np.isfinite(ratio).all(axis=1)
        levels.append(_levels_of(shown, side)[used][measured])
        ratios.append(ratio[measured])
        weights.append(1 / variance[measured])
        thrown.append(taken[measured])
        whites.append((total[used] / count[used, None])[measured])
        places.append(np.stack(np.divmod(used[measured], -(-across // side))[::-1], axis=1))
        photographs.append(np.full(np.count_nonzero(measured), photograph, np.int64))
    ratio, weight = np.concatenate(ratios), np.concatenate(weights)
    shown_in, away, place, lit = (np.concatenate(parts) for parts in (photographs, thrown, places, whites))
    return TileMeasurements(np.concatenate(levels), ratio, weight, shown_in, int(which.size), away, place, lit)


def tile_code(
    captures: Captures,
    plan: PatternPlan,
    black: FloatImage,
    white: FloatImage,
    *,
    known_px: FloatImage | None = None,
    noise: CameraNoise | None = None,
) -> tuple[Cells, Cells]:
    """The cells of both axes by which tiles are found.

    Parameters
    ----------
    captures : needs ``gray-*``, unless ``known_px`` stands for the code
    black, white : as for ``measure_tiles``
    known_px, noise : as for ``decode``

    Raises CalibrationError("capture-missing") or CalibrationError("capture-shape-wrong").
    """
    half = np.asarray(channels.total(white) / 2, np.float32)
    return read_code(captures, plan, channels.total(black) + half, half, known_px, noise or CameraNoise())


def _levels_of(cells: npt.NDArray[np.uint8], side: int) -> npt.NDArray[np.int64]:
    return cells[::side, ::side].reshape(-1, 3).astype(np.int64)


def _sums(light: FloatImage, which: npt.NDArray[np.int32], number: int) -> Float64:
    """(number, 3): ``light`` (pixels, 3) added up by tile; NaN where one pixel of a tile is not known."""
    return np.stack([np.bincount(which, light[:, channel], number) for channel in range(3)], axis=1)


def _interior(tile: npt.NDArray[np.int32], between: Mask, lit: Mask) -> Mask:
    """Lit camera pixels around which, as far as a neighbouring tile's light may reach, all is the same tile.

    ``tile``: -1 where it is not known; what is ``between`` is taken for whatever lies around it
    """
    counts = np.bincount(tile[lit & (tile >= 0)]) if np.any(lit & (tile >= 0)) else np.zeros(1, np.int64)
    sizes = counts[counts > 0]
    if not sizes.size:
        return np.zeros_like(lit)
    side_px = float(np.sqrt(np.percentile(sizes, 75)))
    reach = max(1, round(TILE_MARGIN * side_px))
    kernel = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    value = tile.astype(np.float32)  # exact up to 16 million tiles
    least = cv2.erode(np.where(between, np.float32(np.inf), value), kernel)
    most = cv2.dilate(np.where(between, np.float32(-np.inf), value), kernel)
    return np.asarray(lit & (least == most) & (tile >= 0))
