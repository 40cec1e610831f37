"""Checks of a RAW camera: black level, true exposure ratios, limit of linearity, bad samples."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from controller.core.arrays import Float64, Mask
from controller.core.errors import TroubleCode
from controller.optics.capture.demosaic import SensorLevels

WELL_LIT = (0.2, 0.7)
"""Shares of full scale between which a ratio of exposures is taken: above noise, below every limit."""
BINS = 40
FEWEST = 200
FEWEST_IN_BIN = 40
GLARING, GLARE_PX = 0.8, 5
BENDS_FROM = 0.4
"""Of full scale: no sensor becomes nonlinear below this; a deviation there means that something moved or flickered."""
FEWEST_BENT = 2
TOLERANCE = 0.01
"""A level counts as linear while the median of its samples is within 1 % of what the shorter exposure predicts."""
PILED = 1.15
"""Samples whose prediction exceeds full scale by this factor are surely saturated; they show the ceiling."""
HOT_SIGMAS = 12.0
SMALLEST_CORRECTION = 0.015
"""Spread of the corrections of an exposure series from which the camera's exposure times are corrected."""
UNSTEADY, AS_RATIOS = 0.01, 4
"""Standard deviation by which a lamp is expected to change a ratio of two exposures, and how many measured ratios that
counts as much as."""
CHANCE = 0.01
"""Probability up to which an unsteady lamp alone explains the ratios, and nothing is corrected."""
NAMED_SPREAD = 0.003
"""Standard deviation of the pixels' response, relative, from which it is named; even sensors have 0.001 at most."""
NAMED_HOT = 5e-5
"""Share of all samples: a sound sensor has fewer hot ones."""
_KNOWN = (
    "Calibration takes that into account; nothing has to be done. If it grows from one calibration to the next, let "
    "the camera cool down, or replace it."
)
WORST_BLACK_STEPS = 64.0
"""A black level farther from the file's value than this is not the camera's; the light changed in between."""

Samples = npt.NDArray[np.uint16]


@dataclass(frozen=True, slots=True)
class RawExposure:
    """Raw ``samples`` (rows, columns) uint16 of a picture, and the ``exposure_s`` that the camera reported."""

    samples: Samples
    exposure_s: float


@dataclass(frozen=True, slots=True)
class SensorLinearity:
    """How a bracket series fits a linear camera.

    ``ratios`` measured exposure of each photograph relative to the first; ``nominal`` as the camera reported them
    ``clip`` (2, 2) raw value from which a site is saturated or no longer linear, inf where no sample came near
    ``worst`` largest relative deviation from linearity at the levels below ``clip``
    """

    ratios: tuple[float, ...]
    nominal: tuple[float, ...]
    clip: Float64
    worst: float


def check_series(series: Sequence[RawExposure], levels: SensorLevels) -> SensorLinearity:
    """Compare the photographs of one still picture, exposure by exposure.

    Each longer exposure should be the next shorter one times one ratio at every level. The ratio is measured where
    both are well exposed; the level from which the longer falls behind is the sensor's limit. Two equal exposures
    give no information.

    Parameters
    ----------
    series : of one picture, in any order; ``levels`` as the files state them (``clip`` is not used)
    """
    ordered = sorted(series, key=lambda one: one.exposure_s)
    ratios, nominal = [1.0], [1.0]
    limits: list[Float64] = []
    worst = 0.0
    for shorter, longer in itertools.pairwise(ordered):
        reported = longer.exposure_s / shorter.exposure_s
        ratio = exposure_ratio(shorter, longer, levels)
        ratios.append(ratios[-1] * ratio)
        nominal.append(nominal[-1] * reported)
        if reported <= 1:
            continue
        limit, deviation = _limits(shorter, longer, levels, ratio)
        limits.append(limit)
        worst = max(worst, deviation)
    return SensorLinearity(tuple(ratios), tuple(nominal), common_limit(limits), worst)


def common_limit(limits: Sequence[Float64]) -> Float64:
    """(2, 2) limit of each site from several measurements, inf where none found one.

    The highest: a sensor's limit is the same every time, and what something else made look like one is lower.
    """
    lowest = np.stack([np.full((2, 2), -np.inf), *(np.where(np.isfinite(one), one, -np.inf) for one in limits)])
    highest = lowest.max(axis=0)
    return np.where(np.isfinite(highest), highest, np.inf)


def exposure_ratio(shorter: RawExposure, longer: RawExposure, levels: SensorLevels) -> float:
    """Light of ``longer`` over that of ``shorter``, measured; as reported where no sample is well exposed in both."""
    reported = longer.exposure_s / shorter.exposure_s
    tops, bottoms = 0.0, 0.0
    for row, column in np.ndindex(2, 2):
        x, y = (_site(one, levels, row, column) for one in (shorter, longer))
        # A clipped sample's neighbours may hold some of its light (glare, or a picture that was made smaller).
        good = (y > WELL_LIT[0]) & (y < WELL_LIT[1]) & (x > 0) & ~_near(y > GLARING)
        if np.count_nonzero(good) < FEWEST:
            continue
        # Samples at an edge or a highlight that something moved are left out; then the ratio of the sums.
        each = y[good] / x[good]
        off = np.abs(each / np.median(each) - 1)
        near = off < max(3 * 1.4826 * float(np.median(off)), TOLERANCE)
        tops += float(y[good][near].sum(dtype=np.float64))
        bottoms += float(x[good][near].sum(dtype=np.float64))
    return tops / bottoms if bottoms > 0 else reported


