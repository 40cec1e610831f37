"""Gray code and sinusoids to correspondences: where on the projector's image each camera pixel looks.

Gray-code cells of 12 px tell which period of the 24-px sinusoid a camera pixel is in, that sinusoid's phase which
fringe of the fine ones, and these where in it. Photographs are asked for one at a time and added up at once. With few
photographs, the code is in colours or a map from before stands for it (``patterns.Code``).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numba
import numpy as np
import numpy.typing as npt

from controller.core.arrays import FloatImage, Mask, array_in_file, strips
from controller.core.errors import CalibrationError
from controller.core.jit import compiled
from controller.optics.calibrate.correspondence.captures import Captures, grey, step_variance
from controller.optics.calibrate.correspondence.colour_alignment import ColourPlaces
from controller.optics.calibrate.correspondence.gray_code import check_size, read_code
from controller.optics.calibrate.correspondence.phase_shift import CODED, CONTRADICTED, FINE, WAVES, locate_pixel
from controller.optics.calibrate.correspondence.smoothing import correct_for_paint, fit_planes
from controller.optics.calibrate.values import Correspondence
from controller.optics.capture.patterns import BLUR_FREQUENCIES, CELL_PX, PERIOD_PX, PHASE_STEPS, PatternPlan
from controller.optics.capture.profile import CameraNoise

LEAST_MODULATION = 0.12
MOST_MODULATION = 1.4
DARKEST_SHARE = 0.004
"""Of the brightest amplitude (99th percentile): below it, light from elsewhere is stronger than the projector's own."""
WORST_NOISE_PX = 0.6
"""Noise of one camera pixel by the coarse phase alone; a fringe is 5 px wide."""
LEAST_CONSISTENT = 0.6
LEAST_STEADY = 0.75
SAME_PHASE_PX = 2.0
"""From a camera pixel to the next on one surface, apart from whole periods; by chance, a sixth of all edges."""
LEAST_UNCONTRADICTED = 0.5
WITHOUT_DIAGONAL = 0.7
"""The same where no diagonal phase helps to contradict: by chance, a wrong fine phase fits the coarse one in 56 %."""
BRIGHT_SHARE = 0.1
BRIGHT_SIGMAS = 2.0
"""Of one photograph's noise; the mean over a neighbourhood has a sixth of it, so none is bright by chance."""
NOISE_WINDOW = (7, 7)
CHANNELS = 3
FEWEST_PIXELS = 100
FINE_TO_COARSE = (BLUR_FREQUENCIES["x"][0] * PERIOD_PX) ** -2
"""A Gaussian blur that lowers the fine contrast to M lowers the coarse one to M to the power of this."""


@dataclass(frozen=True, slots=True)
class _Sums:
    """All sinusoids of a projector, added up.

    ``waves`` (10, rows, columns): cosine and sine amplitude of each of WAVES; ``mean`` (rows, columns) of the coarse
    ones' photographs; ``noise`` (rows, columns): standard deviation of one photograph around each pixel
    """

    waves: FloatImage
    mean: FloatImage
    noise: FloatImage


def decode(
    captures: Captures,
    plan: PatternPlan,
    *,
    camera_blur_px: float = 0.0,
    scratch: Path | None = None,
    known_px: FloatImage | None = None,
    noise: CameraNoise | None = None,
    colours: ColourPlaces | None = None,
) -> Correspondence:
    """Decode one projector's Gray-code and sinusoid captures.

    Each pixel is replaced by the plane through its neighbours on the same surface; pixels that are not on it, such as
    those that see two surfaces at once, are dropped.

    Parameters
    ----------
    captures : linear photographs by pattern name, (rows, columns) or (rows, columns, 3); needs ``black``, ``gray-*``,
        ``phase-*`` and ``blur-*``; each is asked for once and not kept. A plan with few: ``completed``, with ``white``
    camera_blur_px : standard deviation of the camera's own blur, camera px; where known, positions are freed of the
        pull towards the paler paint within a camera pixel's reach
    scratch : a folder on a disk, for the sums of a large camera (40 bytes a pixel), which then need not stay in memory
    known_px : (rows, columns, 2) a map from before, for a plan without code; it may be off by 8 px
    noise : of a camera sample, in the captures' unit, where the plan shows too few pictures to measure it
    colours : where the projector's colours lie apart; positions are then green's

    Returns
    -------
    Correspondence; nothing is valid where the projector casts no light, nor at the border of its frame. The modulation
    is that of the coarse sinusoid, worked out from the fine one's where that one can be seen. ``as_seen_px`` is there.

    Raises
    ------
    CalibrationError("capture-missing"), CalibrationError("capture-shape-wrong")
    CalibrationError("captures-inconsistent")  code and phases contradict each other: photographs in the wrong order
    CalibrationError("projector-size-wrong")
    """
    black = grey(captures, "black")
    noise = noise or CameraNoise()
    sums = _add_up(captures, plan, black.shape, scratch, noise)
    half = sums.mean - black
    sure, near = _near(captures, plan, sums.mean, half, known_px, noise)
    lit = _lit(sums, half)
    position = np.full((*black.shape, 2), np.nan, np.float32)
    modulation, state = np.zeros(black.shape, np.float32), np.zeros(black.shape, np.uint8)
    seen = lit | _bright(sums, half)
    # A dark pixel among bright ones can be as dark under the patterns as without them; its contrast has no meaning.
    usable = seen & sure & (half > 0)
    _locate(sums.waves, near[0], near[1], usable, half, sums.noise, position, modulation, state)
    _check_order(seen, lit, state, position, WITHOUT_DIAGONAL if plan.computed else LEAST_UNCONTRADICTED)
    valid = lit & ((state & CODED) > 0) & ((state & CONTRADICTED) == 0)
    del sums, near
    if colours is not None:
        position += colours.to_green_px()
    check_size(position[valid], plan.size_px)
    valid &= _inside(position, plan.size_px, 0.0)
    valid &= _inside(position, plan.size_px, frame_margin_px(modulation[valid]))
    as_seen = position
    if camera_blur_px > 0:
        position = correct_for_paint(position, valid, half, camera_blur_px**2)
    position, valid = fit_planes(position, valid)
    as_seen[~valid] = np.nan
    position[~valid] = np.nan
    return Correspondence(position, np.where(valid, modulation, 0).astype(np.float32), valid, as_seen)


