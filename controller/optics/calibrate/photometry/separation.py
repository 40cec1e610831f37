"""Direct and indirect light of a projector's white, from the sinusoids that are shown anyway (Nayar et al. 2006).

Light that arrives by way of other surfaces is a mean over much of the projector's picture, so a sinusoid does not
modulate it. What contrast the coarse sinusoid lacks is therefore indirect light, apart from what blur takes; the fine
sinusoids, which lose the same share by indirect light but far more by blur, tell how much that is.

The steps of each sinusoid add up to a white image. All that a projector shows is white times something that is known
well, so the noise of its white image is in every frame that is solved. Three steps hold half as much light again as one
photograph of white, so their sums make it less noisy. They also tell how steady the lamp is.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final, TypeAlias

import cv2
import numba
import numpy as np

from controller.core import channels
from controller.core.arrays import Float64, FloatImage, Mask
from controller.core.blur import gaussian_blur
from controller.core.jit import compiled
from controller.optics.calibrate.correspondence.captures import Captures, coloured, lit_pixels, step_variance
from controller.optics.calibrate.correspondence.decode import FINE_TO_COARSE
from controller.optics.calibrate.photometry.surface_spread import FINE_FREQUENCY, contrast_left
from controller.optics.calibrate.values import Radiometry, SurfaceSpread
from controller.optics.capture.patterns import PERIOD_PX, PHASE_STEPS, Pattern, PatternPlan
from controller.optics.capture.profile import CameraNoise

NAMED: Final = 0.002
"""Standard deviation from which flicker is named; steady lamps are measured with 0.0009 at most."""
SURE, BANDS = 3.0, 6
"""Standard errors from which it is, by bands of rows that say it each by itself."""


def lamp_flicker(strengths: Float64 | None) -> float:
    """Standard deviation of a lamp's light from one photograph to the next, relative.

    ``strengths`` (sinusoids, steps): of ``separation.SinusoidContrast``; 0 where they are not known. Compared are the
    steps of a sinusoid: what all of them have in common, an error of the response does, too.
    """
    if strengths is None or strengths.shape[1] < 2:
        return 0.0
    off = strengths - strengths.mean(axis=1, keepdims=True)
    return float(np.sqrt(np.sum(off**2) / (off.size - len(off))))


def unsteady(name: str, flicker: float, sigma: float = 0.0) -> str | None:
    """What a technician should know of ``lamp_flicker``; None where the lamp is steady.

    ``sigma``: of ``separation.SinusoidContrast``: a lamp changes the light of all parts of a picture alike.
    """
    if flicker < max(NAMED, SURE * sigma):
        return None
    return (
        f"The light of projector {name} is not steady: it differs by {100 * flicker:.1f} % (standard deviation) from "
        "one photograph to the next. Patterns are corrected for that; white images and brightness stay uncertain by as "
        "much. Let the lamp warm up longer, switch its automatic and dynamic lamp modes off, and calibrate again. If "
        "it stays, choose another picture mode: one that bends the response looks alike."
    )


NOISE_AROUND: Final = (15, 15)
"""Camera pixels over which the noise of both is measured."""
FEWEST: Final = 2
"""Sums: fewer do not tell their noise."""
FEWEST_PIXELS: Final = 1_000
"""Lit ones: fewer do not tell how bright the sums are."""


class WhiteSums:
    """White images (rows, columns, 3) from the steps of sinusoids, NaN where not known; their mean and their noise."""

    def __init__(self) -> None:
        self._count = 0
        self._total: FloatImage | None = None
        self._squares: FloatImage | None = None

    def add(self, image: FloatImage) -> None:
        """One more, of the same lamp strength as the others."""
        self._count += 1
        if self._total is None or self._squares is None:
            self._total, self._squares = image.copy(), image * image
            return
        self._total += image
        self._squares += image * image

    def averaged(self, white: FloatImage) -> FloatImage:
        """``white`` (rows, columns, 3) less black, NaN where not known, with less noise, as bright as it was.

        Both are weighted by the noise that is measured around each pixel. ``white`` itself where the sums do not help.
        """
        if self._total is None or self._squares is None or self._count < FEWEST:
            return white
        mean = self._total / np.float32(self._count)
        variance = np.maximum(self._squares - self._total * mean, 0) / np.float32(self._count * (self._count - 1))
        lit = np.flatnonzero((lit_pixels(white) & channels.finite(mean)).ravel())
        if lit.size < FEWEST_PIXELS:
            return white
        some = lit[:: max(1, lit.size // SOME_PIXELS)]
        # the response by which steps are shown is not known well yet: their mean light differs by channel
        with np.errstate(invalid="ignore", divide="ignore"):
            ratio = white.reshape(-1, 3)[some] / mean.reshape(-1, 3)[some]
        mean *= np.median(ratio, axis=0).astype(np.float32)
        apart = white - mean
        own, other = (
            cv2.boxFilter(channels.total(np.nan_to_num(one)), -1, NOISE_AROUND) for one in (variance, apart * apart)
        )
        share = np.divide(own, other, out=np.ones_like(own), where=other > own)[..., None]
        averaged = mean + share * apart
        return np.where(np.isfinite(averaged), np.maximum(averaged, 0), white).astype(np.float32)


COARSE: Final = ("phase-x", "phase-y")
FINE: Final = ("blur-x", "blur-y")
FAINTEST: Final = 1e-3
"""Of the 99th percentile of white: below it nothing is said from the pixel itself."""
LEAST_FINE_CONTRAST: Final = 0.003
OUT_OF_FOCUS: Final = 0.05, 0.1
"""Fine contrast of a pixel, up to which its neighbourhood alone tells the blur, and from which it does so itself."""
AROUND: Final = (15, 15)
"""Out of focus the fine contrast is below a pixel's noise, but blur changes slowly there."""
NOISE_WINDOW: Final = (7, 7)
FLOOR: Final = 0.004
"""Standard deviation of a pixel's share apart from noise."""
RADIUS_PX: Final = 4
LIKE_SIGMAS: Final = 3.0
"""Neighbours whose shares differ by more than so many standard deviations see other light."""
STEEPEST_PX: Final = 4.0
"""Change of the projector's pixel from a camera pixel to the next; more is another surface."""
WORST_SIGMA: Final = 0.25
FILL_PX: Final = (3.0, 9.0, 27.0, 81.0)
LEAST_LIT_SHARE: Final = 0.004
SOME_PIXELS: Final = 200_000
"""So many stand for all where a few numbers are fitted."""


