"""Adapts targets to the available light instead of clipping them (after Law et al. 2011).

What the eye compares is a place with its surroundings. So where a target needs more light than there is, its
surroundings are dimmed with it, by one gain that varies slowly: differences within a neighbourhood stay, the
difference between neighbourhoods shrinks. A few pixels that hardly any light reaches, at grazing edges for instance,
would need hundreds of times what there is, and bring all of their surroundings into the dark with them: they are
given up. Below the black image, where light can't be taken away, a toe keeps the order of the darkest tones. Nothing
changes farther than ``REACH`` from where something is lacking, and where cutting off loses less (``contrast_kept``),
it is left at that.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np

from controller.core.arrays import FloatImage, Mask
from controller.core.errors import UsageError
from controller.solve.drive_levels import DriveLevels
from controller.solve.feasibility import Feasibility, feasibility
from controller.transport import LightTransport

KNEE: Final = 0.7
"""Drives below this stay as they are; those above approach 1 smoothly."""
REACH: Final = 1 / 8
"""How far a dimming reaches, relative to the picture's longer side."""
WINDOW_MIN_PX: Final = 3
STRENGTHS: Final = (0.5, 1.0)
GIVEN_UP: Final = (0.02, 0.05)
"""Shares of the object's pixels with the highest need of light that do not cause dimming."""
TOE: Final = 0.5
"""Of the black image: targets bend away from it within about this part of it."""
SCALES: Final = (1 / 400, 1 / 200, 1 / 100, 1 / 50)
"""Standard deviations of the neighbourhoods whose contrast is compared, relative to the picture's longer side."""
FINEST_PX: Final = 2.0
FAINTEST_CONTRAST: Final = 0.01
"""Weber's fraction: a neighbourhood that varies less than this has no contrast to lose."""
STRAY: Final = 0.005
"""Light scattered in the eye and the room, relative to a perfect white; differences below it are invisible."""


@dataclass(frozen=True, slots=True)
class Adapted:
    """A target within reach, and how it got there.

    ``target`` (rows, columns, 3) float32 radiance; ``gain`` (rows, columns) float32 in (0, 1]
    ``before``, ``after``: the feasibility of the target as asked and as adapted
    """

    target: FloatImage
    gain: FloatImage
    before: Feasibility
    after: Feasibility


def adapt(
    transport: LightTransport,
    wanted: FloatImage,
    black: FloatImage,
    *,
    strength: float = 1.0,
    given_up: float = 0.0,
    drive: DriveLevels | None = None,
) -> Adapted:
    """Adapt ``wanted`` to the available light.

    Parameters
    ----------
    wanted, black : (rows, columns, 3) float32 radiance; ``wanted`` may be darker than ``black`` or brighter than T 1
    strength : from 0 (leave it, to be cut off) to 1 (wholly within reach); between them the gain is weakened
    given_up : share of the object's pixels, those that need most, that may be cut off all the same

    Raises UsageError "image-wrong-size", "target-not-finite" or "adapt-strength".
    """
    _check_strength(strength, given_up)
    drive = DriveLevels(transport) if drive is None else drive
    before = feasibility(transport, wanted, black, drive=drive)
    target, gain = _bent(wanted, black, drive, strength, given_up)
    return Adapted(target, gain, before, feasibility(transport, target, black, drive=drive))


def adapt_gently(
    transport: LightTransport,
    wanted: FloatImage,
    black: FloatImage,
    *,
    white: float,
    most: float = 1.0,
    drive: DriveLevels | None = None,
) -> tuple[Adapted, float, float]:
    """The adaptation that keeps most contrast, of a few up to strength ``most``; and the contrast cut off and adapted.

    A few highlights lose little when they are cut off, and to dim their surroundings for them would lose more: they are
    given up, or nothing is adapted at all. ``white`` as in ``contrast_kept``; errors as ``adapt``.
    """
    drive = DriveLevels(transport) if drive is None else drive
    before = feasibility(transport, wanted, black, drive=drive)
    reach = black + transport.reach()
    kept: list[tuple[float, FloatImage, FloatImage]] = []
    for strength, given_up in ((0.0, 0.0), *itertools.product(STRENGTHS, GIVEN_UP)):
        _check_strength(most * strength, given_up)
        target, gain = _bent(wanted, black, drive, most * strength, given_up)
        shown = np.clip(target, black, reach)
        kept.append((contrast_kept(shown, wanted, drive.mask, white=white), target, gain))
    contrast, target, gain = max(kept, key=lambda one: one[0])
    after = feasibility(transport, target, black, drive=drive)
    return Adapted(target, gain, before, after), kept[0][0], contrast


def _check_strength(strength: float, given_up: float) -> None:
    if not (0 <= strength <= 1 and 0 <= given_up < 1):
        raise UsageError(
            "adapt-strength",
            what=f"A contrast adaptation can't have strength {strength} and give up a share {given_up} of the pixels.",
            remedy="Give a strength from 0 to 1, and a share of given-up pixels from 0 to below 1.",
        )


