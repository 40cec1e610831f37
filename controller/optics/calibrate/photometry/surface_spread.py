"""Light that enters the surface and leaves it beside, as in marble, skin or wax: how much of it, and how far away.

Light that diffuses along a surface falls off as exp(-t / d) / 2 at the distance t from the straight edge of a bright
area (the line response of (1 - d^2 Laplacian) u = E). The Gray code has many straight edges, and is photographed
anyway: what is seen in its dark parts, over white, is this slope beside an edge, and a level by other surfaces and
lenses.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import astuple, dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from controller.core.arrays import Float64, FloatImage, Mask
from controller.core.channels import finite
from controller.optics.calibrate.correspondence.captures import Captures, grey
from controller.optics.calibrate.values import SurfaceSpread
from controller.optics.capture.pattern_frames import frame
from controller.optics.capture.patterns import BLUR_FREQUENCIES, PERIOD_PX, Pattern, PatternPlan

DISTANCES_PX: Final = np.geomspace(0.5, 9.0, 40)
"""d in projector pixels. Less than the first is as good as blur; more than the last, as indirect light."""
PARTS: Final = 5
"""Of the camera's picture, across and down: light by other surfaces is as good as even in each."""
FINE_FREQUENCY: Final = BLUR_FREQUENCIES["x"][0]
FINE: Final = 8
"""Samples along each projector pixel."""
FARTHEST_PX: Final = 12.0
"""From the nearest edge, in projector pixels; the stripes of the finest bit end there."""
SIGMAS_CLEAR: Final = 2.0
"""Of the blur that sinusoids show, spread included: nearer to an edge, light is there by blur."""
STEEPEST: Final = 0.7
"""Of that blur: where a Gaussian's edge begins to count as clear, it falls off as diffusion by half of it does."""
NARROWER: Final = 0.8
"""Of that blur is the blur alone, about."""
ROUNDS: Final = 3
"""Of what is found in turns: the distance and the places that agree, the share and the blur without the spread."""
FAINTEST: Final = 0.05
"""Of the 99th percentile of white: fainter pixels are left out."""
FEWEST_PIXELS, MOST_PIXELS, FEWEST = 200, 20_000, 10
OUTLIERS: Final = 5.0
"""Median deviations: of light over white among pixels as far from an edge, and of shares among places."""
LEAST_SHARE, MOST_SHARE = 0.03, 0.9
SURE: Final = 4.0
"""Standard errors, by the differences between parts, from which a share counts."""
MOST_VARIED: Final = 0.4
"""Standard deviation of the parts' shares, of the share. A material is the same everywhere; light between near
surfaces, which falls off alike, is not (docs/decisions/0015)."""


@dataclass(frozen=True, slots=True)
class _Evidence:
    """Of one pattern in a part of the picture, for each distance, without what is even, a slope, a blur or a veil.

    ``across``: squares of what a share of 1 would show; ``along``: that times what is seen; ``part``: its number
    """

    across: Float64
    along: Float64
    part: int


@dataclass(frozen=True, slots=True)
class _Agreed:
    """What most evidence says: the number of a distance, the share, its standard error, and the deviation of parts."""

    best: int
    share: float
    error: float
    varied: float


def measure_spread(
    captures: Captures, plan: PatternPlan, position_px: FloatImage, white: FloatImage, *, blur_px: float
) -> SurfaceSpread | None:
    """How light of one projector spreads under the surface; None where nothing of it is seen, or no Gray code is shown.

    Parameters
    ----------
    captures : linear photographs in one unit, with ``black`` and ``gray-*``
    position_px : (rows, columns, 2) where the camera pixels look in the projector's image, NaN where not known
    white : (rows, columns, 3) less the black image
    blur_px : standard deviation of the blur that sinusoids show, in projector pixels

    Raises CalibrationError("capture-missing") or CalibrationError("capture-shape-wrong").
    """
    light = np.nan_to_num(white.sum(axis=2))
    use = finite(position_px) & (light > FAINTEST * np.percentile(light, 99))
    if not use.any() or not blur_px > 0:
        return None
    evidence = list(_evidence(captures, plan, position_px, light, use, blur_px))
    if len(evidence) < FEWEST:
        return None
    agreed = _agreed(evidence)
    distance_px = float(DISTANCES_PX[agreed.best])
    inside = 0 < agreed.best < len(DISTANCES_PX) - 1 and distance_px > STEEPEST * blur_px
    if not inside or agreed.share < SURE * agreed.error or agreed.varied > MOST_VARIED * agreed.share:
        return None
    narrow = _without_blur(agreed.share, distance_px, blur_px)
    if not LEAST_SHARE < narrow < MOST_SHARE:
        return None
    return SurfaceSpread(narrow, distance_px / _scale(position_px, use), distance_px)


