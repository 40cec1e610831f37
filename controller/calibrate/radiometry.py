"""A projector's response and colour mixing from flat pictures (idea of Raij 2003), and whether the camera is linear."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import PchipInterpolator

from controller.arrays import Float64, FloatImage, Mask
from controller.calibrate.captures import Captures, coloured
from controller.calibrate.values import Radiometry
from controller.errors import CalibrationError

PRIMARIES = ("red", "green", "blue")
LIT_SHARE = 0.15
"""Of the 99th percentile of white, in every camera channel: darker pixels add noise and stray light."""
FEWEST_PIXELS = 50
FEWEST_LEVELS = 4
MOST_PIXELS = 200_000
WORST_ADDITIVITY = 0.08


@dataclass(frozen=True, slots=True)
class RadiometryReport:
    """What the measurement was worth.

    ``pixels`` used; ``additivity`` largest relative difference between white and red + green + blue over the camera's
    channels; ``scatter`` median absolute deviation of the ramp's ratios between pixels, of full scale
    """

    pixels: int
    additivity: float
    scatter: float


def measure_radiometry(captures: Captures) -> tuple[Radiometry, RadiometryReport]:
    """Response and mixing of one projector.

    Parameters
    ----------
    captures : linear RGB photographs in one unit: ``black white red green blue`` and ``ramp-NNN`` with NNN the
        device value, at least four of them; NaN where saturated

    Returns
    -------
    the radiometry, and a report on the measurement

    Raises
    ------
    CalibrationError("capture-missing"), CalibrationError("capture-shape-wrong")
    CalibrationError("projector-dark")  too few pixels are lit by this projector
    CalibrationError("colours-do-not-add")  white is not the sum of red, green and blue
    CalibrationError("colours-alike")  the primaries can't be told apart
    CalibrationError("response-falls")  a higher value gives less light by far more than noise
    """
    black = coloured(captures, "black")
    white = coloured(captures, "white", black.shape[:2]) - black
    lit = _lit(white)
    black_lit, white_lit = black[lit], white[lit]
    columns = [_ratio(captures, name, lit, black_lit, white_lit)[0] for name in PRIMARIES]
    mixing, additivity = _mixing(np.stack(columns, axis=1))
    levels = ramp_levels(captures)
    light, scatter = np.empty((len(levels), 3)), 0.0
    for index, level in enumerate(levels):
        seen, spread = _ratio(captures, f"ramp-{level:03d}", lit, black_lit, white_lit)
        light[index] = np.linalg.solve(mixing, seen)
        scatter = max(scatter, spread)
    response = np.stack([response_curve(np.array(levels), light[:, channel]) for channel in range(3)])
    return Radiometry(response, mixing), RadiometryReport(len(white_lit), additivity, scatter)


def ramp_levels(captures: Captures) -> list[int]:
    """Device values of the ramp among the captures' names, rising. CalibrationError("capture-missing") below four."""
    levels = sorted(int(name[5:]) for name in captures if re.fullmatch(r"ramp-\d{3}", name))
    levels = [level for level in levels if 0 < level < 255]
    if len(levels) < FEWEST_LEVELS:
        raise CalibrationError(
            "capture-missing",
            what=f"Only {len(levels)} photographs of the grey ramp are there; {FEWEST_LEVELS} are needed.",
            remedy="Start the calibration again; it takes only the photographs that are missing.",
        )
    return levels