@dataclass(frozen=True, slots=True)
class Sinusoids:
    """``contrast`` (rows, columns, 3): of both axes, of white; ``sigma`` like it: its standard deviation by noise."""

    contrast: FloatImage
    sigma: FloatImage


@dataclass(frozen=True, slots=True)
class SinusoidContrast:
    """What the photographs show of the ``coarse`` and the ``fine`` sinusoids, whatever response they were shown by.

    ``fine_around`` (rows, columns): the fine contrast of the light of all pixels around, of all channels together
    ``white`` (rows, columns, 3): the white image with less noise, from all steps, which add up to it
    ``strengths`` (sinusoids, steps): how strong the lamp was at each step, 1 at white; None where steps are computed
    ``sigma``: their standard error, by how far parts of the picture disagree
    """

    coarse: Sinusoids
    fine: Sinusoids
    fine_around: FloatImage
    white: FloatImage
    strengths: Float64 | None = None
    sigma: float = 0.0


def sinusoid_contrast(
    captures: Captures, plan: PatternPlan, white: FloatImage, *, noise: CameraNoise | None = None
) -> SinusoidContrast:
    """Measure the contrast of a projector's sinusoids.

    Parameters
    ----------
    captures : linear photographs in one unit, ``completed``; needs ``black``, ``phase-*``, ``blur-x-*``, ``blur-y-*``
    white : (rows, columns, 3) less the black image, NaN where not known
    noise : of a camera sample, in the captures' unit, where the plan shows too few pictures to measure it

    Raises CalibrationError("capture-missing") or CalibrationError("capture-shape-wrong").
    """
    black = coloured(captures, "black", white.shape[:2])
    noise = noise or CameraNoise()
    sums = WhiteSums()
    coarse, _, gains = _measured(captures, plan, COARSE, black, white, noise, sums)
    fine, powers, more = _measured(captures, plan, FINE, black, white, noise, sums)
    strengths = 1 / np.array([gain for gain, _ in (*gains, *more)]) if gains else None
    sigma = float(np.sqrt(np.mean([one**2 for _, one in (*gains, *more)]))) if gains else 0.0
    averaged = sums.averaged(white)
    with np.errstate(invalid="ignore", divide="ignore"):
        noise_of_white = white / averaged
        for one in (coarse, fine):
            np.multiply(one.contrast, noise_of_white, out=one.contrast)
    return SinusoidContrast(coarse, fine, _contrast_around(powers, averaged), averaged, strengths, sigma)


