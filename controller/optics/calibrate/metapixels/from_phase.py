"""Metapixels from the phase map, its inverse and the modulation of fine sinusoids (paper 4.2.2, without dots).

A camera pixel that looks at phi gets the share exp(-1/2 (phi - v)' S^-1 (phi - v)) of pixel v's light (paper 4.2.2).
Mean and covariance of these shares over the camera's pixels are the metapixel, the projector pixel's footprint in the
camera image. This holds on a curved surface, too, where neither the place at which the map equals v nor J S J' are
right.

Which colour each camera sample has is found in a photograph, since what is interpolated is its neighbours' mean: no
file has to tell. Where the development was another one than ours, no pattern fits, and the transport takes each camera
pixel's three colours as they are.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Final

import numba
import numpy as np
import numpy.typing as npt

from controller.core import channels
from controller.core.arrays import Float64, FloatImage, Mask
from controller.core.jit import compiled
from controller.optics.calibrate.correspondence.captures import Captures, grey
from controller.optics.calibrate.correspondence.colour_alignment import ColourPlaces
from controller.optics.calibrate.correspondence.decode import frame_margin_px
from controller.optics.calibrate.correspondence.phase_map import InverseMap, invert_map, make_phase_map
from controller.optics.calibrate.metapixels.blur import blur_of, measure_contrasts
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


REACH_SIGMAS: Final = 3.5
"""Shares are added up to this Mahalanobis distance; a Gaussian's variance beyond it is compensated."""
WIDER: Final = 1.25
"""Size of the window, relative to that of a flat surface."""
MOST_MISSING: Final = 0.2
"""Of a footprint's light, on camera pixels that were not decoded or lie on another surface: there the plane is used."""
LEAST_AREA: Final = 0.25
"""Of the flat footprint's; a smaller one falls between the camera's pixels."""
MOST_OFF_PX, MOST_OFF_SHARE = 0.5, 0.35
"""Projector px off the plane, and share of the way from the centre, from which it is another surface."""


def measure_footprints(
    correspondence: Correspondence, inverse: InverseMap, blur_px2: FloatImage, covariance_px2: FloatImage, valid: Mask
) -> tuple[FloatImage, FloatImage]:
    """Centres and covariances of one projector's pixels in the camera image.

    Parameters
    ----------
    inverse : planes of the same map; they tell where to look, and what continues over missing camera pixels
    blur_px2 : (rows, columns, 3) float32, S of each projector pixel, projector px squared: xx, xy, yy
    covariance_px2 : (rows, columns, 3) float32, J S J' in camera px squared
    valid : (rows, columns), the pixels wanted

    Returns
    -------
    (rows, columns, 2) and (rows, columns, 3) float32; those of ``inverse`` and ``covariance_px2`` at pixels that are
    not wanted, leave the camera's image, or lie largely on more than one surface
    """
    seen = correspondence.projector_px if correspondence.as_seen_px is None else correspondence.as_seen_px
    centre, covariance = inverse.centre_px.copy(), covariance_px2.copy()
    places = np.ascontiguousarray(np.moveaxis(seen, 2, 0))
    _measure(places, correspondence.valid, inverse.jacobian, blur_px2, covariance_px2, valid, centre, covariance)
    return centre, covariance


@compiled(parallel=True)
def _measure(
    position: FloatImage,
    seen: Mask,
    jacobian: FloatImage,
    blur: FloatImage,
    flat: FloatImage,
    wanted: Mask,
    centre: FloatImage,
    covariance: FloatImage,
) -> None:
    tail = np.exp(-(REACH_SIGMAS**2) / 2)
    kept = 1 - REACH_SIGMAS**2 / 2 * tail / (1 - tail)
    for row in numba.prange(wanted.shape[0]):
        sums = np.empty(7)
        for column in range(wanted.shape[1]):
            if not wanted[row, column] or not _add_up(
                position, seen, row, column, centre[row, column], jacobian[row, column], blur[row, column],
                flat[row, column], sums,
            ):  # fmt: skip
                continue
            x, y = sums[1] / sums[0], sums[2] / sums[0]
            xx, xy = sums[3] / sums[0] - x * x, sums[4] / sums[0] - x * y
            yy = sums[5] / sums[0] - y * y
            area = flat[row, column, 0] * flat[row, column, 2] - flat[row, column, 1] ** 2
            if xx * yy - xy * xy <= LEAST_AREA**2 * area:
                continue
            centre[row, column, 0] += x
            centre[row, column, 1] += y
            covariance[row, column, 0] = xx / kept
            covariance[row, column, 1] = xy / kept
            covariance[row, column, 2] = yy / kept


@compiled()
def _add_up(
    position: FloatImage,
    seen: Mask,
    row: int,
    column: int,
    centre: FloatImage,
    jacobian: FloatImage,
    blur: FloatImage,
    flat: FloatImage,
    sums: Float64,
) -> bool:
    """Shares around ``centre`` into ``sums``: 1, x, y, xx, xy, yy, and those missing. False where they do not tell."""
    a, b, c, d = jacobian[0], jacobian[1], jacobian[2], jacobian[3]
    area, spread = a * d - b * c, blur[0] * blur[2] - blur[1] * blur[1]
    pp, pq, qq = blur[2] / spread, -blur[1] / spread, blur[0] / spread
    across = REACH_SIGMAS * WIDER * np.sqrt(flat[0]) + 1
    down = REACH_SIGMAS * WIDER * np.sqrt(flat[2]) + 1
    left, right = int(np.ceil(centre[0] - across)), int(np.floor(centre[0] + across))
    top, bottom = int(np.ceil(centre[1] - down)), int(np.floor(centre[1] + down))
    if left < 0 or top < 0 or right >= seen.shape[1] or bottom >= seen.shape[0]:
        return False
    plane, of_blur = (a, b, c, d, area), (pp, pq, qq)
    x = np.arange(left, right + 1) - centre[0]
    sums[:] = 0.0
    for i in range(top, bottom + 1):
        y, here = i - centre[1], slice(left, right + 1)
        own = position[0, i, here], position[1, i, here], seen[i, here]
        one, of_x, of_xx, missing = _add_row(own, row, column, x, y, plane, of_blur)
        sums[0] += one
        sums[1] += of_x
        sums[2] += one * y
        sums[3] += of_xx
        sums[4] += of_x * y
        sums[5] += one * y * y
        sums[6] += missing
    return bool(sums[0] > 0 and sums[6] <= MOST_MISSING * sums[0])


