"""A projector's response and colour mixing from colour tiles (idea of Raij 2003), and whether the camera is linear.

Every tile of a picture shows a triple of device values of its own, so that two photographs hold some hundreds to
thousands of measurements: M r(levels), with M the mixing and r the three responses, divided by white. Where colours
depend on the paint, the tiles show that, too. ``tile_fit`` fits all of it. The share of indirect light and the response
in direct light alone follow from each other (``tell_direct_light``).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np

from controller.core.arrays import Float64, FloatImage
from controller.core.channels import finite
from controller.core.errors import CalibrationError
from controller.optics.calibrate.correspondence.captures import Captures, coloured, lit_pixels
from controller.optics.calibrate.correspondence.gray_code import Cells, check_size
from controller.optics.calibrate.photometry.colour_tiles import KnownIndirect, measure_tiles, tile_code
from controller.optics.calibrate.photometry.separation import SinusoidContrast, indirect_share, shown_contrast
from controller.optics.calibrate.photometry.tile_fit import evened, fit_tiles, with_paint
from controller.optics.calibrate.photometry.waveform import Wave, held_to
from controller.optics.calibrate.values import Radiometry, SurfaceSpread
from controller.optics.capture.patterns import CELL_PX, PatternPlan
from controller.optics.capture.profile import CameraNoise

FEWEST_TILES = 40
OVEREXPOSED = 0.02
"""Of the photograph."""
FEWEST_OF_OVEREXPOSED = 60
"""More, because the lightest tiles are missing."""
SUSPECT_ADDITIVITY = 0.02
"""From here on a white segment is looked for."""
BETTER = 0.7
LEAST_SEGMENT = 0.03
REMEDY = (
    "Switch off the projector's brilliant-colour, white-boost and dynamic modes (often called BrilliantColor, "
    "White Peaking or Dynamic). Then calibrate again."
)


@dataclass(frozen=True, slots=True)
class RadiometryReport:
    """What the measurement was worth.

    ``pixels`` camera pixels used; ``tiles`` that were measured, of all patterns together; ``scatter`` median absolute
    deviation of the tiles from the fit, of full scale; ``stray`` share of a tile's white that comes from other tiles;
    ``additivity`` largest relative difference between white and what the tiles say of it, over the camera's channels
    ``segment``: see ``Radiometry``; 0 where colours add; ``flicker``: largest difference of a photograph's light from
    white's, relative; ``paint``: rms of what paints change of the tiles' light, of white; 0 if one mixing holds for all
    """

    pixels: int
    tiles: int
    scatter: float
    stray: float
    additivity: float
    segment: float = 0.0
    flicker: float = 0.0
    paint: float = 0.0


def measure_radiometry(
    captures: Captures,
    plan: PatternPlan,
    *,
    indirect: KnownIndirect | None = None,
    known_px: FloatImage | None = None,
    noise: CameraNoise | None = None,
    code: tuple[Cells, Cells] | None = None,
) -> tuple[Radiometry, RadiometryReport]:
    """Response and mixing of one projector.

    Parameters
    ----------
    captures : linear RGB photographs in one unit: ``black white``, ``gray-*`` and ``mosaic-*``; NaN where saturated
    indirect : what is known of it by an earlier measurement; the response is then fitted to direct light alone
    known_px, noise : as for ``decode``
    code : the cells of both axes, from ``tile_code``; read from the photographs if omitted

    Returns
    -------
    the radiometry, and a report on the measurement

    Raises
    ------
    CalibrationError("capture-missing"), CalibrationError("capture-shape-wrong")
    CalibrationError("projector-dark")  too few colour tiles are seen
    CalibrationError("captures-overexposed")  the same, and white is clipped
    CalibrationError("projector-size-wrong")
    CalibrationError("colours-do-not-add")  the tiles do not follow from three responses and a mixing
    CalibrationError("colours-alike")  the primaries can't be separated
    """
    black = coloured(captures, "black")
    white = coloured(captures, "white", black.shape[:2]) - black
    code = code or tile_code(captures, plan, black, white, known_px=known_px, noise=noise)
    places = np.stack([one.middle_px() for one in code], axis=-1)
    # the noise of a dark projector is a code, too, but not one that its neighbours agree with
    beside = np.ones((3, 3), np.uint8)
    agree = (cv2.dilate(places, beside) - cv2.erode(places, beside) <= CELL_PX).all(axis=-1)
    check_size(places[code[0].sure & code[1].sure & lit_pixels(white) & agree], plan.size_px)
    tiles = measure_tiles(captures, plan, black, white, code=code, indirect=indirect)
    clipped = float(np.mean(finite(black) & ~finite(white)))
    if tiles.ratio.shape[0] < FEWEST_OF_OVEREXPOSED and clipped > OVEREXPOSED:
        raise CalibrationError(
            "captures-overexposed",
            what=f"White is clipped in {100 * clipped:.0f} % of the photograph.",
            remedy="Take the photographs again with a shorter exposure, so that white stays below full scale.",
        )
    if tiles.ratio.shape[0] < FEWEST_TILES:
        raise CalibrationError(
            "projector-dark",
            what=f"The camera sees only {tiles.ratio.shape[0]} lit colour tiles of this projector.",
            remedy="Check that its lamp is lit, its shutter open and its picture on the object, then calibrate again.",
        )
    fit = fit_tiles(tiles)
    if not fit.good or fit.additivity > SUSPECT_ADDITIVITY:
        # white may have a light of its own
        other = fit_tiles(tiles, with_segment=True)
        if other.good and other.segment > LEAST_SEGMENT and other.scatter < BETTER * fit.scatter:
            fit = other
    seen = tiles.ratio
    tiles, fit, paint = with_paint(tiles, fit)
    of_paint = float(np.sqrt(np.mean((seen - tiles.ratio) ** 2)))
    scatter = fit.scatter
    if not fit.good:
        raise CalibrationError(
            "colours-do-not-add",
            what=f"The projector's colours are not additive: tiles differ by {100 * scatter:.0f} % from the sum of "
            f"three responses, white by {100 * fit.additivity:.0f} %.",
            remedy=REMEDY,
        )
    if indirect is not None:
        fit = evened(tiles, fit)
    stray = float(fit.stray.mean())
    flicker = float(np.abs(fit.strength - 1).max())
    report = RadiometryReport(
        tiles.pixels, tiles.ratio.shape[0], scatter, stray, fit.additivity, fit.segment, flicker, of_paint
    )
    return Radiometry(fit.response, fit.mixing, fit.segment, paint), report


def painted(name: str, change: float) -> str | None:
    """What a technician should know of ``RadiometryReport.paint``; None where one mixing holds for all paints."""
    if not change:
        return None
    return (
        f"Colours of projector {name} depend on the paint that they fall on, by {100 * change:.1f} % of white (colour "
        "tiles, standard deviation). Velatura calculates with it. Nothing has to be done."
    )


def white_segment(name: str, share: float) -> str | None:
    """What a technician should know of a projector with a white segment; None without one."""
    if not share:
        return None
    return (
        f"Projector {name} adds white light of its own: {100 * share:.0f} % of its white is not the sum of red, green "
        f"and blue. {REMEDY} If it can't be switched off, Velatura calculates with it; bright colours are then darker."
    )


PASSES: Final = 2


@dataclass(frozen=True, slots=True)
class TilePhotographs:
    """``captures`` and ``plan`` as for ``measure_radiometry``; ``code``: the cells of both axes, of ``tile_code``."""

    captures: Captures
    plan: PatternPlan
    code: tuple[Cells, Cells]


@dataclass(frozen=True, slots=True)
class SinusoidLight:
    """What the photographs of the sinusoids show.

    ``contrast``, ``waves``: of ``sinusoid_contrast`` and ``coarse_waves``
    ``projector_px`` (rows, columns, 2): where the camera pixels look in the projector's image, NaN where not known
    ``spread``: of light under the surface; None where none was seen
    """

    contrast: SinusoidContrast
    waves: tuple[Wave, ...]
    projector_px: FloatImage
    spread: SurfaceSpread | None = None


def tell_direct_light(
    tiles: TilePhotographs,
    sinusoids: SinusoidLight,
    white: FloatImage,
    start: Radiometry,
    *,
    advance: Callable[[float], None] = lambda share: None,
) -> tuple[FloatImage, Radiometry, RadiometryReport]:
    """The share (rows, columns, 3) of a projector's white that is indirect, 0 to 1, its response and mixing in direct
    light, and a report on their measurement.

    Parameters
    ----------
    white : (rows, columns, 3) less the black image, NaN where not known
    start : response and mixing in direct and indirect light together; its response encoded the sinusoids
    advance : called with what part of the work is done, 0 to 1

    Raises what ``measure_radiometry`` raises.
    """
    shown_with, radiometry = start.response, start
    near: Float64 | None = None
    for number in range(PASSES):
        advance(number / PASSES)
        linearity = shown_contrast(radiometry, shown_with)
        share = indirect_share(
            sinusoids.contrast, white, sinusoids.projector_px, linearity=linearity, spread=sinusoids.spread
        )
        thrown = KnownIndirect(share * white, radiometry)
        by_tiles, report = measure_radiometry(tiles.captures, tiles.plan, indirect=thrown, code=tiles.code)
        radiometry = held_to(sinusoids.waves, by_tiles, shown_with, share, white, near)
        near = radiometry.response
    return share, radiometry, report
