"""Metapixels from the phase map, its inverse and the modulation of fine sinusoids (paper 4.2.2, without dots)."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from controller.core import channels
from controller.core.arrays import FloatImage, Mask
from controller.optics.calibrate.correspondence.bayer_pattern import find_bayer_pattern
from controller.optics.calibrate.correspondence.captures import Captures, grey
from controller.optics.calibrate.correspondence.colour_places import ColourPlaces
from controller.optics.calibrate.correspondence.decode import frame_margin_px
from controller.optics.calibrate.correspondence.inverse_map import invert_map
from controller.optics.calibrate.correspondence.phase_map import make_phase_map
from controller.optics.calibrate.metapixels.blur import blur_of, measure_contrasts
from controller.optics.calibrate.metapixels.footprints import measure_footprints
from controller.optics.calibrate.photometry.surface_spread import measure_spread
from controller.optics.calibrate.values import Correspondence, Metapixels, PhaseMap, SurfaceSpread
from controller.optics.capture.patterns import PatternPlan


def fit_metapixels(captures: Captures, plan: PatternPlan, correspondence: Correspondence) -> Metapixels:
    """One projector's metapixels: mean and covariance of the shares that the phase map and the blur give each pixel.

    Parameters
    ----------
    captures : needs ``black``, ``phase-*`` and ``blur-*``; linear photographs in one unit, ``completed``
    correspondence : what ``decode`` made of the same captures

    Raises CalibrationError("capture-missing") or CalibrationError("capture-shape-wrong").
    """
    return fit_pixels(captures, plan, correspondence).metapixels


@dataclass(frozen=True, slots=True)
class FittedPixels:
    """One projector's metapixels, and its phase map for the light transport.

    ``mosaic`` (2, 2): the colours of the camera's samples, as ``Calibration.mosaic``; None where they are not known
    ``spread``: of light under the surface; None where none was seen
    """

    metapixels: Metapixels
    phase_map: PhaseMap
    mosaic: npt.NDArray[np.int64] | None
    spread: SurfaceSpread | None = None


def fit_pixels(
    captures: Captures,
    plan: PatternPlan,
    correspondence: Correspondence,
    colours: ColourPlaces | None = None,
    white: FloatImage | None = None,
) -> FittedPixels:
    """Metapixels and phase map from the same measurements; parameters and errors as ``fit_metapixels``.

    ``colours``: what ``decode`` was given; metapixels are then green's, and the phase map says where the others lie
    ``white`` (rows, columns, 3) less the black image: with it, light that spreads under the surface is found
    """
    inverse = invert_map(correspondence, plan.size_px)
    contrasts = measure_contrasts(captures, plan, correspondence, colours)
    blur, blur_valid = blur_of(contrasts)
    spread = None
    if white is not None:
        variance = float(np.nanmedian(blur[blur_valid][:, [0, 2]])) if blur_valid.any() else 0.0
        spread = measure_spread(captures, plan, correspondence.projector_px, white, blur_px=variance**0.5)
    if spread is not None:
        blur, blur_valid = blur_of(contrasts, spread)
    valid = inverse.valid & blur_valid
    flat = carry_covariance(inverse.jacobian, blur)
    centre, covariance = measure_footprints(correspondence, inverse, blur, flat, valid)
    margin = int(np.ceil(frame_margin_px(correspondence.modulation[correspondence.valid])))
    metapixels = _extend_to_frame(centre, inverse.jacobian, covariance, valid, margin)
    single = captures[plan.sinusoids("blur-x")[0].name]
    mosaic, light = find_bayer_pattern(single), _channels(single)
    del single
    phase_map = make_phase_map(
        correspondence,
        inverse,
        blur,
        blur_valid,
        light=light,
        interpolated=mosaic is not None,
        white=_white(captures, plan),
    )
    if colours is not None:
        phase_map = dataclasses.replace(phase_map, colours_px=colours.shifts_px)
    return FittedPixels(metapixels, phase_map, mosaic, spread)


def _white(captures: Captures, plan: PatternPlan) -> FloatImage:
    """Twice the mean of a sinusoid's steps, less black: (rows, columns)."""
    black = grey(captures, "black")
    steps = [grey(captures, pattern.name, black.shape) for pattern in plan.sinusoids("blur-x")]
    return np.asarray(sum(steps, -len(steps) * black) * np.float32(2 / len(steps)), np.float32)


def _channels(image: FloatImage) -> tuple[float, float, float]:
    """Mean light of the three channels; alike for a grey image or none at all."""
    if image.ndim != 3:
        return 1.0, 1.0, 1.0
    finite = channels.finite(image)
    if not finite.any():
        return 1.0, 1.0, 1.0
    red, green, blue = (max(float(np.mean(image[..., c][finite])), 0.0) for c in range(3))
    return (red, green, blue) if red + green + blue > 0 else (1.0, 1.0, 1.0)


def _extend_to_frame(
    centre_px: FloatImage, jacobian: FloatImage, covariance: FloatImage, valid: Mask, margin: int
) -> Metapixels:
    """Continue the outermost trusted pixels to the frame's border, where the phase can't be trusted."""
    rows, columns = valid.shape
    row, column = np.mgrid[0:rows, 0:columns]
    from_row = np.clip(row, min(margin, rows // 2), max(rows - 1 - margin, rows // 2))
    from_column = np.clip(column, min(margin, columns // 2), max(columns - 1 - margin, columns // 2))
    a, b, c, d = np.moveaxis(jacobian[from_row, from_column], -1, 0)
    dx, dy = column - from_column, row - from_row
    centre = centre_px[from_row, from_column] + np.stack([a * dx + b * dy, c * dx + d * dy], axis=-1)
    valid = valid[from_row, from_column]
    centre[~valid] = np.nan
    covariance = np.where(valid[:, :, None], covariance[from_row, from_column], np.nan)
    return Metapixels(centre.astype(np.float32), covariance.astype(np.float32), valid)


def carry_covariance(jacobian: FloatImage, covariance_px2: FloatImage) -> FloatImage:
    """J S J' of each pixel.

    ``jacobian`` (..., 4) a, b, c, d of [[a, b], [c, d]]; ``covariance_px2`` (..., 3) xx, xy, yy; returns (..., 3).
    """
    a, b, c, d = np.moveaxis(jacobian, -1, 0)
    xx, xy, yy = np.moveaxis(covariance_px2, -1, 0)
    return np.stack(
        [
            a * a * xx + 2 * a * b * xy + b * b * yy,
            a * c * xx + (a * d + b * c) * xy + b * d * yy,
            c * c * xx + 2 * c * d * xy + d * d * yy,
        ],
        axis=-1,
    )
