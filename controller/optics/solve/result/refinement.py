"""An appearance corrected by a photograph of it: which light to aim at, and whether that is worth it.

The photograph less what the transport predicts of the same frames is the model's error there. The target less that
error is what the next solve aims at: where the model is right, nothing changes, and what is out of reach does not add
up from photograph to photograph. Arrays in, arrays out (docs/decisions/0012).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import cv2
import numpy as np

from controller.core import channels
from controller.core.arrays import Float64, FloatImage, Mask
from controller.core.blur import masked_blur
from controller.optics.solve.appearance import StageLight
from controller.optics.solve.bounded.engine import SolveContext
from controller.optics.solve.bounded.equations import SolveSettings, appearance_weights
from controller.optics.solve.bounded.solver import solve_bounded
from controller.optics.solve.reach.feasibility import feasibility, target_radiance
from controller.optics.solve.result.metrics import colour_difference

SCALES_PX: Final = (1.0, 2.0, 4.0, 8.0, 16.0)
"""Standard deviations of the filter's bands; the finest band is what the first leaves."""
NOISE_FACTOR: Final = 2.0
"""So many times the noise's variance is subtracted from a band's energy: that of few samples may be large by chance."""
SAMPLES_A_SITE: Final = 4.0
"""Camera pixels for each red or blue sample. The noise of a mean falls with the number of samples, not of pixels."""
LIMIT: Final = 2.0
"""A target's light is never corrected by more than this factor, and ``FLOOR`` of white."""
FLOOR: Final = 0.1
"""This share of white is added to a pixel's light before an error is compared with it, so that the dark counts less."""
LEAST_OUTLIER: Final = 0.15
"""An error is never an outlier below this share of the pixel's light and ``FLOOR``."""
OUTLIER_SPREADS: Final = 6.0
"""An error is an outlier beyond this many spreads of the errors around the median."""
MOST_OUTLIER: Final = 0.35
"""An error beyond this is an outlier whatever the spread is: where a person stands before more than half of the object,
median and spread are the person's."""
GONE: Final = 0.6
"""Somebody stands in a projector's light where more than this of it is missing; lamps lose less, and everywhere."""
EVEN_LOSS: Final = 0.5
UNEVEN: Final = 0.2
"""Lamps explain an error if they lost less than ``EVEN_LOSS``, and ``UNEVEN`` of the squared error is left at most."""
OUTLIER_PX: Final = 9
"""Side in camera pixels of the smallest area of outliers. Edges of shadows are thinner; a hand is larger."""
MARGIN_PX: Final = 12
"""Camera pixels around a rejected area that are rejected, too: a penumbra may be there."""
CHANGED: Final = 0.04
"""A pixel has changed where the first and the last exposure differ by this share of its light and ``FLOOR``: lamps
flicker by less."""
MOST_REJECTED: Final = 0.3
"""A photograph is refused where a larger share of the pixels is rejected."""
DARKEST: Final = 0.5
BRIGHTEST: Final = 2.0
"""A photograph is refused where its median light is outside this range, as a share of the predicted one."""
EDGE_PX: Final = 2.0
"""The correction ends smoothly over about twice this beyond the pixels in reach."""
LEAST_GAIN: Final = 0.02
"""Mean CIEDE2000 by which two photographs of the same frames differ. A smaller gain is noise."""
STEADY_STEP_PX: Final = 3
"""Flicker is measured at every third row and column."""
SURE: Final = 2.0
"""A change of a projector's light counts beyond this many standard deviations of its flicker."""
LEAST_FLICKER: Final = 1e-6
"""The least standard deviation of a lamp's light, as a share of it: no lamp is steadier."""
CORRELATED_PX: Final = 16.0
"""So many neighbouring camera pixels count as one error when the uncertainty of a mean is estimated."""


@dataclass(frozen=True, slots=True)
class ResultPhotograph:
    """What a photograph of a result says.

    ``radiance`` (rows, columns, 3) float32, NaN where not measured; ``sigma`` its standard deviation by the noise model
    ``first``, ``last``: two exposures alike, taken before and after the others, in the same unit
    """

    radiance: FloatImage
    sigma: FloatImage
    first: FloatImage
    last: FloatImage

    def times(self, factor: FloatImage) -> ResultPhotograph:
        """In other units; ``factor`` (3,)."""
        return ResultPhotograph(*(factor * one for one in (self.radiance, self.sigma, self.first, self.last)))


@dataclass(frozen=True, slots=True)
class RefinedStage:
    """What corrections need of a stage, (rows, columns, 3): the ``black`` image, and ``white`` of all projectors."""

    black: FloatImage
    white: FloatImage