def _agreed(found: Sequence[_Evidence]) -> _Agreed:
    """What most of the places say.

    A surface is the same everywhere. Creases and edges are not, so what differs from most places is left out.
    """
    across, along = np.stack([one.across for one in found]), np.stack([one.along for one in found])
    kept = np.ones(len(found), np.bool_)
    for _ in range(ROUNDS):
        weight = np.maximum(across[kept].sum(axis=0), 1e-12)
        best = int(np.argmax(np.maximum(along[kept].sum(axis=0), 0) ** 2 / weight))
        each = along[:, best] / np.maximum(across[:, best], 1e-12)
        middle = _weighted_median(each, across[:, best])
        off = np.abs(each - middle)
        kept = off <= OUTLIERS * max(_weighted_median(off, across[:, best]), 1e-6)
    weights = across[kept, best] / across[kept, best].sum()
    share = float(weights @ each[kept])
    # Patterns err alike where they show the same part.
    part = np.unique([one.part for one in found], return_inverse=True)[1][kept]
    off_by, weight = np.bincount(part, weights * (each[kept] - share)), np.bincount(part, weights)
    varied = np.sum(off_by**2 / np.maximum(weight, 1e-12))
    return _Agreed(best, share, float(np.sqrt(np.sum(off_by**2))), float(np.sqrt(varied)))


def _weighted_median(values: Float64, weights: Float64) -> float:
    order = np.argsort(values)
    total = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(total, total[-1] / 2)])


def _without_blur(share: float, distance_px: float, shown_px: float) -> float:
    """The share whose slope, widened by the blur, is that of ``share``; ``shown_px``: blur with the spread in it."""
    narrow = share
    for _ in range(ROUNDS):
        spread = SurfaceSpread(min(narrow, 1.0), distance_px, distance_px)
        fine, coarse = FINE_FREQUENCY, 1 / PERIOD_PX
        lost = np.log(contrast_left(spread, coarse) / contrast_left(spread, fine))
        variance = max(shown_px**2 - lost / (2 * np.pi**2 * (fine**2 - coarse**2)), 0.0)
        narrow = share * float(np.exp(-variance / (2 * distance_px**2)))
    return narrow


def typical_spread(by_projector: Sequence[SurfaceSpread | None]) -> SurfaceSpread | None:
    """Of the surface, from what each projector shows of it; None unless most of them do."""
    measured = [one for one in by_projector if one is not None]
    if 2 * len(measured) <= len(by_projector):
        return None
    share, camera, projector = np.median([astuple(one) for one in measured], axis=0)
    return SurfaceSpread(float(share), float(camera), float(projector))


def spreading(spread: SurfaceSpread | None) -> str | None:
    """What a technician should know of a surface; None where light leaves where it falls."""
    if spread is None:
        return None
    return (
        f"Light spreads under the object's surface, as in marble or wax: {100 * spread.share:.0f} % of it leaves about "
        f"{2 * spread.projector_px:.0f} projector pixels away. Velatura calculates with it, but fine detail stays "
        "softer. Nothing has to be done."
    )


def contrast_left(spread: SurfaceSpread | None, frequency: float) -> float:
    """What spread leaves of the contrast of a sinusoid of ``frequency`` cycles per projector pixel."""
    if spread is None:
        return 1.0
    return 1 - spread.share + spread.share / (1 + (2 * np.pi * frequency * spread.projector_px) ** 2)


