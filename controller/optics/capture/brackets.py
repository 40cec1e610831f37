"""Exposures: which to take, and several of them merged into one linear image without a ceiling (HDR)."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from numbers import Real

import numba
import numpy as np

from controller.core import channels
from controller.core.arrays import FloatImage, Mask, strips
from controller.core.errors import UsageError
from controller.core.jit import compiled
from controller.optics.capture.profile import CameraNoise

TARGET = 0.75
"""Of full scale, for the brightest lit pixels of a pattern: bright enough, with room for the lamp's flicker."""
BRIGHT_PERCENTILE = 99.5
LIT_SHARE = 0.05
TOO_DARK = 0.1
"""Below this level a percentile is dominated by noise."""
BRIGHTEST_MINIMUM = 0.4
"""Of full scale: with very much noise, what an exposure measures well begins here at the latest."""
DARK_SHARE = 0.01
"""Of the brightest: darker pixels are hardly lit, and their noise hardly matters."""
DARK_PERCENTILE = 2
RELATIVE_NOISE = 0.02
"""Of one sample; a metapixel is a mean of many samples."""
BEFORE_CLIPPING = 0.9
"""Of full scale: up to this level a longer exposure is surely not clipped."""
FEWEST_WHITES = 2
"""One exposure alone would not show the camera's noise, or whether it is linear."""
FLICKER = 0.02
"""A longer exposure may show this share less than shorter ones: lamps are not steady."""
SPREADS = 6.0
"""Standard deviations by which a longer exposure may be below what shorter ones predict.

Noise alone must never exceed it: what is then left is a short exposure that is too bright by chance, often many times.
"""
SPREADS_IF_SURE, SURE = 2.5, 0.05
"""Standard deviations where shorter exposures predict a sample with a smaller relative spread: chance does no harm."""
AT_ONCE = 1 << 18
"""Samples of each image that are merged in one go."""
ROUNDED = 1 / 255 / math.sqrt(12)
"""Of full scale: the error of a sample of 8 bits, the least where nothing is known of the camera's noise."""
DARK_LEVEL = 0.25
"""Of full scale: below it, the mean of a sample and three neighbours holds no clipped light."""
LEVELS = ((0.03, DARK_LEVEL), (0.3, 0.5), (0.5, 0.7), (0.7, 0.9))
SOME_SAMPLES, FEWEST_SAMPLES = 200_000, 200


@dataclass(frozen=True, slots=True)
class MergedBracket:
    """``radiance`` (rows, columns, 3) float32 full-scale value per second, NaN where no exposure measured it.

    ``sigma`` (rows, columns, 3) float32: its standard deviation by the noise model.
    """

    radiance: FloatImage
    sigma: FloatImage


def merge_brackets(
    images: Sequence[FloatImage], exposures_s: Sequence[float], *, noise: CameraNoise | None = None
) -> MergedBracket:
    """Merge exposures of one still scene, each weighted by the inverse of its variance.

    The variance is taken from a first estimate of the radiance and not from each value itself: a value that noise
    made small would otherwise get more weight, and the mean would be too dark.

    A sample that is darker than shorter exposures predict, by more than noise can explain, does not count. It is
    clipped, or mixed with clipped neighbours by a picture that was made smaller, and does not say so: the longest
    exposure has the most weight.

    Parameters
    ----------
    images : (rows, columns, 3) float32, 0 at black and 1 at full scale, NaN where saturated
    exposures_s : of each image, > 0
    noise : the camera's; without it, as the exposures themselves show it

    Raises UsageError("bracket-mismatch").
    """
    if not images or len(images) != len(exposures_s) or len({image.shape for image in images}) != 1:
        raise UsageError(
            "bracket-mismatch",
            what="The photographs of a bracket differ in size, or their number differs from the number of exposures.",
            remedy="Give one exposure time for each photograph, and use photographs of one size.",
        )
    if not all(is_time(one) for one in exposures_s):
        raise UsageError(
            "bracket-mismatch",
            what="An exposure time is not a number above zero.",
            remedy="Give exposure times in seconds, for example 0.04 for 1/25.",
        )
    noise = noise or _noise_of(images, exposures_s)
    flat = [np.ascontiguousarray(image, np.float32).reshape(-1) for image in images]
    radiance, sigma = np.empty_like(flat[0]), np.empty_like(flat[0])
    # a part at a time, which stays in the cache
    for part in strips(len(radiance), AT_ONCE):
        _merge([image[part] for image in flat], exposures_s, noise, radiance[part], sigma[part])
    return MergedBracket(radiance.reshape(images[0].shape), sigma.reshape(images[0].shape))