def indirect_share(
    seen: SinusoidContrast,
    white: FloatImage,
    position_px: FloatImage,
    *,
    linearity: Float64 | None = None,
    spread: SurfaceSpread | None = None,
) -> FloatImage:
    """The share (rows, columns, 3) of a projector's white that is indirect, 0 to 1.

    Parameters
    ----------
    white : as for ``sinusoid_contrast``
    position_px : (rows, columns, 2) where the camera pixels look in the projector's image, NaN where not known
    linearity : (3,) contrast that sinusoids truly had, see ``shown_contrast``; 1 if omitted
    spread : of light under the surface, which is none of the share
    """
    full = np.ones(3) if linearity is None else linearity
    coarse_left, fine_left = (contrast_left(spread, frequency) for frequency in (1 / PERIOD_PX, FINE_FREQUENCY))
    with np.errstate(invalid="ignore", divide="ignore"):
        s = seen.coarse.contrast / (full * coarse_left).astype(np.float32)
        f = _fine_contrast(seen, float(full.mean()) * fine_left)
        share = 1 - np.exp((np.log(np.maximum(s, 1e-6)) - FINE_TO_COARSE * np.log(f)) / (1 - FINE_TO_COARSE))
    sigma = np.hypot(seen.coarse.sigma, FLOOR).astype(np.float32)
    known = channels.finite(share) & (channels.largest(sigma) < WORST_SIGMA)
    known &= channels.every(white > FAINTEST * _bright(white))
    smooth = _smoothed(np.where(known[..., None], share, 0).astype(np.float32), sigma, known, position_px)
    return np.clip(_filled(smooth, known), 0, 1).astype(np.float32)


def _fine_contrast(seen: SinusoidContrast, full: float) -> FloatImage:
    """(rows, columns, 1) over the channels, 1 where it is not known; from around where the pixel is out of focus."""
    own, around = channels.mean(seen.fine.contrast) / np.float32(full), seen.fine_around / np.float32(full)
    sharp = np.clip((own - OUT_OF_FOCUS[0]) / (OUT_OF_FOCUS[1] - OUT_OF_FOCUS[0]), 0, 1)
    mean = (sharp * own + (1 - sharp) * np.minimum(around, OUT_OF_FOCUS[1]))[..., None]
    return np.asarray(np.where(np.isfinite(mean), np.clip(mean, LEAST_FINE_CONTRAST, 1), 1), np.float32)


def shown_contrast(radiometry: Radiometry, encoded_with: Float64) -> Float64:
    """(3,) contrast per camera channel of a sinusoid that was encoded by one response and shown by another.

    It is of the mean light of all channels, as the gains that free the steps of flicker (``_gains``) are.

    ``radiometry``: the projector as it is; ``encoded_with`` (3, 256): the response by which device values were chosen
    """
    angle = 2 * np.pi * np.arange(720) / 720
    wave = 0.5 + 0.5 * np.cos(angle)
    levels = np.arange(256.0)
    light = np.stack(
        [
            np.interp(np.interp(wave, used, levels), levels, true)
            for used, true in zip(encoded_with, radiometry.response, strict=True)
        ]
    )
    seen = radiometry.mixing @ light
    return np.asarray(2 * (seen * np.cos(angle)).mean(axis=1) / seen.mean(), np.float64)


def indirect_figures(share: FloatImage, white: FloatImage) -> tuple[float, float]:
    """Median and 95th percentile of the share over the camera pixels that the projector lights directly."""
    light = np.nan_to_num(white)
    direct = light * (1 - share)
    lit = channels.smallest(direct) > LEAST_LIT_SHARE * float(np.percentile(direct, 99.9))
    if not lit.any():
        return 0.0, 0.0
    values = channels.total(share * light)[lit] / channels.total(light)[lit]
    return float(np.median(values)), float(np.percentile(values, 95))


