"""How far a projector pixel's light spreads, from the contrast that fine sinusoids lose.

A sinusoid of f cycles per projector pixel, blurred by a Gaussian of covariance S, keeps the modulation
M = (1 - i) exp(-2 pi^2 f' S f), with the share i of light that reaches the camera by way of other surfaces and has no
modulation. So M is taken relative to that of the coarse phase patterns, which lose the same share and hardly any more.
Three directions give the three numbers of S. The pixel's own square is part of S. What spreads under the surface is
not: the contrast that it takes is given back first (``photometry.surface_spread``).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from controller.core.arrays import Float64, FloatImage, Mask
from controller.core.jit import compiled
from controller.optics.calibrate.correspondence.captures import Captures, grey
from controller.optics.calibrate.correspondence.colour_alignment import ColourPlaces
from controller.optics.calibrate.correspondence.phase_map import cells_of
from controller.optics.calibrate.photometry.surface_spread import contrast_left
from controller.optics.calibrate.values import Correspondence, SurfaceSpread
from controller.optics.capture.patterns import BLUR_FREQUENCIES, PERIOD_PX, PatternPlan

NEIGHBOURHOOD = 7
"""Projector pixels a side over which the contrast is averaged; focus changes slowly over a surface."""
LEAST_CONTRAST = 0.02
LEAST_COARSE = 0.2
"""Of the phase patterns; less is left of them only where hardly any light is direct."""
LEAST_VARIANCE_PX2 = 0.02
MOST_VARIANCE_PX2 = 16.0


@dataclass(frozen=True, slots=True)
class _CameraView:
    """What the camera's pixels, (rows, columns, ...), see of a projector.

    ``black``: light at black; ``position_px`` (..., 2): where they look in the projector's image, NaN where not known
    ``cells``: row-major number of the projector pixel there, -1 for none
    """

    black: FloatImage
    position_px: FloatImage
    cells: npt.NDArray[np.int32]


@dataclass(frozen=True, slots=True)
class BlurContrasts:
    """Around each projector pixel, (rows, columns), NaN where nothing was seen.

    ``fine`` (3, rows, columns) of ``BLUR_FREQUENCIES``; ``coarse`` (2, rows, columns) of the phase patterns along x, y
    ``coarse_variance``: the blur's, in projector pixels squared, that the phase patterns tell alone
    """

    fine: FloatImage
    coarse: FloatImage
    coarse_variance: FloatImage


def measure_contrasts(
    captures: Captures, plan: PatternPlan, correspondence: Correspondence, colours: ColourPlaces | None = None
) -> BlurContrasts:
    """What ``blur_of`` needs.

    Parameters
    ----------
    captures : needs ``black``, ``phase-*`` and ``blur-*``, ``completed``; linear, in one unit
    correspondence : of the same projector
    colours : where the projector's colours lie apart; the blur is then that of one colour

    Raises CalibrationError("capture-missing") or CalibrationError("capture-shape-wrong").
    """
    cells = cells_of(correspondence, plan.size_px)
    view = _CameraView(grey(captures, "black"), correspondence.projector_px, cells)

    def contrast(prefix: str, frequency: tuple[float, float]) -> FloatImage:
        left = np.empty((0, 0), np.float32) if colours is None else colours.contrast(frequency)
        return _contrast(captures, plan, prefix, frequency, view, left)

    fine = np.stack([contrast(f"blur-{name}", frequency) for name, frequency in BLUR_FREQUENCIES.items()])
    coarse = np.stack([contrast("phase-x", (1 / PERIOD_PX, 0.0)), contrast("phase-y", (0.0, 1 / PERIOD_PX))])
    return BlurContrasts(fine, coarse, _coarse_variance(correspondence.modulation, cells, plan.size_px))


def blur_of(seen: BlurContrasts, spread: SurfaceSpread | None = None) -> tuple[FloatImage, Mask]:
    """Blur covariance S of each projector pixel.

    ``spread``: how light spreads under the surface, where it does. Returns (rows, columns, 3) float32 of the
    projector's image: xx, xy, yy in projector pixels squared; and where it is valid.
    """
    left = [contrast_left(spread, float(np.hypot(*frequency))) for frequency in BLUR_FREQUENCIES.values()]
    fine = seen.fine / np.array(left, np.float32)[:, None, None]
    coarse_x, coarse_y = seen.coarse / np.float32(contrast_left(spread, 1 / PERIOD_PX))
    with np.errstate(invalid="ignore"):
        both = np.sqrt(coarse_x * coarse_y)
    blur, measured = _covariance(fine, np.stack([coarse_x, coarse_y, both]))
    guessed = ~measured & np.isfinite(seen.coarse_variance)
    blur[guessed] = seen.coarse_variance[guessed, None] * np.array([1, 0, 1], np.float32)
    return blur, measured | guessed


def _coarse_variance(modulation: FloatImage, cells: npt.NDArray[np.int32], size_px: tuple[int, int]) -> FloatImage:
    """Variance, the same in all directions, that the phase patterns tell; NaN where they were not seen.

    It serves where the fine sinusoids are washed out altogether.
    """
    width, height = size_px
    seen = cells >= 0
    total = np.bincount(cells[seen], weights=modulation[seen], minlength=width * height).reshape(height, width)
    count = np.bincount(cells[seen], minlength=width * height).reshape(height, width).astype(np.float64)
    size = (NEIGHBOURHOOD, NEIGHBOURHOOD)
    around = [cv2.boxFilter(sums, -1, size, normalize=False) for sums in (total, count)]
    with np.errstate(invalid="ignore", divide="ignore"):
        typical = np.where(around[1] > 0.5, around[0] / around[1], np.nan)
    variance = -np.log(np.clip(typical, 1e-3, 1.0)) * PERIOD_PX**2 / (2 * np.pi**2)
    return np.asarray(np.clip(variance, LEAST_VARIANCE_PX2, MOST_VARIANCE_PX2), np.float32)


def _contrast(
    captures: Captures,
    plan: PatternPlan,
    prefix: str,
    frequency: tuple[float, float],
    view: _CameraView,
    left: FloatImage,
) -> FloatImage:
    """Modulation around each projector pixel, (rows, columns); NaN where nothing was seen.

    Each camera pixel's wave is turned back by the phase it should have before the waves are added, so that noise
    cancels instead of adding contrast, and so does the alias of the projector's pixel grid. It is compared with the
    part of its light that is ``left`` (camera rows, columns) where colours cancel each other; (0, 0): with all of it.
    """
    width, height = plan.size_px
    wave, light = np.zeros(width * height), np.zeros(width * height)
    along, steps = np.array(frequency), plan.sinusoids(prefix)
    images = [grey(captures, pattern.name, view.black.shape) for pattern in steps]
    # a wave of which a step is missing would have another contrast
    cells = np.where(np.isfinite(sum(images, -view.black)), view.cells, np.int32(-1))
    alone = not plan.measures_phase(prefix)
    for pattern, image in zip(steps, images, strict=True):
        _add_step(image, view.black, view.position_px, cells, along, pattern.phase_rad, alone, left, wave, light)
    # n pictures of W/2 (1 + M cos) each: the light adds up to n W/2, the wave to n W M/4; one step and its opposite
    # have a wave of W M cos^2, and light that is weighted by the same square adds up to 2 W cos^2
    size = (NEIGHBOURHOOD, NEIGHBOURHOOD)
    around = [cv2.boxFilter(sums.reshape(height, width), -1, size, normalize=False) for sums in (wave, light)]
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(2 * around[0] / around[1], np.float32)


@compiled()
def _add_step(
    image: FloatImage,
    black: FloatImage,
    position: FloatImage,
    cells: npt.NDArray[np.int32],
    frequency: Float64,
    phase_rad: float,
    alone: bool,
    left: FloatImage,
    wave: Float64,
    light: Float64,
) -> None:
    rows, columns = cells.shape
    for row in range(rows):
        for column in range(columns):
            cell = cells[row, column]
            value = image[row, column] - black[row, column]
            if cell >= 0:
                along = frequency[0] * position[row, column, 0] + frequency[1] * position[row, column, 1]
                cosine = np.cos(2 * np.pi * along - phase_rad)
                wave[cell] += value * cosine
                part = left[row, column] if left.size else np.float32(1)
                light[cell] += value * part * (2 * cosine * cosine if alone else 1.0)


def _covariance(fine: FloatImage, coarse: FloatImage) -> tuple[FloatImage, Mask]:
    """Solve -ln(M / Mc) = 2 pi^2 ((fx^2 - gx^2) Sxx + 2 fx fy Sxy + (fy^2 - gy^2) Syy) for S, kept positive definite.

    ``fine``, ``coarse`` (3, rows, columns): contrasts M of ``BLUR_FREQUENCIES`` f, and Mc of the phase patterns g along
    x, along y, and their geometric mean.
    """
    fx, fy = np.array(list(BLUR_FREQUENCIES.values())).T
    gx, gy = np.array([1.0, 0.0, 0.5]) / PERIOD_PX**2, np.array([0.0, 1.0, 0.5]) / PERIOD_PX**2
    equations = 2 * np.pi**2 * np.stack([fx * fx - gx, 2 * fx * fy, fy * fy - gy], axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        valid = np.all((fine > LEAST_CONTRAST) & (coarse > LEAST_COARSE), axis=0)
        kept = np.where(valid, fine / coarse, 1.0)
        lost = -np.log(np.clip(kept, LEAST_CONTRAST, 1.0))
    solved = np.tensordot(np.linalg.inv(equations), lost, axes=1)
    xx = np.clip(solved[0], LEAST_VARIANCE_PX2, MOST_VARIANCE_PX2)
    yy = np.clip(solved[2], LEAST_VARIANCE_PX2, MOST_VARIANCE_PX2)
    limit = np.sqrt((xx - LEAST_VARIANCE_PX2 / 2) * (yy - LEAST_VARIANCE_PX2 / 2))
    xy = np.clip(solved[1], -limit, limit)
    return np.stack([xx, xy, yy], axis=2).astype(np.float32), np.asarray(valid)
