"""Gray code and phase shift to correspondences: where on the projector's image each camera pixel looks.

Gray-code cells of 8 px tell which period of the 16-px sinusoid a camera pixel is in, the sinusoid's phase where in it.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from controller.arrays import FloatImage, Mask
from controller.calibrate.captures import Captures, grey
from controller.calibrate.smoothing import fit_planes
from controller.calibrate.values import Correspondence
from controller.capture.patterns import CELL_PX, PERIOD_PX, PatternPlan
from controller.errors import CalibrationError

LEAST_MODULATION = 0.12
MOST_MODULATION = 1.4
DARKEST_SHARE = 0.004
"""Of the brightest amplitude (99th percentile): below it, light from elsewhere outweighs the projector's own."""
WORST_NOISE_PX = 0.35
"""One camera pixel's noise, before the plane fit."""
WEAK_BIT = 0.25
CELL_SLACK_PX = 1.5
LEAST_CONSISTENT = 0.6
LEAST_STEADY = 0.75
BRIGHT_SHARE = 0.1
NOISE_WINDOW = (7, 7)
FEWEST_PIXELS = 100


@dataclass(frozen=True, slots=True)
class _Axis:
    """One coordinate: its position, NaN where unknown; the sinusoid's amplitude and mean; squared noise of both."""

    position_px: FloatImage
    amplitude: FloatImage
    mean: FloatImage
    noise_squared: FloatImage
    consistent: Mask


def decode(captures: Captures, plan: PatternPlan, *, refine: bool = True) -> Correspondence:
    """Decode one projector's Gray-code and phase captures.

    Parameters
    ----------
    captures : linear photographs by pattern name, (rows, columns) or (rows, columns, 3); needs ``black``, ``gray-*``
        and ``phase-*``
    refine : replace each pixel by the plane through its neighbours on the same surface, and drop pixels that are
        not on it, such as those that see two surfaces at once

    Returns
    -------
    Correspondence; nothing is valid where the projector casts no light, nor at the border of its frame

    Raises
    ------
    CalibrationError("capture-missing"), CalibrationError("capture-shape-wrong")
    CalibrationError("captures-inconsistent")  code and phase contradict each other: photographs in the wrong order
    """
    black = grey(captures, "black")
    axes = tuple(_decode_axis(captures, plan, axis, black) for axis in range(2))
    white = (axes[0].mean + axes[1].mean) - 2 * black  # two means of half the light each
    amplitude = np.minimum(axes[0].amplitude, axes[1].amplitude)
    with np.errstate(invalid="ignore", divide="ignore"):
        modulation = np.sqrt(axes[0].amplitude * axes[1].amplitude) / (0.5 * white)
        lit = _lit(axes, amplitude, modulation)
    consistent = axes[0].consistent & axes[1].consistent
    bright = _bright(white, axes)
    _check_order(lit | bright, lit & consistent, axes)
    position = np.stack([axis.position_px for axis in axes], axis=2)
    valid = lit & consistent & _inside(position, plan.size_px, 0.0)
    valid &= _inside(position, plan.size_px, frame_margin_px(modulation[valid]))
    if refine:
        position, valid = fit_planes(position, valid)
    position[~valid] = np.nan
    return Correspondence(position, np.where(valid, modulation, 0).astype(np.float32), valid)


def _decode_axis(captures: Captures, plan: PatternPlan, axis: int, black: FloatImage) -> _Axis:
    shape = black.shape
    steps: list[FloatImage] = [
        grey(captures, pattern.name, shape) for pattern in plan.sinusoids(("phase-x", "phase-y")[axis])
    ]
    cosine, sine = (steps[0] - steps[2]) / 2, (steps[1] - steps[3]) / 2
    mean = np.asarray((steps[0] + steps[1] + steps[2] + steps[3]) / 4, np.float32)
    # four steps, three unknowns: what is left over is noise
    noise_squared = np.asarray(((steps[0] + steps[2] - steps[1] - steps[3]) / 2) ** 2, np.float32)
    del steps
    amplitude = np.hypot(cosine, sine)
    within_px = np.arctan2(sine, cosine) * np.float32(PERIOD_PX / (2 * np.pi))
    cell, weak = _decode_gray(captures, plan, axis, mean, black)
    middle_px = cell * np.float32(CELL_PX) + np.float32((CELL_PX - 1) / 2)
    position = within_px + PERIOD_PX * np.round((middle_px - within_px) / PERIOD_PX)
    consistent = (np.abs(position - middle_px) <= CELL_PX / 2 + CELL_SLACK_PX) & (weak <= 1)
    return _Axis(position.astype(np.float32), amplitude, mean, noise_squared, consistent)