def _evidence(
    captures: Captures, plan: PatternPlan, position_px: FloatImage, light: FloatImage, use: Mask, blur_px: float
) -> Iterator[_Evidence]:
    black = grey(captures, "black")
    parts = (np.argwhere(use) * PARTS // np.array(use.shape)) @ np.array([PARTS, 1])
    for axis in (0, 1):
        at = position_px[..., axis][use]
        for pattern in plan.gray(axis):
            shown = _along(pattern, plan.size_px)
            seen = (grey(captures, pattern.name, black.shape) - black)[use]
            yield from _of_pattern(shown, at, seen, light[use], parts, blur_px)


def _along(pattern: Pattern, size_px: tuple[int, int]) -> Float64:
    """The light of a striped pattern along its axis, ``FINE`` times in each pixel."""
    image = np.asarray(frame(pattern, size_px), np.float64)
    return np.repeat(image[0] if pattern.axis == 0 else image[:, 0], FINE)


def _of_pattern(
    shown: Float64, at: FloatImage, seen: FloatImage, light: FloatImage, parts: npt.NDArray[np.int64], blur_px: float
) -> Iterator[_Evidence]:
    """Of each part of the picture that says anything; ``parts`` (pixels,): which one."""
    from scipy import ndimage

    pixels = (np.arange(len(shown)) + 0.5) / FINE - 0.5
    if not (shown > 0.5).any():
        return
    away = ndimage.distance_transform_edt(shown < 0.5) / FINE
    distance = np.interp(at, pixels, away, left=-1.0, right=-1.0)
    fit = np.flatnonzero((distance >= SIGMAS_CLEAR * blur_px) & (distance <= FARTHEST_PX) & np.isfinite(seen))
    fit = fit[:: max(1, len(fit) // MOST_PIXELS)]
    fit = fit[_alike(seen[fit] / light[fit], distance[fit])]
    if len(fit) < FEWEST_PIXELS:
        return
    at, seen, light, parts = at[fit], seen[fit].astype(np.float64), light[fit].astype(np.float64), parts[fit]
    each = [light * np.interp(at, pixels, _spread_along(shown, d)) for d in DISTANCES_PX]
    alone = np.stack([*each, seen], axis=1)
    # By other surfaces: even, or a slope, times the paint. By lenses: whatever the paint.
    blurred = light * np.interp(at, pixels, _blurred_along(shown, NARROWER * blur_px))
    other = np.stack([light, light * (at - at.mean()), blurred, np.ones_like(light)], axis=1)
    for part in np.unique(parts):
        chosen = parts == part
        if np.count_nonzero(chosen) < FEWEST_PIXELS:
            continue
        basis = np.linalg.qr(other[chosen])[0]
        left = alone[chosen] - basis @ (basis.T @ alone[chosen])
        yield _Evidence(np.sum(left[:, :-1] ** 2, axis=0), left[:, :-1].T @ left[:, -1], int(part))


def _alike(values: FloatImage, distance: Float64) -> Mask:
    """Those that are no outliers among pixels as far from an edge."""
    bins = np.floor(distance).astype(np.int64)
    kept = np.zeros(len(values), np.bool_)
    for number in np.unique(bins):
        chosen = bins == number
        off = np.abs(values[chosen] - np.median(values[chosen]))
        kept[chosen] = off <= OUTLIERS * max(float(np.median(off)), 1e-6)
    return kept


def _spread_along(shown: Float64, distance_px: float) -> Float64:
    """``shown`` (pixels x FINE,) after its light has diffused; dark beyond both ends."""
    from scipy import signal

    left = np.exp(-1 / (FINE * distance_px))
    there, back = (signal.lfilter([1.0], [1.0, -left], one) for one in (shown, shown[::-1]))
    return np.asarray((there + back[::-1] - shown) * (1 - left) / (1 + left), np.float64)


def _blurred_along(shown: Float64, sigma_px: float) -> Float64:
    """The same with a Gaussian blur."""
    from scipy import ndimage

    return np.asarray(ndimage.gaussian_filter1d(shown, FINE * sigma_px, mode="constant", truncate=8.0), np.float64)


def _scale(position_px: FloatImage, use: Mask) -> float:
    """Projector pixels per camera pixel, the median over the surface."""
    (down_x, right_x), (down_y, right_y) = (np.gradient(position_px[..., axis]) for axis in (0, 1))
    area = np.abs(right_x * down_y - right_y * down_x)
    return float(np.sqrt(np.nanmedian(area[use])))