def _measured(
    captures: Captures,
    plan: PatternPlan,
    prefixes: tuple[str, ...],
    black: FloatImage,
    white: FloatImage,
    camera: CameraNoise,
    white_sums: WhiteSums,
) -> tuple[Sinusoids, list[FloatImage], list[tuple[Float64, Float64]]]:
    """Contrast of sinusoids along both axes, freed of the lamp's flicker and of the bias by noise.

    And (rows, columns, 3) of each axis: their squared amplitude, without noise; and ``_gains`` of each axis, if any.
    What the steps of each axis add up to goes into ``white_sums``.
    """
    powers: list[FloatImage] = []
    sums: list[FloatImage] = []
    gains: list[tuple[Float64, Float64]] = []
    for prefix in prefixes:
        steps = plan.sinusoids(prefix)
        images = (coloured(captures, step.name, black.shape[:2]) - black for step in steps)
        if plan.computed:  # of one strength already, and adding up to white: none has to be kept
            along, across = _amplitude(images, steps)
        else:
            kept = list(images)
            gains.append(_gains(kept, white))
            kept = [image * np.float32(gain) for image, gain in zip(kept, gains[-1][0], strict=True)]
            along, across = _amplitude(kept, steps)
            sums.append(np.asarray(sum(kept), np.float32))
            white_sums.add(sums[-1] * np.float32(2 / len(steps)))
        powers.append(along * along + across * across)
    if plan.computed:
        variance = step_variance(np.nan_to_num(white / 2 + black), camera)
    else:
        # both axes add up to the same light: what differs is noise, and not white's
        residual = np.nan_to_num(sums[0] - sums[1])
        variance = cv2.boxFilter(residual * residual, -1, NOISE_WINDOW) / np.float32(2 * PHASE_STEPS)
    powers = [power - np.float32(4 / PHASE_STEPS) * variance for power in powers]
    product = np.maximum(powers[0], 0) * np.maximum(powers[1], 0)
    with np.errstate(invalid="ignore", divide="ignore"):
        contrast = 2 * product**0.25 / white
        sigma = 2 * np.sqrt(np.float32(2 / PHASE_STEPS / len(prefixes)) * variance) / white
    return Sinusoids(np.asarray(contrast, np.float32), np.asarray(sigma, np.float32)), powers, gains


def _contrast_around(powers: Sequence[FloatImage], white: FloatImage) -> FloatImage:
    around = np.prod([np.maximum(_light_around(power), 0) for power in powers], axis=0)
    return np.asarray(2 * around**0.25 / np.sqrt(np.maximum(_light_around(white * white), 1e-30)), np.float32)


def _light_around(image: FloatImage) -> FloatImage:
    """(rows, columns): of all channels, mean of each pixel's neighbourhood."""
    return np.asarray(cv2.boxFilter(channels.total(np.nan_to_num(image)), -1, AROUND), np.float32)


def _amplitude(images: Iterable[FloatImage], steps: Sequence[Pattern]) -> tuple[FloatImage, FloatImage]:
    """Cosine and sine part of a sinusoid's steps."""
    parts: list[FloatImage] = []
    for image, step in zip(images, steps, strict=True):
        parts = parts or [np.zeros(image.shape, np.float32) for _ in range(2)]
        by = np.float32(2 / len(steps) * np.cos(step.phase_rad)), np.float32(-2 / len(steps) * np.sin(step.phase_rad))
        _add_wave(image.reshape(-1), *by, *(part.reshape(-1) for part in parts))
    along, across = parts
    return along, across


@compiled(parallel=True)
def _add_wave(image: FloatImage, cosine: np.float32, sine: np.float32, along: FloatImage, across: FloatImage) -> None:
    for k in numba.prange(image.size):
        along[k] += cosine * image[k]
        across[k] += sine * image[k]


