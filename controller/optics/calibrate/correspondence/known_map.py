"""Whether a map from before still tells where each camera pixel looks: by a photograph of the colour tiles.

Every tile has three device values of its own. What a camera pixel should see of the tile at which it looked before
follows from the earlier response and mixing of the colours, whatever the paint. Where projector, camera or object moved
by more than the tiles' borders are wide, it sees another tile.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np

from controller.core import channels
from controller.core.arrays import Float64, FloatImage, Mask
from controller.optics.calibrate.correspondence.captures import Captures, coloured, lit_pixels
from controller.optics.calibrate.values import Radiometry
from controller.optics.capture.pattern_frames import tile_levels
from controller.optics.capture.patterns import CELL_PX, TILE_MARGIN, PatternKind, PatternPlan

WORST_OFF: Final = 0.15
"""Of white: a camera pixel that is farther from what it should see, in any channel, sees another tile."""
LEAST_AGREEING: Final = 0.97
AROUND_PX: Final = 15
"""Side of the neighbourhood in which most camera pixels must agree, so that a small part that moved is found, too."""
LEAST_AROUND: Final = 0.6
MOST_ASTRAY: Final = 0.005
"""Share of the asked camera pixels whose neighbourhood does not agree."""
LEAST_COVERED: Final = 0.97
"""Share of the lit camera pixels of which the map tells something."""
FEWEST_PIXELS: Final = 500


@dataclass(frozen=True, slots=True)
class MapCheck:
    """``agreeing``: share of the asked camera pixels that see the tile they should; ``astray``: of those around which
    most do not; ``covered``: share of the lit camera pixels of which the map tells something
    """

    agreeing: float
    astray: float
    covered: float

    @property
    def holds(self) -> bool:
        """Whether the map may still stand for a code."""
        return self.agreeing >= LEAST_AGREEING and self.astray <= MOST_ASTRAY and self.covered >= LEAST_COVERED


def check_map(
    captures: Captures,
    plan: PatternPlan,
    known_px: FloatImage,
    radiometry: Radiometry,
    *,
    share: FloatImage | None = None,
) -> MapCheck:
    """Compare the photographs of the colour tiles with what an earlier calibration says.

    Parameters
    ----------
    captures : linear RGB photographs in one unit: ``black white`` and ``mosaic-*``
    known_px : (rows, columns, 2) the earlier map, NaN where it tells nothing
    radiometry : the earlier one
    share : (rows, columns, 3) of white that is indirect, as ``indirect_share``; none if omitted

    Raises CalibrationError("capture-missing") or CalibrationError("capture-shape-wrong").
    """
    black = coloured(captures, "black", known_px.shape[:2])
    white = coloured(captures, "white", black.shape[:2]) - black
    lit = lit_pixels(white)
    known: Mask = channels.finite(known_px)
    covered = float(np.mean(known[lit])) if lit.any() else 0.0
    agreeing, compared = np.zeros(lit.shape, np.float32), np.zeros(lit.shape, np.float32)
    for pattern in plan.of_kind(PatternKind.COLOUR_TILES):
        side = pattern.tile_cells * CELL_PX
        at = np.nan_to_num(known_px) + np.float32(0.5)
        within = channels.largest(np.abs(at % side - np.float32(side / 2)))
        use = lit & known & (within < (0.5 - TILE_MARGIN) * side)
        levels = tile_levels(pattern, plan.size_px)
        row, column = (
            np.clip((at[..., axis] / CELL_PX).astype(np.int64), 0, levels.shape[1 - axis] - 1) for axis in (1, 0)
        )
        cells = _expected(levels, radiometry)
        expected = cells[row, column]
        if share is not None:
            expected = expected + share * (cells.reshape(-1, 3).mean(axis=0) - expected)
        with np.errstate(invalid="ignore", divide="ignore"):
            off = channels.largest(np.abs((coloured(captures, pattern.name, lit.shape) - black) / white - expected))
        use &= np.isfinite(off)
        agreeing += use & (off < WORST_OFF)
        compared += use
    return _judged(agreeing, compared, covered)


def _judged(agreeing: FloatImage, asked: FloatImage, covered: float) -> MapCheck:
    total = float(asked.sum(dtype=np.float64))
    if total < FEWEST_PIXELS:
        return MapCheck(0.0, 1.0, covered)
    size = (AROUND_PX, AROUND_PX)
    around, among = (cv2.boxFilter(one, -1, size, normalize=False) for one in (agreeing, asked))
    astray = (asked > 0) & (around < LEAST_AROUND * among)
    return MapCheck(float(agreeing.sum(dtype=np.float64)) / total, float(asked[astray].sum()) / total, covered)


def _expected(levels: np.ndarray[tuple[int, ...], np.dtype[np.uint8]], radiometry: Radiometry) -> FloatImage:
    """(cells down, cells across, 3): what the camera's channels see of each cell, of white."""
    light: Float64 = np.stack([radiometry.response[c][levels[..., c]] for c in range(3)], axis=-1)
    return np.asarray(radiometry.emitted(light) @ radiometry.mixing.T, np.float32)