def _counted_over(predicted: FloatImage, stage: RefinedStage, at: Mask | None = None) -> FloatImage:
    """The light over which errors count: that of the picture and ``FLOOR`` of white. ``at``: of these pixels alone."""
    light, black, white = (one if at is None else one[at] for one in (predicted, stage.black, stage.white))
    counted = np.maximum(light - black, 0) + FLOOR * white + 1e-6 * float(stage.white.max(initial=0))
    return np.asarray(counted, np.float32)


def trusted_pixels(
    photograph: ResultPhotograph,
    predicted: FloatImage,
    stage: RefinedStage,
    mask: Mask,
    parts: Sequence[FloatImage] = (),
) -> Mask:
    """The pixels of ``mask`` on which the photograph shows the result and nothing else, such as a hand or its shadow.

    Left out is what was not measured, what changed while the photograph was taken, areas whose error has nothing to do
    with that of the others or is larger than any model's, and areas that one projector's light does not reach.
    ``parts`` (rows, columns, 3): the light of each projector in ``predicted``
    """
    measured = mask & channels.finite(photograph.radiance)
    if not measured.any():
        return measured
    scale = _counted_over(predicted, stage)
    error = masked_blur(photograph.radiance - predicted, measured, EDGE_PX) / scale
    inside = error[measured]
    middle = np.median(inside, axis=0)
    spread = 1.4826 * np.median(np.abs(inside - middle), axis=0)
    limit = np.clip(OUTLIER_SPREADS * spread, LEAST_OUTLIER, MOST_OUTLIER)
    middle = np.clip(middle, -LEAST_OUTLIER, LEAST_OUTLIER)
    strange = measured & channels.some(np.abs(error - middle) > limit)
    shares = [masked_blur(part, measured, EDGE_PX) / scale for part in parts]
    if shares and not _even(error, shares, measured):
        for share in shares:
            strange |= measured & _shadowed(error, share)
    both = measured & channels.finite(photograph.first) & channels.finite(photograph.last)
    moved = masked_blur(np.abs(masked_blur(photograph.last - photograph.first, both, EDGE_PX)), both, EDGE_PX)
    noise = 4 * np.sqrt(2 * noise_variance(photograph.sigma, both, EDGE_PX))
    strange |= both & channels.some(moved > CHANGED * scale + noise)
    core = cv2.morphologyEx(strange.astype(np.uint8), cv2.MORPH_OPEN, np.ones((OUTLIER_PX, OUTLIER_PX), np.uint8))
    side = 2 * MARGIN_PX + 1
    around = cv2.dilate(core, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))) > 0
    return np.asarray(measured & ~around)


def _even(error: FloatImage, parts: Sequence[FloatImage], measured: Mask) -> bool:
    """Whether an ``error`` is mostly that lamps, whose light is ``parts``, are brighter or darker everywhere."""
    few = np.s_[::STEADY_STEP_PX, ::STEADY_STEP_PX]
    at = measured[few]
    columns = np.stack([part[few][at].ravel() for part in parts], axis=1).astype(np.float64)
    values = error[few][at].ravel().astype(np.float64)
    gains = np.linalg.lstsq(columns, values, rcond=None)[0]
    left = float(np.sum((values - columns @ gains) ** 2))
    return bool(gains.min() > -EVEN_LOSS and left < UNEVEN * float(np.sum(values**2)))


def _shadowed(error: FloatImage, part: FloatImage) -> Mask:
    """(rows, columns): where an ``error`` is that most of a projector's light, ``part``, is missing."""
    size = channels.total(part**2)
    gone = -channels.total(error * part) / np.maximum(size, np.finfo(np.float32).tiny)
    rest = channels.total((error + gone[..., None] * part) ** 2)
    seen = size > 3 * LEAST_OUTLIER**2
    return np.asarray(seen & (gone > GONE) & (rest < channels.total(error**2) / 4))


def refusal(
    photograph: ResultPhotograph, predicted: FloatImage, stage: RefinedStage, mask: Mask, trusted: Mask
) -> str | None:
    """Why a photograph says nothing about the result, for people; None where it does."""
    measured = mask & channels.finite(photograph.radiance)
    wanted = float((predicted - stage.black)[measured].sum(dtype=np.float64))
    seen = float((photograph.radiance - stage.black)[measured].sum(dtype=np.float64))
    if not measured.any() or seen < DARKEST * wanted:
        return "it is too dark"
    if seen > BRIGHTEST * wanted:
        return "it is too bright"
    if measured.sum() < (1 - MOST_REJECTED) * mask.sum():
        return "too much of it is overexposed"
    if trusted.sum() < (1 - MOST_REJECTED) * mask.sum():
        return "something moved or stood in the picture"
    return None