def is_time(value: object) -> bool:
    """Whether a value is an exposure time in seconds: a finite number above 0."""
    return isinstance(value, Real) and not isinstance(value, bool) and 0 < float(value) < math.inf


def _noise_of(images: Sequence[FloatImage], exposures_s: Sequence[float]) -> CameraNoise:
    """As neighbouring exposures show it; no less than a good camera's, rounded to 8 bits.

    A shorter exposure a is q times the longer b, and their difference's variance q (1 + q) b shot + (1 + q^2) read^2.
    Clipped light that does not say so makes b too small, and black makes a too large: above the middle only the spread
    below it counts, and in the dark only that above it.
    """
    read, shot = math.inf, math.inf
    rising = sorted(range(len(images)), key=lambda n: exposures_s[n])
    for first, second in itertools.pairwise(rising):
        q = exposures_s[first] / exposures_s[second]
        a, b = (images[n].reshape(-1)[:: max(1, images[n].size // SOME_SAMPLES)] for n in (first, second))
        for low, high in LEVELS:
            off = (a - np.float32(q) * b)[(b > low) & (b < high) & np.isfinite(a)]
            if off.size < FEWEST_SAMPLES:
                continue
            below, middle, above = np.percentile(off, (15.87, 50, 84.13))
            if low < DARK_LEVEL:
                read = min(read, float(above - middle) / math.hypot(1, q))
            else:
                left = (middle - below) ** 2 - (1 + q * q) * min(read, middle - below) ** 2
                shot = min(shot, float(left) / (q * (1 + q) * low))
    least = CameraNoise()
    read = max(read if math.isfinite(read) else 0.0, math.hypot(least.read, ROUNDED))
    return CameraNoise(max(shot if math.isfinite(shot) else 0.0, least.shot), read)


def _merge(
    images: Sequence[FloatImage],
    exposures_s: Sequence[float],
    noise: CameraNoise,
    radiance: FloatImage,
    sigma: FloatImage,
) -> None:
    """Fill ``radiance`` and ``sigma`` for some samples (samples,) of each image."""
    counting = _counting(images, exposures_s, noise)
    estimate, _ = _weighted(images, exposures_s, counting, np.zeros_like(radiance), noise)
    radiance[:], weight = _weighted(images, exposures_s, counting, np.maximum(np.nan_to_num(estimate), 0), noise)
    with np.errstate(divide="ignore"):
        sigma[:] = np.where(weight > 0, 1 / np.sqrt(weight), np.float32(np.nan))


def _counting(images: Sequence[FloatImage], exposures_s: Sequence[float], noise: CameraNoise) -> list[Mask]:
    """Which samples of each image count: measured, and not clearly below what shorter exposures predict."""
    still = np.float32(noise.read**2)
    counting = [np.zeros(image.shape, np.bool_) for image in images]
    total, weights = np.zeros_like(images[0]), np.zeros_like(images[0])
    for n in sorted(range(len(images)), key=lambda n: exposures_s[n]):
        _count(images[n], np.float32(exposures_s[n]), np.float32(noise.shot), still, total, weights, counting[n])
    return counting


@compiled(parallel=True)
def _count(
    image: FloatImage,
    seconds: np.float32,
    shot: np.float32,
    still: np.float32,
    total: FloatImage,
    weights: FloatImage,
    counts: Mask,
) -> None:
    """One image of ``_counting``; ``total`` and ``weights`` hold the shorter exposures, and then this one, too."""
    below = np.float32(1) - np.float32(FLICKER)
    for k in numba.prange(image.size):
        value, weight = image[k], weights[k]
        good = bool(np.isfinite(value))
        if good and weight > 0:
            # with weights of t^2, the shorter exposures together are as one of sqrt(sum t^2) seconds
            longer, predicted = seconds / np.sqrt(weight), total[k] / weight * seconds
            light = shot * max(predicted, np.float32(0))
            spread = np.sqrt((light / longer + still) * (longer * longer) + light + still)
            spreads = SPREADS_IF_SURE if spread < np.float32(SURE) * predicted else SPREADS
            good = not value < below * predicted - np.float32(spreads) * spread
        counts[k] = good
        if good:
            total[k] += value * seconds
            weights[k] += seconds * seconds


def _weighted(
    images: Sequence[FloatImage],
    exposures_s: Sequence[float],
    counting: Sequence[Mask],
    radiance: FloatImage,
    noise: CameraNoise,
) -> tuple[FloatImage, FloatImage]:
    """The mean by the variances that ``radiance`` has, NaN where nothing counts, and the sum of the weights."""
    total, weights = np.zeros_like(images[0]), np.zeros_like(images[0])
    shot, read = np.float32(noise.shot), np.float32(noise.read**2)
    for image, exposure_s, counts in zip(images, exposures_s, counting, strict=True):
        seconds, square = np.float32(exposure_s), np.float32(exposure_s**2)
        _weigh(image, counts, radiance, seconds, square, shot, read, total, weights)
    with np.errstate(invalid="ignore"):
        total /= weights  # 0 / 0 where nothing counts
    return total, weights


@compiled(parallel=True)
def _weigh(
    image: FloatImage,
    counts: Mask,
    radiance: FloatImage,
    seconds: np.float32,
    square: np.float32,
    shot: np.float32,
    read: np.float32,
    total: FloatImage,
    weights: FloatImage,
) -> None:
    """Add one image of ``_weighted``."""
    for k in numba.prange(image.size):
        if counts[k]:
            weight = square / (shot * (radiance[k] * seconds) + read)
            total[k] += weight * image[k] / seconds
            weights[k] += weight


@dataclass(frozen=True, slots=True)
class ExposureChoice:
    """``exposure_s`` to use; ``settled`` False: take one photograph with it and choose again."""

    exposure_s: float
    settled: bool


def choose_exposure(
    image: FloatImage, exposure_s: float, available_s: Sequence[float], *, lit: Mask | None = None
) -> ExposureChoice:
    """The exposure at which white's brightest lit pixels reach ``TARGET`` of full scale and none much more.

    Parameters
    ----------
    image : (rows, columns, 3) of white at ``exposure_s``, full scale, NaN where saturated
    available_s : what the camera has
    lit : pixels to look at; without it, those above 5 % of the brightest

    Returns
    -------
    the longest available exposure that keeps the 99.5th percentile below ``TARGET`` plus 7 %, settled when the image
    shows that percentile unsaturated and not lost in noise
    """
    exposures = _ascending(available_s)
    brightest = _brightest(image, lit)
    if brightest is None:
        return ExposureChoice(_at_most(exposures, exposure_s / 8), exposure_s <= exposures[0])
    if brightest < TOO_DARK:
        longer = _at_most(exposures, exposure_s * min(16.0, 0.5 / max(brightest, 1e-3)))
        return ExposureChoice(longer, longer <= exposure_s)
    return ExposureChoice(_at_most(exposures, exposure_s * TARGET * 1.07 / brightest), True)


@dataclass(frozen=True, slots=True)
class BracketChoice:
    """``exposures_s`` rising; ``settled`` False: take the one exposure given and choose again."""

    exposures_s: tuple[float, ...]
    settled: bool


def minimum_level(noise: CameraNoise) -> float:
    """The full-scale value from which noise is below ``RELATIVE_NOISE`` r of it: (r v)^2 = shot v + read^2."""
    root = math.sqrt(noise.shot**2 + 4 * RELATIVE_NOISE**2 * noise.read**2)
    return (noise.shot + root) / (2 * RELATIVE_NOISE**2)


def choose_brackets(
    image: FloatImage,
    exposure_s: float,
    available_s: Sequence[float],
    *,
    lit: Mask | None = None,
    most: int = 4,
    noise: CameraNoise | None = None,
) -> BracketChoice:
    """As few exposures as measure the brightest lit pixels unsaturated and the darkest well above noise; two at least.

    The bright end is measured in ``image``, which is as in ``choose_exposure``. The dark end is the 2nd percentile of
    the pixels above 1 % of the brightest (of those in ``lit``): the longest exposure brings it to ``minimum_level``.
    Neighbours are as far apart as they may be: what is just clipped in one has to be at ``minimum_level`` in the one
    before. With a 12-bit camera that is a factor of ten, and two exposures span almost two decades of light.
    """
    noise = noise or CameraNoise()
    # the patterns' exposure, whose true time the ratios of the bracket then tell
    first = choose_exposure(image, exposure_s, available_s, lit=lit)
    if not first.settled:
        return BracketChoice((first.exposure_s,), False)
    exposures = _ascending(available_s)
    level = min(minimum_level(noise), BRIGHTEST_MINIMUM)
    dark = _darkest(image, lit)
    needed = level * exposure_s / max(dark, 1e-5) / first.exposure_s
    step = BEFORE_CLIPPING / level
    count = 1 if needed <= 1 else 1 + math.ceil(math.log(needed) / math.log(step) - 1e-6)
    count = max(min(count, most), min(FEWEST_WHITES, most))
    each = min(max(needed ** (1 / max(count - 1, 1)), 2.0), step)
    taken = [first.exposure_s]
    while len(taken) < count and taken[-1] < exposures[-1]:
        taken.append(max(_at_most(exposures, taken[-1] * each), _next(exposures, taken[-1])))
    return BracketChoice(tuple(taken), True)


def _darkest(image: FloatImage, lit: Mask | None) -> float:
    """2nd percentile of the grey of what is lit, in ``image``'s full scale."""
    finite = np.where(np.isfinite(image), image, 1.0)
    strongest, grey = channels.largest(finite), channels.mean(finite)
    chosen = lit if lit is not None else strongest > DARK_SHARE * max(_brightest(image, None) or 1.0, 1e-6)
    return float(np.percentile(grey[chosen], DARK_PERCENTILE)) if np.any(chosen) else 1.0


def _ascending(available_s: Sequence[float]) -> list[float]:
    exposures = sorted(float(exposure) for exposure in available_s if exposure > 0)
    if not exposures:
        raise UsageError(
            "no-exposures",
            what="The camera reports no exposure times.",
            remedy="Set the camera to manual exposure and connect it again.",
        )
    return exposures


def _at_most(exposures: list[float], wanted_s: float) -> float:
    return max((exposure for exposure in exposures if exposure <= wanted_s * 1.001), default=exposures[0])


def _next(exposures: list[float], exposure_s: float) -> float:
    return min((exposure for exposure in exposures if exposure > exposure_s), default=exposures[-1])


def _brightest(image: FloatImage, lit: Mask | None) -> float | None:
    """99.5th percentile of the lit pixels' strongest channel; None when it is saturated."""
    strongest = channels.largest(np.where(np.isfinite(image), image, np.inf))
    if lit is not None:
        strongest = strongest[lit]
    finite = strongest[np.isfinite(strongest)]
    if not finite.size:
        return None if strongest.size else 0.0
    if lit is None:
        strongest = strongest[strongest > LIT_SHARE * np.percentile(finite, 99.9)]
    if not strongest.size:
        return 0.0
    value = float(np.percentile(strongest, BRIGHT_PERCENTILE, method="higher"))
    return value if np.isfinite(value) else None