def _site(one: RawExposure, levels: SensorLevels, row: int, column: int) -> npt.NDArray[np.float32]:
    black, white = levels.black[row, column], levels.white[row, column]
    site = one.samples[row::2, column::2].astype(np.float32)
    return np.asarray((site - np.float32(black)) / np.float32(white - black))


def true_exposures(measured: Sequence[tuple[Sequence[float], Sequence[float]]]) -> Float64:
    """(n, 2) reported and true exposures in seconds, where the camera reports noticeably wrong ones; empty elsewhere.

    Cameras round: one that reports 1/30 s opens for 1/32 s. Each series gives the ratios of its exposures; together
    they are solved for the corrections that are smallest on the whole, since no photograph shows absolute time.
    A lamp that is not steady changes ratios, too; by how much, the ratios show that were measured more than once. What
    it alone could explain is not corrected.

    Parameters
    ----------
    measured : for each series its reported exposures, rising, and their measured ratios to the first
    """
    reported = sorted({value for exposures, _ in measured for value in exposures})
    if len(reported) < 2:
        return np.empty((0, 2))
    rows, values = [], []
    for exposures, ratios in measured:
        for (a, b), (x, y) in zip(itertools.pairwise(exposures), itertools.pairwise(ratios), strict=True):
            row = np.zeros(len(reported))
            row[reported.index(b)] += 1
            row[reported.index(a)] -= 1
            rows.append(row)
            values.append(np.log(y / x) - np.log(b / a))
    correction, _, rank, _ = np.linalg.lstsq(np.array(rows), np.array(values), rcond=None)
    if np.ptp(correction) < SMALLEST_CORRECTION or _by_chance(np.array(rows) @ correction, np.array(values), rank):
        return np.empty((0, 2))
    return np.stack((np.array(reported), np.array(reported) * np.exp(correction)), axis=1)


def _by_chance(explained: Float64, measured: Float64, parameters: int) -> bool:
    """Whether a lamp that is not steady could alone have made the ratios ``measured`` (n,), logarithms.

    ``explained`` (n,): what wrong exposure times make of them, with so many ``parameters``.
    """
    from scipy.special import chdtri

    left = float(np.sum((measured - explained) ** 2))
    variance = (AS_RATIOS * UNSTEADY**2 + left) / (AS_RATIOS + len(measured) - parameters)
    return bool(np.sum(explained**2) < chdtri(parameters, CHANCE) * variance)


def camera_faults(exposures: Float64, hot: int, samples: int, spread: float = 0.0) -> Mapping[TroubleCode, str]:
    """What a technician should know of ``true_exposures``, of ``hot`` of all samples, and of ``response_spread``."""
    faults = {}
    if len(exposures):
        off = float(np.ptp(np.log(exposures[:, 1] / exposures[:, 0])))
        faults[TroubleCode.EXPOSURE_TIMES] = (
            "Exposure times of the camera differ from what it reports, "
            f"by {100 * off:.1f} % between two of them. {_KNOWN}"
        )
    if hot > NAMED_HOT * samples:
        faults[TroubleCode.HOT_PIXELS] = f"{hot} pixels of the camera are hot. {_KNOWN}"
    if spread > NAMED_SPREAD:
        faults[TroubleCode.PIXEL_RESPONSE] = (
            f"The response of the camera's pixels differs by {100 * spread:.1f} % (standard deviation). {_KNOWN}"
        )
    return faults


def _limits(shorter: RawExposure, longer: RawExposure, levels: SensorLevels, ratio: float) -> tuple[Float64, float]:
    limits, worst = np.full((2, 2), np.inf), 0.0
    for row, column in np.ndindex(2, 2):
        x, y = (_site(one, levels, row, column) for one in (shorter, longer))
        alone = ~_near(y > 0.98 * float(y.max()))
        limit, deviation = _limit(x.ravel() * np.float32(ratio), y.ravel(), alone.ravel())
        worst = max(worst, deviation)
        if limit is not None:
            black, white = levels.black[row, column], levels.white[row, column]
            limits[row, column] = black + limit * (white - black)
    return limits, worst


def _near(chosen: Mask) -> Mask:
    """The samples chosen, and those round them, which may hold some of their light."""
    spread: Mask = cv2.dilate(chosen.astype(np.uint8), np.ones((GLARE_PX, GLARE_PX), np.uint8)) > 0
    return spread