def without_flicker(
    photograph: ResultPhotograph,
    predicted: FloatImage,
    parts: Sequence[FloatImage],
    stage: RefinedStage,
    trusted: Mask,
    flicker: Sequence[float],
) -> ResultPhotograph:
    """The photograph without what lamps that flicker can explain of it, so that frames are not corrected for that.

    The light of each projector is some factor of what is predicted. A factor is kept as far as it is clearly larger
    than what lamps flicker by, as James and Stein (1961) shrink means. That is the mean of what two exposures alike say
    of all lamps, few numbers of this very light, and of what the calibration says of each, in other exposures.

    Parameters
    ----------
    parts : (rows, columns, 3) the light of each projector in ``predicted``
    flicker : standard deviation of each lamp in the calibration's photographs, relative; 0 where it is not known
    """
    at = np.zeros(trusted.shape, np.bool_)
    at[::STEADY_STEP_PX, ::STEADY_STEP_PX] = trusted[::STEADY_STEP_PX, ::STEADY_STEP_PX]
    at &= channels.finite(photograph.first) & channels.finite(photograph.last)
    scale = _counted_over(predicted, stage, at)
    columns = np.stack([(part[at] / scale).ravel() for part in parts], axis=1).astype(np.float64)
    if len(columns) <= len(parts):
        return photograph
    errors = [
        ((one[at] - other[at]) / scale).ravel().astype(np.float64)
        for one, other in ((photograph.radiance, predicted), (photograph.last, photograph.first))
    ]
    factors, between = np.linalg.lstsq(columns, np.stack(errors, axis=1), rcond=None)[0].T
    variances = [float(np.mean(between**2)) / 2]
    if any(flicker):
        variances.append(float(np.mean(np.square([one for one in flicker if one]))))
    spread = max(float(np.mean(variances)) ** 0.5, LEAST_FLICKER)
    taken = _by_flicker(factors, spread)
    # Lamps light much of the same: what all of them change together is known better than what each one does, and
    # must not change by parts of single lamps' changes, which may be large and opposite.
    together = np.linalg.svd(columns, full_matrices=False)[2][0]
    taken += (_by_flicker(together @ factors, spread) - together @ taken) * together
    light = np.float32(taken[0]) * parts[0]
    for factor, part in zip(taken[1:], parts[1:], strict=True):
        light += np.float32(factor) * part
    return replace(photograph, radiance=np.subtract(photograph.radiance, light, out=light))


def _by_flicker(changes: Float64, spread: float) -> Float64:
    """What flicker of ``spread`` explains of changes of light: all of small ones, less and less of larger ones."""
    return np.asarray(np.minimum(1, SURE * spread / np.maximum(np.abs(changes), 1e-30)) ** 3 * changes)


def noise_variance(sigma: FloatImage, mask: Mask, scale_px: float) -> FloatImage:
    """Variance of a photograph's noise in means over a Gaussian of ``scale_px``, 0 for single pixels."""
    variance = np.where(np.isfinite(sigma), sigma, 0) ** 2
    if scale_px <= 0:
        return np.asarray(variance, np.float32)
    return masked_blur(variance, mask, scale_px) * np.float32(min(1.0, SAMPLES_A_SITE / (4 * np.pi * scale_px**2)))


def without_noise(error: FloatImage, sigma: FloatImage, mask: Mask) -> FloatImage:
    """``error`` (rows, columns, 3) without what noise can explain; defined around ``mask``, too.

    In bands from wide to fine; of each, what its local energy has above the noise's (a Wiener filter in each band), so
    that a clear error keeps its edges, and nothing is made of noise.
    """
    scales = (0.0, *SCALES_PX)
    wider = masked_blur(error, mask, scales[-1])
    found = _shrunk(wider, sigma, mask, scales[-1], 2 * scales[-1])
    for finer in reversed(range(len(SCALES_PX))):
        narrower = masked_blur(error, mask, scales[finer]) if finer else np.where(mask[..., None], error, 0)
        band = narrower - wider
        if finer == 0:
            band[~mask] = 0
        found += _shrunk(band, sigma, mask, scales[finer], 2 * scales[finer + 1])
        wider = narrower
    return found


def _shrunk(band: FloatImage, sigma: FloatImage, mask: Mask, scale_px: float, window_px: float) -> FloatImage:
    energy = masked_blur(band**2, mask, window_px)
    noise = NOISE_FACTOR * noise_variance(sigma, mask, scale_px)
    share = np.maximum(energy - noise, 0) / np.maximum(energy, np.finfo(np.float32).tiny)
    return np.asarray(share * band, np.float32)