def _near(
    captures: Captures,
    plan: PatternPlan,
    threshold: FloatImage,
    half: FloatImage,
    known_px: FloatImage | None,
    noise: CameraNoise,
) -> tuple[Mask, list[FloatImage]]:
    """Where the code is sure, and x and y px near which the phases have to be."""
    cells = list(read_code(captures, plan, threshold, half, known_px, noise))
    sure: Mask = cells[0].sure & cells[1].sure
    if known_px is not None:
        return sure, [np.ascontiguousarray(known_px[..., axis], np.float32) for axis in range(2)]
    # one after the other, so that a large camera's cells and their middles need not lie in memory together
    return sure, [cells.pop(0).middle_px() for _ in range(2)]


def _add_up(
    captures: Captures, plan: PatternPlan, shape: tuple[int, ...], scratch: Path | None, camera: CameraNoise
) -> _Sums:
    every = 2 * len(WAVES), *shape
    waves = np.zeros(every, np.float32) if scratch is None else array_in_file(scratch, every)
    waves.fill(0)
    first, total, square = (np.zeros(shape, np.float32) for _ in range(3))
    mean = np.zeros(shape, np.float32)
    for number, prefix in enumerate(WAVES):
        if not plan.measures_phase(prefix):
            continue
        light = np.zeros(shape, np.float32)
        steps = plan.sinusoids(prefix)
        for pattern in steps:
            image = grey(captures, pattern.name, shape)
            cosine, sine = np.cos(pattern.phase_rad), np.sin(pattern.phase_rad)
            _add(image, cosine, sine, len(steps), waves[2 * number], waves[2 * number + 1], light)
        if number == 0:
            first[:] = light
        if number < 2:
            mean += light / 2
        # every sinusoid has the same mean: what differs is noise
        if not plan.computed:
            _add_difference(light, first, total, square)
    if plan.computed:
        variance = CHANNELS * step_variance(np.asarray(mean / CHANNELS, np.float32), camera)
        return _Sums(waves, mean, np.asarray(np.sqrt(variance), np.float32))
    count = len(WAVES)
    variance = np.maximum(square - total * total / count, 0) * np.float32(PHASE_STEPS / (count - 1))
    noise = np.sqrt(np.maximum(cv2.boxFilter(variance, -1, NOISE_WINDOW), 0))
    return _Sums(waves, mean, np.asarray(noise, np.float32))


@compiled(parallel=True)
def _add(
    image: FloatImage, cosine: float, sine: float, steps: int, along: FloatImage, across: FloatImage, light: FloatImage
) -> None:
    a, b, one = np.float32(2 * cosine / steps), np.float32(2 * sine / steps), np.float32(1 / steps)
    for row in numba.prange(image.shape[0]):
        for column in range(image.shape[1]):
            value = image[row, column]
            along[row, column] += a * value
            across[row, column] += b * value
            light[row, column] += one * value


@compiled(parallel=True)
def _add_difference(light: FloatImage, first: FloatImage, total: FloatImage, square: FloatImage) -> None:
    for row in numba.prange(light.shape[0]):
        for column in range(light.shape[1]):
            difference = light[row, column] - first[row, column]
            if np.isfinite(difference):
                total[row, column] += difference
                square[row, column] += difference * difference