def _lit(white: FloatImage) -> Mask:
    bright = np.nanpercentile(white, 99, axis=(0, 1)) if np.isfinite(white).any() else np.zeros(3)
    lit = np.all(white > LIT_SHARE * bright, axis=2) & np.all(bright > 0)
    pixels = int(np.count_nonzero(lit))
    if pixels < FEWEST_PIXELS:
        raise CalibrationError(
            "projector-dark",
            what=f"Only {pixels} camera pixels see this projector's white.",
            remedy="Check that its lamp is lit, its shutter open and its picture on the object, then calibrate again.",
        )
    every = -(-pixels // MOST_PIXELS)
    chosen = np.zeros(lit.size, np.bool_)
    chosen[np.flatnonzero(lit)[::every]] = True
    return chosen.reshape(lit.shape)


def _ratio(captures: Captures, name: str, lit: Mask, black: FloatImage, white: FloatImage) -> tuple[Float64, float]:
    """(3,) light of a flat picture per camera channel, white being 1, and how much the pixels differ."""
    seen = coloured(captures, name, lit.shape)[lit] - black
    ratios, spreads = np.zeros(3), np.zeros(3)
    for channel in range(3):
        finite = np.isfinite(seen[:, channel]) & np.isfinite(white[:, channel])
        of, over = seen[finite, channel].astype(np.float64), white[finite, channel].astype(np.float64)
        if of.size < FEWEST_PIXELS:
            raise CalibrationError(
                "projector-dark",
                what=f"Too few camera pixels measured pattern {name}.",
                remedy="Choose an exposure at which white is not saturated, and calibrate again.",
            )
        ratio = of / over
        middle = np.median(ratio)
        spreads[channel] = 1.4826 * np.median(np.abs(ratio - middle))
        kept = np.abs(ratio - middle) <= 3 * spreads[channel] + 1e-9
        # shot noise grows with the light: the plain ratio of sums is then the best weighting
        ratios[channel] = of[kept].sum() / over[kept].sum()
    return ratios, float(spreads.max())


def _mixing(columns: Float64) -> tuple[Float64, float]:
    sums = columns.sum(axis=1)
    additivity = float(np.max(np.abs(sums - 1)))
    if additivity > WORST_ADDITIVITY:
        raise CalibrationError(
            "colours-do-not-add",
            what=f"White differs by {100 * additivity:.0f} % from red, green and blue together.",
            remedy="Switch off the projector's brilliant-colour, white-boost and dynamic modes, and calibrate again.",
        )
    mixing = columns / sums[:, None]
    if np.linalg.cond(mixing) > 100:
        raise CalibrationError(
            "colours-alike",
            what="The camera can't tell the projector's red, green and blue apart.",
            remedy="Check the colour mode of camera and projector and that every colour's picture was shown.",
        )
    return np.asarray(mixing), additivity


def response_curve(levels: np.ndarray[tuple[int, ...], np.dtype[np.int64]], light: Float64) -> Float64:
    """(256,) light of every device value through the measured ones, monotone, 0 at 0 and 1 at 255.

    Interpolated over a power of the device value that makes the curve nearly straight, so that few levels suffice.
    """
    known = np.concatenate([[0.0], light, [1.0]])
    drop = float(np.max(np.maximum.accumulate(known) - known))
    if drop > 0.05 or not np.all(np.isfinite(known)):
        raise CalibrationError(
            "response-falls",
            what=f"A brighter device value gives less light (by {100 * drop:.0f} % of full scale).",
            remedy="Check that the photographs show the patterns they should and that the light is steady.",
        )
    known = _rising(known)
    at = np.concatenate([[0.0], levels / 255, [1.0]])
    middle = (known > 0.02) & (known < 0.98)
    gamma = float(np.clip(np.median(np.log(known[middle]) / np.log(at[middle])), 0.3, 4)) if middle.any() else 1.0
    curve = PchipInterpolator(at**gamma, known)((np.arange(256) / 255) ** gamma)
    curve[0], curve[-1] = 0.0, 1.0
    return np.asarray(np.maximum.accumulate(np.clip(curve, 0, 1)), np.float64)


def _rising(values: Float64) -> Float64:
    """Pool adjacent violators: the closest sequence that never falls; its ends stay 0 and 1."""
    groups: list[tuple[float, int]] = []
    for value in np.clip(values, 0, 1):
        mean, size = float(value), 1
        while groups and groups[-1][0] > mean:
            below, count = groups.pop()
            mean, size = (mean * size + below * count) / (size + count), size + count
        groups.append((mean, size))
    pooled = np.concatenate([np.full(size, mean) for mean, size in groups])
    pooled[0], pooled[-1] = 0.0, 1.0
    return np.round(pooled, 12)


@dataclass(frozen=True, slots=True)
class Linearity:
    """How linear the camera is: ``ratio`` of the two exposures as measured, and the largest deviation from it.

    ``deviation`` relative, over ``signal`` bins of the longer exposure's value; NaN where a bin is empty
    """

    ratio: float
    worst: float
    signal: Float64
    deviation: Float64


def check_linearity(short: FloatImage, long: FloatImage, exposure_ratio: float) -> Linearity:
    """Compare two exposures of the same still scene.

    Parameters
    ----------
    short, long : (rows, columns, 3) full-scale images, NaN where saturated
    exposure_ratio : long over short as the camera says; used where the measured ratio is meaningless

    Raises CalibrationError("bracket-empty") when no pixel is well exposed in both.
    """
    use = np.isfinite(short) & np.isfinite(long) & (short > 0.02) & (long < 0.97)
    if np.count_nonzero(use) < FEWEST_PIXELS:
        raise CalibrationError(
            "bracket-empty",
            what="No part of the scene is well exposed in both photographs of a bracket.",
            remedy="Choose exposures that differ by at most three stops.",
        )
    low, high = short[use].astype(np.float64), long[use].astype(np.float64)
    ratio = float(high.sum() / low.sum()) if low.sum() > 0 else exposure_ratio
    edges = np.linspace(0, 1, 17)
    # binned by what both say together: binning by one of them would pick its noise
    where = np.clip(np.digitize((high + ratio * low) / 2, edges) - 1, 0, 15)
    count = np.bincount(where, minlength=16)
    with np.errstate(invalid="ignore", divide="ignore"):
        ratios = np.bincount(where, high, 16) / np.bincount(where, low, 16)
    deviation = np.where(count >= FEWEST_PIXELS, ratios / ratio - 1, np.nan)
    worst = float(np.nanmax(np.abs(deviation))) if np.isfinite(deviation).any() else 0.0
    return Linearity(ratio, worst, (edges[:-1] + edges[1:]) / 2, deviation)