def _bent(
    wanted: FloatImage, black: FloatImage, drive: DriveLevels, strength: float, given_up: float
) -> tuple[FloatImage, FloatImage]:
    """The bent target (rows, columns, 3) and the gain (rows, columns); arguments as ``adapt``."""
    lifted = _above_black(np.maximum(wanted, 0), black, strength)
    needed = drive.of(lifted - black).max(axis=2)
    needed = np.where(np.isfinite(needed), np.maximum(needed, 0), 0).astype(np.float32)
    if given_up > 0 and drive.mask.any():
        needed = np.minimum(needed, np.quantile(needed[drive.mask], 1 - given_up).astype(np.float32))
    gain = _gain(needed, drive.mask, strength)
    target = np.where(drive.mask[..., None], black + gain[..., None] * (lifted - black), wanted).astype(np.float32)
    return target, gain


def _above_black(wanted: FloatImage, black: FloatImage, strength: float) -> FloatImage:
    """A soft maximum of target and black image: black + t log(1 + exp((wanted - black) / t)), t a part of the black."""
    toe = np.maximum(np.float32(TOE * strength) * black, np.float32(1e-12))
    above = (wanted - black) / toe
    soft = np.where(above > 20, above, np.log1p(np.exp(np.minimum(above, 20))))
    # at the black image itself the soft maximum stands toe log 2 above; far above it nothing is added
    return np.asarray(black + toe * soft, np.float32)


def _gain(needed: FloatImage, mask: Mask, strength: float) -> FloatImage:
    """(rows, columns): one gain a neighbourhood, such that gain x needed stays below 1."""
    radius = max(round(max(mask.shape) * REACH / 2), WINDOW_MIN_PX)
    # the blur's window is inside the maximum's, so the envelope is never below the needed value
    largest = cv2.dilate(np.where(mask, needed, 0), np.ones((2 * radius + 1, 1), np.uint8))
    largest = cv2.dilate(largest, np.ones((1, 2 * radius + 1), np.uint8))
    size = 2 * (radius // 2) + 1
    envelope = np.asarray(cv2.blur(cv2.blur(largest, (size, size)), (size, size)), np.float32)
    gain = np.divide(_soft(envelope), envelope, out=np.ones_like(envelope), where=envelope > KNEE)
    return np.asarray(gain ** np.float32(strength), np.float32)


def _soft(value: FloatImage) -> FloatImage:
    """The identity up to ``KNEE``, then towards 1 with the same slope at the knee."""
    room = np.float32(1 - KNEE)
    above = np.maximum(value - np.float32(KNEE), 0) / room
    return np.asarray(np.minimum(value, np.float32(KNEE)) + room * (1 - np.exp(-above)), np.float32)


def contrast_kept(achieved: FloatImage, target: FloatImage, mask: Mask, *, white: float) -> float:
    """How much of the target's perceived local contrast a picture has, from 0 to 1.

    Contrast is the standard deviation of the logarithm of light within neighbourhoods of several sizes, as far as it
    goes along with the target's: detail that is not the target's doesn't count, nor does a neighbourhood's level.
    Radiance (rows, columns, 3); ``white`` is that of a perfect white. 1 for a target without any contrast.
    """
    ours, theirs = (_seen(image, white) for image in (achieved, target))
    kept = whole = 0.0
    present = mask.astype(np.float32)
    for sigma in sorted({max(scale * max(mask.shape), FINEST_PX) for scale in SCALES}):
        size = 2 * round(2 * sigma) + 1
        # the weight of neighbours on the object: the background must not count as contrast
        weight = np.maximum(cv2.blur(present, (size, size)), np.float32(1e-6))

        def mean(image: FloatImage, size: int = size, weight: FloatImage = weight) -> FloatImage:
            return np.asarray(cv2.blur(image * present, (size, size)) / weight, np.float32)

        a, b = mean(ours), mean(theirs)
        deviation = np.sqrt(np.maximum(mean(theirs * theirs) - b * b, 0))
        together = (mean(ours * theirs) - a * b) / np.maximum(deviation, np.float32(1e-6))
        counted = mask & (deviation > FAINTEST_CONTRAST)
        kept += float(np.clip(together[counted], 0, deviation[counted]).sum(dtype=np.float64))
        whole += float(deviation[counted].sum(dtype=np.float64))
    return kept / whole if whole > 0 else 1.0


def _seen(image: FloatImage, white: float) -> FloatImage:
    """Logarithm of the light: equal steps are equal ratios, which is what an eye adapted to the place compares."""
    return np.asarray(np.log(np.maximum(image.mean(axis=2) / np.float32(white), 0) + np.float32(STRAY)), np.float32)