@compiled(fastmath=True)
def _add_row(
    own: tuple[FloatImage, FloatImage, Mask],
    row: int,
    column: int,
    x: Float64,
    y: float,
    plane: tuple[float, float, float, float, float],
    inverse: tuple[float, float, float],
) -> tuple[float, float, float, float]:
    """Sums over a row of camera pixels: shares; times x; times x squared; and those missing.

    ``own``: x and y of the projector where they look, and where that is known; ``plane``: its four slopes and their
    determinant; ``inverse``: of the blur. Without branches, so that the loop uses vectors.
    """
    (across, down, seen), (a, b, c, d, area), (pp, pq, qq) = own, plane, inverse
    one = of_x = of_xx = missing = 0.0
    for k in range(x.size):
        p, q = (d * x[k] - b * y) / area, (a * y - c * x[k]) / area
        u, v = across[k] - column, down[k] - row
        near = abs(u - p) + abs(v - q) <= MOST_OFF_PX + MOST_OFF_SHARE * (abs(p) + abs(q))
        measured = seen[k] & near
        u, v = u if measured else p, v if measured else q
        far = pp * u * u + 2 * pq * u * v + qq * v * v
        # exp(-far / 2) as (exp(-far / 128))^64, by a series that is good to 1e-13
        t = -far / 128
        share = 1 + t * (1 + t / 2 * (1 + t / 3 * (1 + t / 4 * (1 + t / 5 * (1 + t / 6 * (1 + t / 7 * (1 + t / 8)))))))
        share = share * share * share * share
        share = share * share * share * share
        share = share * share * share * share if far < REACH_SIGMAS**2 else 0.0
        one += share
        of_x += share * x[k]
        of_xx += share * x[k] * x[k]
        missing += 0.0 if measured else share
    return one, of_x, of_xx, missing


PATTERNS: Final = (((0, 1), (1, 2)), ((2, 1), (1, 0)), ((1, 0), (2, 1)), ((1, 2), (0, 1)))
EXACT: Final = 1e-4
"""Relative difference from the neighbours' mean that can still be rounding."""
PLAIN: Final = 20.0
"""The other patterns' difference must be this many times the right one's; a picture without detail fits all."""
WINDOW_PX: Final = 768


def find_bayer_pattern(image: FloatImage) -> npt.NDArray[np.int64] | None:
    """Colours (2, 2) of the samples at even and odd rows and columns, or None.

    ``image`` (rows, columns, 3): one linear photograph, not merged from several; NaN where not measured
    """
    if image.ndim != 3 or min(image.shape[:2]) < 4:
        return None
    part = _brightest(image).astype(np.float64)
    off = [_off(part, np.array(pattern)) for pattern in PATTERNS]
    best = int(np.argmin(off))
    others = min(value for index, value in enumerate(off) if index != best)
    if not (off[best] < EXACT and others > PLAIN * off[best] and others > EXACT):
        return None
    return np.array(PATTERNS[best], np.int64)


def _brightest(image: FloatImage) -> FloatImage:
    """The part around the middle of the light, at even rows and columns."""
    light = np.nan_to_num(image[::8, ::8, 1])
    total = float(light.sum())
    if not total > 0:
        return image[:WINDOW_PX, :WINDOW_PX]
    y = int(8 * float((light.sum(axis=1) * np.arange(light.shape[0])).sum()) / total) - WINDOW_PX // 2
    x = int(8 * float((light.sum(axis=0) * np.arange(light.shape[1])).sum()) / total) - WINDOW_PX // 2
    top, left = max(y, 0) & ~1, max(x, 0) & ~1
    return image[top : top + WINDOW_PX, left : left + WINDOW_PX]


def _off(image: npt.NDArray[np.float64], colours: npt.NDArray[np.int64]) -> float:
    """How far red and blue samples' other two colours are from their neighbours' means, relative to the light.

    Green comes from the four beside. The third colour comes from the corners; it tells patterns with green in common
    apart.
    """
    green = image[:, :, 1]
    beside = (green[:-2, 1:-1] + green[2:, 1:-1] + green[1:-1, :-2] + green[1:-1, 2:]) / 4 - green[1:-1, 1:-1]
    corners = (image[:-2, :-2] + image[:-2, 2:] + image[2:, :-2] + image[2:, 2:]) / 4 - image[1:-1, 1:-1]
    medians = []
    for row, column in np.argwhere(colours != 1):
        # the first row and column have been cut off
        sites = slice(1 - row, None, 2), slice(1 - column, None, 2)
        for difference in (beside[sites], corners[..., 2 - colours[row, column]][sites]):
            finite = np.abs(difference[np.isfinite(difference)])
            medians.append(float(np.median(finite)) if finite.size else np.inf)
    light = float(np.nanmean(np.abs(image))) if np.isfinite(image).any() else 0.0
    return max(medians) / light if light > 0 else np.inf