@dataclass(frozen=True, slots=True)
class ModelError:
    """By how much the light differs from what the transport predicts, (rows, columns, 3), by photographs of results.

    ``light``: NaN where no photograph is trusted; ``sigma``: its standard deviation by the noise model
    """

    light: FloatImage
    sigma: FloatImage

    @property
    def known(self) -> Mask:
        """The pixels at which a photograph is trusted."""
        return channels.finite(self.light)

    def then(self, later: ModelError) -> ModelError:
        """With what a ``later`` photograph says: the mean of both where noise explains how they differ, else the later.

        A correction changes the frames, and with them the error, but most of what two photographs differ by is noise.
        """
        both = self.known & later.known
        change = np.where(both[..., None], later.light - self.light, 0).astype(np.float32)
        variance, later_variance = self.sigma**2, later.sigma**2
        added = np.where(both[..., None], variance + later_variance, 1).astype(np.float32)
        real = without_noise(change, np.sqrt(added), both)
        light = later.light - (later_variance / added) * (change - real)
        light = np.where(both[..., None], light, np.where(later.known[..., None], later.light, self.light))
        sigma = np.where(later.known[..., None], later.sigma, self.sigma)
        sigma = np.where(both[..., None], np.sqrt(variance * later_variance / added), sigma)
        return ModelError(np.asarray(light, np.float32), np.asarray(sigma, np.float32))


def model_error(photograph: ResultPhotograph, predicted: FloatImage, trusted: Mask) -> ModelError:
    """What a photograph says of the light of the frames that were photographed, ``predicted`` by the transport."""
    error = np.where(trusted[..., None], photograph.radiance - predicted, np.nan)
    return ModelError(np.asarray(error, np.float32), photograph.sigma)


def corrected_target(target: FloatImage, error: ModelError, stage: RefinedStage) -> FloatImage:
    """What to aim at, so that a photograph becomes ``target`` where the ``error`` is known; elsewhere ``target``.

    ``target`` (rows, columns, 3): radiance
    """
    known = error.known
    found = without_noise(np.nan_to_num(error.light), error.sigma, known)
    light = np.maximum(target - stage.black, 0)
    room = FLOOR * stage.white
    found = np.clip(found, -(LIMIT - 1) * light - room, (1 - 1 / LIMIT) * light + room)
    near = cv2.GaussianBlur(known.astype(np.float32), (0, 0), EDGE_PX)
    found *= np.where(known, 1, np.clip(2 * near, 0, 1))[..., None].astype(np.float32)
    return np.asarray(target - found, np.float32)


@dataclass(frozen=True, slots=True)
class PhotographedError:
    """CIEDE2000 on the pixels compared: its ``median``, 95th percentile and ``mean``; ``map`` is NaN elsewhere."""

    median: float
    p95: float
    mean: float
    map: FloatImage


def photographed_error(
    radiance: FloatImage, target: FloatImage, camera_to_xyz: Float64, white: float, mask: Mask
) -> PhotographedError:
    """The error of a photograph, or of a predicted one, on ``mask``, which has to hold a pixel."""
    found = colour_difference(np.nan_to_num(radiance), target, camera_to_xyz, white, mask)
    inside = found[mask]
    error = np.where(mask, found, np.nan).astype(np.float32)
    median, p95 = np.percentile(inside, (50, 95))
    return PhotographedError(float(median), float(p95), float(inside.mean(dtype=np.float64)), error)


@dataclass(frozen=True, slots=True)
class Gain:
    """By how much the mean CIEDE2000 fell, or the median if less, and from which change on that says anything."""

    mean: float
    noise: float

    @property
    def worth_it(self) -> bool:
        return self.mean > self.noise


def gain(before: FloatImage, after: FloatImage) -> Gain:
    """Between two error maps, NaN where not compared; on the pixels of both."""
    both = np.isfinite(before) & np.isfinite(after)
    if not both.any():
        return Gain(0.0, LEAST_GAIN)
    change = (before[both] - after[both]).astype(np.float64)
    uncertain = 2 * float(change.std()) / max(change.size / CORRELATED_PX, 1.0) ** 0.5
    of_medians = float(np.median(before[both])) - float(np.median(after[both]))
    return Gain(min(float(change.mean()), of_medians + LEAST_GAIN), max(LEAST_GAIN, uncertain))


def solve_again(
    light: StageLight,
    target: FloatImage,
    aimed: FloatImage,
    settings: SolveSettings,
    context: SolveContext,
    *,
    exposure: float,
) -> tuple[FloatImage, ...]:
    """Frames for ``aimed`` from the present ones, ``settings.start``, in full, weighted for the appearance ``target``.

    What no camera sees stays as it is. Raises as ``solve_bounded``.
    """
    transport, before = light.transport, settings.start or ()
    wanted = target_radiance(target, light.black, 1.0)
    possible = feasibility(light.levels(), target, light.black)
    weights = appearance_weights(wanted, possible.reachable, exposure)
    radiance = target_radiance(aimed, light.black, 1.0)
    frames = solve_bounded(transport, radiance, light.black, replace(settings, weights=weights), context).frames
    seen = [transport.per_weight[transport.span(n)].reshape(*size, 1) > 0 for n, size in enumerate(transport.sizes)]
    return tuple(np.where(*one) for one in zip(seen, frames, before, strict=True))