def _decode_gray(
    captures: Captures, plan: PatternPlan, axis: int, mean: FloatImage, black: FloatImage
) -> tuple[np.ndarray[tuple[int, ...], np.dtype[np.int32]], np.ndarray[tuple[int, ...], np.dtype[np.uint8]]]:
    """The cell of each camera pixel, and how many bits were near the threshold (at most one is: at a cell's border)."""
    cell = np.zeros(black.shape, np.int32)
    bit = np.zeros(black.shape, np.bool_)
    weak = np.zeros(black.shape, np.uint8)
    half = np.abs(mean - black)
    for pattern in plan.gray(axis):
        above = grey(captures, pattern.name, black.shape) - mean
        bit ^= above > 0
        cell = (cell << 1) | bit
        weak += ~(np.abs(above) >= WEAK_BIT * half)
    return cell, weak


def _noise(axes: tuple[_Axis, ...]) -> FloatImage:
    """Standard deviation of one photograph's value around each camera pixel."""
    both = np.nan_to_num(axes[0].noise_squared + axes[1].noise_squared) / 2
    return np.asarray(np.sqrt(np.maximum(cv2.boxFilter(both, -1, NOISE_WINDOW), 0)), np.float32)


def _lit(axes: tuple[_Axis, ...], amplitude: FloatImage, modulation: FloatImage) -> Mask:
    """Where the sinusoids stand out of the noise and of stray light. NaN anywhere is not lit."""
    noise_px = _noise(axes) / (np.sqrt(2) * amplitude) * (PERIOD_PX / (2 * np.pi))
    lit = (amplitude > DARKEST_SHARE * _brightest(amplitude)) & (noise_px < WORST_NOISE_PX)
    return np.asarray(lit & (modulation > LEAST_MODULATION) & (modulation < MOST_MODULATION))


def _bright(white: FloatImage, axes: tuple[_Axis, ...]) -> Mask:
    """Where this projector plainly casts light, whether or not the phases make sense.

    Phases in the wrong order look like noise as strong as the pattern; real noise vanishes in a neighbourhood's mean.
    """
    around = cv2.boxFilter(np.nan_to_num(white), -1, NOISE_WINDOW)
    return np.asarray((around > BRIGHT_SHARE * _brightest(white)) & (around > _noise(axes)) & np.isfinite(white))


def _brightest(image: FloatImage) -> float:
    finite = image[np.isfinite(image)]
    return float(np.percentile(finite[:: max(1, finite.size // 100_000)], 99)) if finite.size else 0.0


def _check_order(seen: Mask, agreeing: Mask, axes: tuple[_Axis, ...]) -> None:
    """Refuse captures that contradict each other: code against phase, or a code that jumps at every other cell."""
    pixels = int(np.count_nonzero(seen))
    if pixels < FEWEST_PIXELS:
        return
    share = np.count_nonzero(agreeing) / pixels
    steady = min(_steady_share(axis.position_px, agreeing) for axis in axes)
    if share < LEAST_CONSISTENT or steady < LEAST_STEADY:
        raise CalibrationError(
            "captures-inconsistent",
            what=f"Gray code and phase agree at {100 * share:.0f} % of the lit camera pixels, and {100 * steady:.0f} % "
            "of the steps from cell to cell go to the next one.",
            remedy="A photograph shows another pattern than it should, or something moved: check the delay between "
            "display and camera and that nothing moves, and take the photographs again.",
        )


def _steady_share(position_px: FloatImage, agreeing: Mask) -> float:
    """Of adjacent camera pixels in different cells, the share in adjacent cells."""
    crossings = jumps = 0
    cell = np.floor(np.where(agreeing, position_px, np.nan) / np.float32(CELL_PX))
    for axis in range(2):
        step = np.abs(np.diff(cell, axis=axis))
        crossings += int(np.count_nonzero(step > 0))
        jumps += int(np.count_nonzero(step > 1))
    return 1 - jumps / crossings if crossings else 1.0


def frame_margin_px(modulation: FloatImage) -> float:
    """How far from the outermost projector pixels' centres the phase can be trusted, projector px.

    Beyond the frame's border there is only black, which pulls the phase inwards as far as the blur reaches.
    ``modulation`` of the valid camera pixels, any shape.
    """
    typical = float(np.median(modulation)) if modulation.size else 1.0
    return max(0.5, 2.5 * float(np.sqrt(variance_of(typical))) - 0.5)


def variance_of(modulation: float) -> float:
    """Blur variance, projector px squared, that lowers the phase pattern's contrast to ``modulation``."""
    return -float(np.log(np.clip(modulation, 1e-3, 1.0))) * PERIOD_PX**2 / (2 * np.pi**2)


def _inside(position_px: FloatImage, size_px: tuple[int, int], margin_px: float) -> Mask:
    x, y = position_px[:, :, 0], position_px[:, :, 1]
    right, bottom = size_px[0] - 1 - margin_px, size_px[1] - 1 - margin_px
    return (x >= margin_px) & (x <= right) & (y >= margin_px) & (y <= bottom)
