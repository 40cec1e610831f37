"""Projector pixels at depth edges, where one of them falls on two surfaces, and what dots say about them there.

No ellipse describes such a pixel. Its dots are not fitted: the share of the light that each camera pixel sees of it is
kept as it was measured, camera pixel by camera pixel.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
import numpy.typing as npt

from controller.core import channels
from controller.core.arrays import FloatImage, Mask
from controller.core.jit import compiled
from controller.optics.calibrate.correspondence.phase_map import cells_of
from controller.optics.calibrate.metapixels.regularize import typical_spacing_px
from controller.optics.calibrate.values import Correspondence, Metapixels

JUMP: Final = 2.0
"""Times the typical spacing between adjacent metapixels; farther apart, they lie on two surfaces."""
AROUND_PX: Final = 2
"""Projector pixels on either side of an edge whose blur reaches over it."""
BESIDE_PX: Final = 3
"""Camera pixels beside one whose position is known that may still see the same dot."""
FAINTEST: Final = 0.02
"""Of the white image's bright pixels (99th percentile); where it is darker, a quotient is only noise."""


@dataclass(frozen=True, slots=True)
class EdgeShares:
    """Measured shares of the light at camera pixels, of single projector pixels; row-major indices.

    ``camera``, ``projector`` (n,) int32; ``share`` (n,) float32, 0..1 but for noise
    ``pattern`` (projector rows, columns) int16: in which picture each pixel was lit, -1 for none
    """

    camera: npt.NDArray[np.int32]
    projector: npt.NDArray[np.int32]
    share: npt.NDArray[np.float32]
    pattern: npt.NDArray[np.int16]


def edge_pixels(metapixels: Metapixels, correspondence: Correspondence) -> Mask:
    """(projector rows, columns): pixels next to a jump of the metapixels, or to one that is missing, that are seen."""
    rows, columns = metapixels.valid.shape
    centre = np.where(metapixels.valid[..., None], metapixels.centre_px, np.nan)
    limit = JUMP * typical_spacing_px(centre)
    torn = ~metapixels.valid
    for axis in (0, 1):
        jump = channels.length(np.diff(centre, axis=axis)) > limit
        first, second = np.delete(torn, -1, axis) | jump, np.delete(torn, 0, axis) | jump
        torn = np.insert(first, rows - 1 if axis == 0 else columns - 1, torn.take(-1, axis), axis)
        torn |= np.insert(second, 0, torn.take(0, axis), axis)
    side = 2 * AROUND_PX + 1
    near = cv2.dilate(torn.astype(np.uint8), np.ones((side, side), np.uint8)) > 0
    cells = cells_of(correspondence, (columns, rows))
    seen = np.bincount(cells[cells >= 0], minlength=rows * columns).reshape(rows, columns) > 0
    return np.asarray(near & seen)


def edge_patterns(lit: Mask, spacing_px: int) -> npt.NDArray[np.int16]:
    """Share pixels out among pictures: (rows, columns) int16, -1 where not ``lit``.

    Two pixels of one picture are at least ``spacing_px`` apart, in x or in y. Each goes to the first picture that has
    room; where that makes more pictures than a whole grid of dots has, to those of the grid.
    """
    rows, columns = lit.shape
    pattern = _first_with_room(lit, spacing_px)
    y, x = np.mgrid[0:rows, 0:columns]
    grid = np.where(lit, y % spacing_px * spacing_px + x % spacing_px, -1)
    shown, grid_pattern = np.unique(grid, return_inverse=True)
    first = 1 if shown[0] < 0 else 0
    if shown.size - first < int(pattern.max(initial=-1)) + 1:
        pattern = (grid_pattern.reshape(rows, columns) - first).astype(np.int16)
    return pattern