@compiled(parallel=True)
def _locate(
    waves: FloatImage,
    near_x: FloatImage,
    near_y: FloatImage,
    wanted: Mask,
    half: FloatImage,
    noise: FloatImage,
    position: FloatImage,
    modulation: FloatImage,
    state: npt.NDArray[np.uint8],
) -> None:
    rows, columns = wanted.shape
    for row in numba.prange(rows):
        work = np.zeros((5, 3))
        for column in range(columns):
            if not wanted[row, column]:
                continue
            x, y, light = near_x[row, column], near_y[row, column], half[row, column]
            outcome = locate_pixel(waves, row, column, x, y, light, noise[row, column], work)
            state[row, column] = outcome
            position[row, column, 0], position[row, column, 1] = work[0, 0], work[0, 1]
            fine = _contrast(waves, 4, row, column) / light
            # A pixel may have been found by the diagonal wave alone where one along an axis is saturated.
            if outcome & FINE and np.isfinite(fine):
                modulation[row, column] = min(fine, 1.0) ** FINE_TO_COARSE
            else:
                modulation[row, column] = _contrast(waves, 0, row, column) / light


@compiled()
def _contrast(waves: FloatImage, first: int, row: int, column: int) -> float:
    """Geometric mean of the amplitudes of two sinusoids, one along each axis; their parts begin at ``first``."""
    x = waves[first, row, column] ** 2 + waves[first + 1, row, column] ** 2
    y = waves[first + 2, row, column] ** 2 + waves[first + 3, row, column] ** 2
    return float((x * y) ** 0.25)


def _coarse_amplitude(sums: _Sums) -> FloatImage:
    """The smaller of both axes'."""
    axes = [np.hypot(sums.waves[2 * axis], sums.waves[2 * axis + 1]) for axis in range(2)]
    return np.asarray(np.minimum(axes[0], axes[1]), np.float32)


def _lit(sums: _Sums, half: FloatImage) -> Mask:
    """Where the sinusoids stand out of the noise and of stray light. NaN anywhere is not lit."""
    amplitude = _coarse_amplitude(sums)
    with np.errstate(invalid="ignore", divide="ignore"):
        noise_px = sums.noise / amplitude * np.float32(np.sqrt(2 / PHASE_STEPS) * PERIOD_PX / (2 * np.pi))
        lit = (amplitude > DARKEST_SHARE * _brightest(amplitude)) & (noise_px < WORST_NOISE_PX)
        return np.asarray(lit & (amplitude > LEAST_MODULATION * half) & (amplitude < MOST_MODULATION * half))


def _bright(sums: _Sums, half: FloatImage) -> Mask:
    """Where this projector plainly casts light, whether or not the phases make sense.

    Phases in the wrong order look like noise as strong as the pattern; real noise vanishes in a neighbourhood's mean.
    """
    around = 2 * cv2.boxFilter(np.nan_to_num(half), -1, NOISE_WINDOW)
    return np.asarray(
        (around > BRIGHT_SHARE * _brightest(2 * half)) & (around > BRIGHT_SIGMAS * sums.noise) & np.isfinite(half)
    )


def _brightest(image: FloatImage) -> float:
    finite = image[np.isfinite(image)]
    return float(np.percentile(finite[:: max(1, finite.size // 100_000)], 99)) if finite.size else 0.0


def _check_order(
    seen: Mask, lit: Mask, state: npt.NDArray[np.uint8], position: FloatImage, least_uncontradicted: float
) -> None:
    """Refuse captures that contradict each other: code against phase, fine phases against coarse, jumping codes."""
    pixels = int(np.count_nonzero(seen))
    if pixels < FEWEST_PIXELS:
        return
    agreeing = lit & ((state & CODED) > 0)
    agree = int(np.count_nonzero(agreeing))
    contradicted = int(np.count_nonzero(agreeing & ((state & CONTRADICTED) > 0)))
    share, uncontradicted = agree / pixels, 1 - contradicted / max(agree, 1)
    steady = min(_steady_share(position[:, :, axis], agreeing) for axis in range(2))
    if share < LEAST_CONSISTENT or steady < LEAST_STEADY or uncontradicted < least_uncontradicted:
        raise CalibrationError(
            "captures-inconsistent",
            what=f"The patterns do not agree: Gray code and phase match on {100 * share:.0f} % of the lit pixels, "
            f"coarse and fine phase on {100 * uncontradicted:.0f} %, neighbouring cells on {100 * steady:.0f} %.",
            remedy="Check that nothing moves and that the delay between display and camera is right. Then take the "
            "photographs again.",
        )


def _steady_share(position_px: FloatImage, agreeing: Mask) -> float:
    """Of adjacent camera pixels in different cells, the share in which the code is not wrong.

    A wrong code is off by whole periods, so that the phases continue as if it were right. From one surface to another
    in front of it, phases jump, too: that is no fault, however many edges an object has.
    """
    crossings = jumps = 0
    for rows in strips(len(position_px)):
        # and the row after them, for steps from row to row
        more = slice(rows.start, rows.stop + 1)
        place = np.where(agreeing[more], position_px[more], np.float32(np.nan))
        cell = np.floor(place / np.float32(CELL_PX))
        for axis, here in ((0, slice(None)), (1, slice(rows.stop - rows.start))):
            step, away = np.abs(np.diff(cell[here], axis=axis)), np.diff(place[here], axis=axis)
            goes_on = np.abs(away - PERIOD_PX * np.round(away / PERIOD_PX)) < SAME_PHASE_PX
            crossings += int(np.count_nonzero(step > 0))
            jumps += int(np.count_nonzero((step > 1) & goes_on))
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
