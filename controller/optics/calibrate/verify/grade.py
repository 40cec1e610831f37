"""The calibration's grade: a random pattern predicted by the light transport, and the same pattern photographed."""

from __future__ import annotations

import enum
from dataclasses import dataclass

import numpy as np

from controller.core import channels
from controller.core.arrays import Float64, FloatImage, Mask
from controller.core.errors import CalibrationError

NEIGHBOURHOOD_PX = 15


class Grade(enum.Enum):
    """By the relative error: A up to 2 %, B up to 4 %, C up to 8 %, D above."""

    A = "A"
    B = "B"
    C = "C"
    D = "D"


LIMITS = ((Grade.A, 0.02), (Grade.B, 0.04), (Grade.C, 0.08))


@dataclass(frozen=True, slots=True)
class Verification:
    """How well a photograph was predicted.

    ``relative_rms`` rms of predicted less photographed over the rms of the photographed light without the black image,
    both without what noise adds
    ``noise_rms`` what noise adds to the error, relative to the same light; 0 where it is not known
    ``gain`` (3,) photographed over predicted light per camera channel: 1, or the lamp has dimmed
    ``without_gain_rms`` the relative error that remains when the gain is taken out: what is left is place and shape
    ``error_map`` (rows, columns) float32: the same ratio around each camera pixel, NaN outside the mask
    ``grade`` of ``relative_rms``
    """

    relative_rms: float
    gain: tuple[float, float, float]
    without_gain_rms: float
    error_map: FloatImage
    grade: Grade
    noise_rms: float = 0.0


def verify(
    predicted: FloatImage, photographed: FloatImage, black: FloatImage, mask: Mask, variance: FloatImage | None = None
) -> Verification:
    """Compare a predicted with a photographed pattern.

    Parameters
    ----------
    predicted, photographed, black : (rows, columns, 3) linear camera images in one unit, black light included in both
        pictures; NaN where not measured
    mask : (rows, columns) camera pixels that count
    variance : (rows, columns, 3) of the photograph's noise, as measured of the camera; None where it is not known

    Raises
    ------
    CalibrationError("verification-shape-wrong")
    CalibrationError("verification-dark")  nothing to compare
    """
    if not predicted.shape == photographed.shape == black.shape == (*mask.shape, 3):
        raise CalibrationError(
            "verification-shape-wrong",
            what=f"The prediction {predicted.shape} and the photograph {photographed.shape} differ in size.",
            remedy="Do not change the camera's picture size, and verify again.",
        )
    use = mask & channels.every(np.isfinite(predicted) & np.isfinite(photographed) & np.isfinite(black))
    seen = np.where(use[:, :, None], photographed - black, 0).astype(np.float64)
    light_predicted = np.where(use[:, :, None], predicted - black, 0).astype(np.float64)
    per_pixel = channels.total(seen * seen)
    noise = np.zeros(mask.shape) if variance is None else np.where(use, channels.total(variance), 0).astype(np.float64)
    added = float(noise.sum())
    light = float(per_pixel.sum()) - added
    if not light > 0 or not np.any(light_predicted):
        raise CalibrationError(
            "verification-dark",
            what="The photograph of the random pattern shows no light where the calibration expects it.",
            remedy="Check that lamps and shutters are open and that the pattern was shown, and verify again.",
        )
    both, predicted_square = (
        channels.products(seen, light_predicted),
        channels.products(light_predicted, light_predicted),
    )
    gain = both / np.maximum(predicted_square, 1e-30)
    off = light_predicted - seen
    error = channels.total(np.multiply(off, off, out=off))
    relative = float(np.sqrt(max(error.sum() - added, 0.0) / light))
    without = float(np.sqrt(max(float(np.sum(gain * gain * predicted_square - 2 * gain * both)) + light, 0.0) / light))
    red, green, blue = (float(value) for value in gain)
    error_map = _error_map(error - noise, per_pixel - noise, use)
    noise_rms = float(np.sqrt(added / light))
    return Verification(relative, (red, green, blue), without, error_map, grade_of(relative), noise_rms)


def grade_of(relative_rms: float) -> Grade:
    """The grade of a relative error; NaN is D."""
    return next((grade for grade, limit in LIMITS if relative_rms <= limit), Grade.D)


def _error_map(error: Float64, light: Float64, use: Mask) -> FloatImage:
    """From (rows, columns): squared error and squared light of each pixel."""
    import cv2  # what only reads grades does without

    floor = 1e-4 * float(light.sum()) / max(int(np.count_nonzero(use)), 1)
    near_error, near_light = (cv2.boxFilter(one, -1, (NEIGHBOURHOOD_PX, NEIGHBOURHOOD_PX)) for one in (error, light))
    ratio = np.sqrt(np.maximum(near_error, 0) / np.maximum(near_light, floor))
    return np.where(use, ratio, np.nan).astype(np.float32)