def _gains(images: list[FloatImage], white: FloatImage) -> tuple[Float64, Float64]:
    """How much brighter the lamp was at white than at each step: the steps must add up to half the white each.

    And the standard error of that, by how far ``BANDS`` of rows disagree.
    """
    use = channels.finite(white) & channels.every(white > FAINTEST * 10 * _bright(white))
    for image in images:
        use &= channels.finite(image)
    at = np.flatnonzero(use)
    if at.size < 10 * len(images):
        return np.ones(len(images)), np.zeros(len(images))
    at = at[:: max(1, at.size // SOME_PIXELS)]
    full = white.reshape(-1, 3)[at].astype(np.float64)
    equations = np.stack([(i.reshape(-1, 3)[at] / full).ravel() for i in images], axis=1)
    bands = [equations, *np.array_split(equations, BANDS)]
    whole, *each = (np.linalg.lstsq(one, np.full(len(one), len(images) / 2), rcond=None)[0] for one in bands)
    return np.asarray(whole), np.std(each, axis=0, ddof=1) / np.sqrt(BANDS)


def _bright(white: FloatImage) -> FloatImage:
    at = np.flatnonzero(channels.finite(white))
    some = white.reshape(-1, 3)[at[:: max(1, at.size // SOME_PIXELS)]] if at.size else np.zeros((1, 3), np.float32)
    return np.asarray(np.percentile(some, 99, axis=0), np.float32)


def _smoothed(share: FloatImage, sigma: FloatImage, known: Mask, position_px: FloatImage) -> FloatImage:
    """Mean over neighbours on the same surface in like light, by their certainty."""
    out = np.empty_like(share)
    across, down = (
        np.ascontiguousarray(np.where(np.isfinite(position_px[..., axis]), position_px[..., axis], np.float32(-1e6)))
        for axis in (0, 1)
    )
    for c in range(3):
        mean = np.ascontiguousarray(share[..., c])
        seen = np.where(known, mean, np.float32(0))
        start = np.where(known, cv2.medianBlur(mean, 3), np.float32(0))
        variance = np.where(known, sigma[..., c] ** 2, np.float32(1))
        _mean_of_like(seen, start, variance, known, across, down, mean)
        out[..., c] = mean
    return out


PixelRow: TypeAlias = tuple[FloatImage, FloatImage, FloatImage, FloatImage]
"""Pixels of a row, (columns,) each: first estimate of the share, its variance, x and y in the projector's image."""


@compiled(fastmath=True)
def _add_like(
    here: PixelRow,
    there: PixelRow,
    certain: FloatImage,
    share: FloatImage,
    limit: np.float32,
    total: FloatImage,
    weight: FloatImage,
) -> None:
    """Add to ``total`` and ``weight`` the shares of those pixels ``there`` that are like the pixel ``here``."""
    start, variance, across, down = here
    other, other_variance, other_across, other_down = there
    for i in range(total.size):
        off = other[i] - start[i]
        like = off * off <= np.float32(LIKE_SIGMAS**2) * (variance[i] + other_variance[i])
        near = max(abs(other_across[i] - across[i]), abs(other_down[i] - down[i])) <= limit
        w = certain[i] if like and near else np.float32(0)
        total[i] += w * share[i]
        weight[i] += w


@compiled(parallel=True, fastmath=True)
def _mean_of_like(
    share: FloatImage,
    start: FloatImage,
    variance: FloatImage,
    known: Mask,
    across: FloatImage,
    down: FloatImage,
    out: FloatImage,
) -> None:
    """Of one channel; all (rows, columns), finite. The innermost loop runs along a row, so that it uses vectors."""
    rows, columns = known.shape
    certain = np.empty((rows, columns), np.float32)
    for row in numba.prange(rows):
        for column in range(columns):
            certain[row, column] = 1 / variance[row, column] if known[row, column] else np.float32(0)
    for row in numba.prange(rows):
        total, weight = np.zeros(columns, np.float32), np.zeros(columns, np.float32)
        first, end = columns, 0
        for column in range(columns):
            if known[row, column]:
                first, end = min(first, column), column + 1
        for r in range(max(row - RADIUS_PX, 0), min(row + RADIUS_PX + 1, rows)):
            for shift in range(-RADIUS_PX, RADIUS_PX + 1):
                limit = np.float32(STEEPEST_PX * max(abs(r - row), abs(shift)) + 1)
                a, e = max(first, -shift), min(end, columns - shift)
                if a < e:
                    at, by = (row, slice(a, e)), (r, slice(a + shift, e + shift))
                    here = start[at], variance[at], across[at], down[at]
                    there = start[by], variance[by], across[by], down[by]
                    _add_like(here, there, certain[by], share[by], limit, total[a:e], weight[a:e])
        for column in range(first, end):
            if known[row, column] and weight[column] > 0:
                out[row, column] = total[column] / weight[column]


def _filled(share: FloatImage, known: Mask) -> FloatImage:
    """Shares where nothing is known, from what is around; 0 where nothing is near."""
    own, left = np.where(known[..., None], share, np.float32(0)), ~known
    out = own.copy()
    have = known.astype(np.float32)
    for sigma in FILL_PX:
        if not left.any():
            break
        weight = gaussian_blur(have, sigma)
        around = gaussian_blur(own, sigma)
        now = left & (weight > 0.02)
        out[now] = around[now] / weight[now][:, None]
        left &= ~now
    return np.asarray(out, np.float32)