@compiled()
def _first_with_room(lit: Mask, spacing_px: int) -> npt.NDArray[np.int16]:
    rows, columns = lit.shape
    pattern = np.full((rows, columns), np.int16(-1))
    taken = np.zeros(4 * spacing_px * spacing_px + 1, np.bool_)
    for row in range(rows):
        for column in range(columns):
            if not lit[row, column]:
                continue
            taken[:] = False
            for r in range(max(row - spacing_px + 1, 0), row + 1):
                for c in range(max(column - spacing_px + 1, 0), min(column + spacing_px, columns)):
                    if pattern[r, c] >= 0:
                        taken[pattern[r, c]] = True
            first = 0
            while taken[first]:
                first += 1
            pattern[row, column] = first
    return pattern


def edge_frame(pattern: npt.NDArray[np.int16], number: int) -> npt.NDArray[np.uint8]:
    """(rows, columns, 3) uint8 device values: the pixels of picture ``number`` at white."""
    frame = np.zeros((*pattern.shape, 3), np.uint8)
    frame[pattern == number] = 255
    return frame


def measure_shares(
    image: FloatImage, black: FloatImage, white: FloatImage, position_px: FloatImage, lit: Mask, reach_px: int
) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.int32], npt.NDArray[np.float32]]:
    """What one photograph of dots says.

    Parameters
    ----------
    image, black, white : (rows, columns, 3) linear, one unit, ``white`` without black; NaN where saturated
    position_px : (rows, columns, 2) projector px that each camera pixel looks at, NaN where not known
    lit : (projector rows, columns) the pixels that were lit
    reach_px : a dot lights no camera pixel that looks farther away, in x or y; less than half the dots' distance

    Returns
    -------
    camera and projector pixel and share of each measurement, as in ``EdgeShares``
    """
    near = _nearest_lit(lit, reach_px)
    full = channels.total(white)
    bright = full[full > 0]
    faintest = FAINTEST * float(np.percentile(bright, 99)) if bright.size else np.inf
    owner = _owners(position_px, near)
    with np.errstate(invalid="ignore", divide="ignore"):
        share = channels.total(image - black) / full
        known = (owner >= 0) & (full > faintest) & np.isfinite(share)
    camera = np.flatnonzero(known).astype(np.int32)
    return camera, owner[known].astype(np.int32), share[known].astype(np.float32)


@compiled()
def _nearest_lit(lit: Mask, reach: int) -> npt.NDArray[np.int32]:
    rows, columns = lit.shape
    near = np.full((rows, columns), np.int32(-1))
    for row in range(rows):
        for column in range(columns):
            if lit[row, column]:
                for r in range(max(row - reach, 0), min(row + reach + 1, rows)):
                    for c in range(max(column - reach, 0), min(column + reach + 1, columns)):
                        near[r, c] = row * columns + column
    return near


@compiled()
def _owners(position: FloatImage, near: npt.NDArray[np.int32]) -> npt.NDArray[np.int32]:
    """The lit pixel that each camera pixel may see, by its own position or by that of the closest that has one."""
    rows, columns = position.shape[:2]
    own = np.full((rows, columns), np.int32(-1))
    for row in range(rows):
        for column in range(columns):
            own[row, column] = _looked_up(position[row, column, 0], position[row, column, 1], near)
    widened = own.copy()
    for row in range(rows):
        for column in range(columns):
            if own[row, column] < 0:
                continue
            for r in range(max(row - BESIDE_PX, 0), min(row + BESIDE_PX + 1, rows)):
                for c in range(max(column - BESIDE_PX, 0), min(column + BESIDE_PX + 1, columns)):
                    if widened[r, c] < 0 and not np.isfinite(position[r, c, 0]):
                        widened[r, c] = own[row, column]
    return widened


@compiled()
def _looked_up(x: float, y: float, near: npt.NDArray[np.int32]) -> int:
    if not (np.isfinite(x) and np.isfinite(y)):
        return -1
    row, column = int(np.floor(y + 0.5)), int(np.floor(x + 0.5))
    if not (0 <= row < near.shape[0] and 0 <= column < near.shape[1]):
        return -1
    return int(near[row, column])