def _limit(
    predicted: npt.NDArray[np.float32], seen: npt.NDArray[np.float32], alone: Mask
) -> tuple[float | None, float]:
    """Of one site: the level from which it is not linear (None: none found), and the largest deviation below it.

    ``alone``: samples without a clipped one near.
    """
    ceiling = None
    certain = seen[predicted > PILED * max(1.0, float(np.percentile(seen, 99.99)))]
    if certain.size >= FEWEST:
        # Noise spreads a ceiling that lies below the converter's own; its low end is where trust ends.
        ceiling = float(np.percentile(certain, 1))
    bins = _deviations(predicted[alone], seen[alone], ceiling if ceiling is not None else np.inf)
    # Falling behind means: from some level in the upper half on, and all the way up. Anything else is no ceiling.
    behind = list(itertools.takewhile(lambda one: one[1] < -TOLERANCE and one[0] >= BENDS_FROM, reversed(bins)))
    bent = behind[-1][0] if len(behind) >= FEWEST_BENT else None
    worst = max((abs(deviation) for level, deviation in bins if bent is None or level < bent), default=0.0)
    levels = [level for level in (ceiling, bent) if level is not None]
    return (min(levels) * (1 - TOLERANCE / 2) if levels else None), worst


def _deviations(
    predicted: npt.NDArray[np.float32], seen: npt.NDArray[np.float32], top: float
) -> list[tuple[float, float]]:
    """Lower edge of each well-filled bin of predicted levels below ``top``, rising, and how far its samples deviate."""
    edges = np.linspace(WELL_LIT[0], 1.0, BINS + 1)
    which = np.digitize(predicted, edges)
    counts = np.bincount(which, minlength=BINS + 1)
    light, expected = (np.bincount(which, one, BINS + 1) for one in (seen, predicted))
    return [
        (float(edges[number - 1]), float(light[number] / expected[number]) - 1)
        for number in range(1, BINS + 1)
        if edges[number] <= 0.995 * top and counts[number] >= FEWEST_IN_BIN
    ]


def black_offset(series: Sequence[RawExposure], levels: SensorLevels) -> Float64:
    """(2, 2) raw steps by which the black level lies above the file's value: a line through the exposures at 0 s.

    ``series``: a dark picture at two exposures or more. Without two different ones, and where the result is no
    camera's, zeros: the file is then believed.
    """
    ordered = sorted(series, key=lambda one: one.exposure_s)
    offset = np.zeros((2, 2))
    if len(ordered) < 2 or ordered[-1].exposure_s < 1.5 * ordered[0].exposure_s:
        return offset
    short, long = ordered[0], ordered[-1]
    for row, column in np.ndindex(2, 2):
        x = short.samples[row::2, column::2].astype(np.float64)
        y = long.samples[row::2, column::2].astype(np.float64)
        unclipped = y < 0.5 * levels.white[row, column]
        if np.count_nonzero(unclipped) < FEWEST:
            return np.zeros((2, 2))
        zero = (long.exposure_s * x - short.exposure_s * y)[unclipped] / (long.exposure_s - short.exposure_s)
        low, high = np.percentile(zero, (1, 99))
        inside = zero[(zero >= low) & (zero <= high)]
        offset[row, column] = float(inside.mean()) - levels.black[row, column]
    return offset if np.abs(offset).max() <= WORST_BLACK_STEPS else np.zeros((2, 2))


def find_hot(series: Sequence[RawExposure], levels: SensorLevels) -> npt.NDArray[np.int64]:
    """(n, 2) column and row of samples that stand far out of their neighbours in every one of the dark photographs.

    Compared with the median of the eight nearest samples of the same site, in units of the photograph's own spread.
    A highlight stands out too, but not alone in its 5x5 samples; a sample at an edge is near one of its neighbours.
    """
    if not series:
        return np.empty((0, 2), np.int64)
    hot = np.logical_and.reduce([_outliers(one.samples, levels) for one in series])
    rows, columns = np.nonzero(hot)
    return np.stack((columns, rows), axis=1).astype(np.int64)


def _outliers(samples: Samples, levels: SensorLevels) -> npt.NDArray[np.bool_]:
    """Above the brightest of the eight neighbours of its own site, and above their median by many deviations."""
    outliers = np.zeros(samples.shape, np.bool_)
    ring = np.ones((3, 3), np.uint8)
    ring[1, 1] = 0
    for row, column in np.ndindex(2, 2):
        site = np.ascontiguousarray(samples[row::2, column::2])
        brightest = cv2.dilate(site, ring).astype(np.float32)
        middle = cv2.medianBlur(site, 3).astype(np.float32)
        above = site.astype(np.float32) - middle
        spread = max(1.4826 * float(np.median(np.abs(above))), 1.0)
        shot = np.sqrt(np.maximum(middle - np.float32(levels.black[row, column]), 0))
        threshold = np.float32(HOT_SIGMAS) * (np.float32(spread) + shot)
        outliers[row::2, column::2] = (above > threshold) & (site > brightest + 0.5 * threshold)
    return outliers
