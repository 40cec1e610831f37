"""How projectors and camera are aimed, from a few photographs and before anything is calibrated.

Each projector shows a chequerboard and its inverse. Their sum is its white; their difference, over that, is how much of
the board survives on the way: the more, the sharper.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np

from controller.core import channels
from controller.core.arrays import ByteImage, FloatImage, Mask

SQUARE_PX: Final = 3
"""Side of the board's squares, in projector pixels."""
SHARP: Final = 0.65
"""Mean of the difference over the sum in a board whose edges are as sharp as pixels."""
LIT_SHARE: Final = 0.03
"""Of the brightest white, above which a place counts as lit."""
DARK_SHARE: Final = 0.1
"""Of the usual white of all projectors, below which a place is too dark to work with."""
SOFT: Final = 0.2
"""Sharpness below which neither patterns nor appearances have detail: out of focus, or grazing light."""


LEVELS: Final = 32
EDGES: Final = ((255, 255, 255), (109, 179, 242), (127, 201, 139), (229, 143, 208))
"""Colours of the projectors' outlines, in turn, as in the page's legend."""


@dataclass(frozen=True, slots=True)
class AimedProjector:
    """``coverage`` the share of the object that it lights; ``focus`` its sharpness there, of the sharper part, because
    a wall behind the object is out of focus; both 0..1.
    """

    coverage: float
    focus: float


@dataclass(frozen=True, slots=True)
class Aim:
    """Shares are of the object: what any projector lights.

    ``overlap`` lit by two or more; ``too_dark`` below a tenth of the usual light; ``too_soft`` lit, and sharp from no
    projector; ``camera_focus`` the sharpest that the camera sees anywhere, 0..1; ``seen`` how many projectors light
    each camera pixel, (rows, columns) uint8; ``lit`` (projectors, rows, columns) where each does; ``dark`` and ``soft``
    the places of the shares
    """

    projectors: tuple[AimedProjector, ...]
    overlap: float
    too_dark: float
    too_soft: float
    camera_focus: float
    seen: ByteImage
    dark: Mask
    soft: Mask
    lit: Mask


def checkerboard(size_px: tuple[int, int], *, inverse: bool) -> ByteImage:
    """The chequerboard for an output of (width, height), (rows, columns, 3) uint8 device values."""
    rows, columns = np.indices((size_px[1], size_px[0])) // SQUARE_PX
    white = ((rows + columns) % 2 == 0) ^ inverse
    return np.repeat((255 * white).astype(np.uint8)[..., None], 3, axis=2)


def assess_aim(black: FloatImage, boards: Sequence[tuple[FloatImage, FloatImage]]) -> Aim:
    """From the photographs (rows, columns, 3), linear at one exposure, NaN where saturated, of black and of each
    projector's board and its inverse.
    """
    dark = _grey(black)
    light, sharpness = [], []
    for one, other in boards:
        first, second = _grey(one) - dark, _grey(other) - dark
        light.append(np.maximum(first + second, 0))
        left = _smooth(np.abs(first - second)) / np.maximum(_smooth(light[-1]), 1e-9)
        sharpness.append(np.clip(left / SHARP, 0, 1))
    brightest = max(float(np.percentile(part, 99.5)) for part in light)
    lit = np.stack([part > LIT_SHARE * brightest for part in light])
    thing = lit.any(axis=0)
    area = max(1, int(np.count_nonzero(thing)))
    sharp = np.stack(sharpness)
    total = np.sum(light, axis=0)
    usual = float(np.median(total[thing])) if thing.any() else 1.0
    too_dark = thing & (total < DARK_SHARE * usual)
    soft = thing & (np.where(lit, sharp, 0).max(axis=0) < SOFT)
    projectors = tuple(
        AimedProjector(float(np.count_nonzero(on) / area), float(np.percentile(value[on], 75)) if on.any() else 0.0)
        for on, value in zip(lit, sharp, strict=True)
    )
    seen = lit.sum(axis=0).astype(np.uint8)
    best = float(np.percentile(sharp[lit], 99)) if lit.any() else 0.0
    return Aim(
        projectors, float(np.count_nonzero(seen >= 2) / area), float(np.count_nonzero(too_dark) / area),
        float(np.count_nonzero(soft) / area), best, seen, too_dark, soft, lit,
    )  # fmt: skip


def aim_overview(picture: FloatImage, aim: Aim) -> ByteImage:
    """What the camera saw in white, with its faults in colour: red too dark, blue too soft, amber lit by one alone.

    A line in a colour of its own goes around what each projector lights (``EDGES``).
    """
    level = np.nan_to_num(_grey(picture), nan=1.0)
    grey = np.clip(level / max(float(np.percentile(level, 99.5)), 1e-9), 0, 1) ** (1 / 2.2)
    image = np.repeat((215 * grey).astype(np.uint8)[..., None], 3, axis=2)
    for where, colour in ((aim.seen == 1, (240, 179, 90)), (aim.soft, (90, 140, 255)), (aim.dark, (255, 80, 70))):
        image[where] = (0.55 * image[where] + 0.45 * np.array(colour)).astype(np.uint8)
    wide = max(1, round(max(image.shape) / 400))
    for number, part in enumerate(aim.lit):
        square = np.ones((4 * wide + 1, 4 * wide + 1), np.uint8)
        closed = cv2.morphologyEx(part.astype(np.uint8), cv2.MORPH_CLOSE, square)
        lines, _ = cv2.findContours(closed, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(image, lines, -1, EDGES[number % len(EDGES)], wide)
    return image


def levels(picture: FloatImage, aim: Aim) -> tuple[tuple[float, ...], float]:
    """Of the object in a photograph (rows, columns, 3): shares of its pixels by their brightest channel, dark first and
    evenly spaced to the eye, and the share at the camera's limit (NaN in the photograph).
    """
    top = picture[aim.lit.any(axis=0)].max(axis=1, initial=0) if aim.lit.any() else np.zeros(0, np.float32)
    known = np.nan_to_num(top, nan=1.0)
    counts, _ = np.histogram(np.clip(known, 0, 1) ** (1 / 2.2), bins=LEVELS, range=(0, 1))
    size = max(1, known.size)
    return tuple(float(count / size) for count in counts), float(np.count_nonzero(np.isnan(top)) / size)


def _grey(image: FloatImage) -> FloatImage:
    # What was saturated is bright enough for anything that is asked here.
    return np.asarray(channels.mean(np.nan_to_num(image, nan=1.0)), np.float32)


def _smooth(image: FloatImage) -> FloatImage:
    """Over some squares of the board, as the camera sees them."""
    sigma = max(image.shape) / 100
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma), np.float32)
