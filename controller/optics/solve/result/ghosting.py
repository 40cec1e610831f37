"""Ghosting: how much of the object's own pattern shows in a result, where the target is out of reach.

The photograph's error and the object's reflectance are compared in the logarithm of light, as lightness and two
opponent colours (after Ruderman et al. 1998), in bands from 1 to 8 % of the picture: finer differences are edges that
no projector pixel can follow, wider ones are shading. Arrays in, arrays out (docs/decisions/0011).
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np

from controller.core.arrays import Float64, FloatImage, Mask
from controller.core.channels import finite

SIZES: Final = (0.01, 0.02, 0.04, 0.08)
"""Borders of the bands: sizes relative to the picture's longer side, an octave each."""
SIGMAS_A_SIZE: Final = 3.0
"""A spot of one size is mostly within so many standard deviations of its Gaussian."""
AROUND: Final = 0.03
"""So far around what is out of reach: a pattern shows where a part of it is in reach and its neighbour is not."""
STRAY: Final = 0.005
"""Light scattered in the eye, relative to white; differences below it are invisible."""
XYZ_TO_LMS: Final = np.array([[0.38971, 0.68898, -0.07868], [-0.22981, 1.1834, 0.04641], [0.0, 0.0, 1.0]])
"""Cones of the eye (Hunt, Pointer, Estevez)."""
OPPONENT: Final = np.array([[1, 1, 1], [1, 1, -2], [1, -1, 0]]) / np.sqrt([[3.0], [6.0], [2.0]])
LIGHTNESS, CHROMA, ALL = slice(0, 1), slice(1, 3), slice(0, 3)
LEAST_PIXELS: Final = 50
FAINTEST: Final = 1e-4
"""Standard deviation in a band (of the logarithm) below which an object has no pattern."""


@dataclass(frozen=True, slots=True)
class Ghost:
    """``correlation`` of the error with the object's pattern, 0 to 1; ``share`` of the pattern's contrast in it.

    A share of 1 is the object as it is; 0 is nothing of its own pattern.
    """

    correlation: float
    share: float


@dataclass(frozen=True, slots=True)
class Ghosting:
    """Of both together, of lightness, and of chroma; ``area``: share of the compared pixels that it was measured on."""

    both: Ghost
    lightness: Ghost
    chroma: Ghost
    area: float


def ghosting(
    photograph: FloatImage,
    asked: FloatImage,
    reflectance: FloatImage,
    camera_to_xyz: Float64,
    white: float,
    mask: Mask,
    lacking: Mask,
) -> Ghosting | None:
    """Ghosting in a ``photograph`` of a target.

    Parameters
    ----------
    photograph, asked : (rows, columns, 3) radiance; ``asked``: the target before any adaptation
    reflectance : (rows, columns, 3) of the object in even white light, 1 for white; NaN where it is not known
    white : radiance of the target's white, > 0
    mask, lacking : (rows, columns) bool: what is compared, and what of it is out of reach

    Returns None where nothing (or too little) is out of reach, or the object has no pattern there.
    """
    known = mask & finite(reflectance) & finite(photograph)
    where = known & _around(known & lacking)
    if where.sum() < LEAST_PIXELS or not (known & lacking).any():
        return None
    box = _box(known)  # beyond it there is nothing to compare
    error = opponent(photograph[box], camera_to_xyz, white) - opponent(asked[box], camera_to_xyz, white)
    own = opponent(reflectance[box], camera_to_xyz, 1.0)
    inside, longest = where[box], max(mask.shape)
    pairs = [
        tuple(band[inside] - band[inside].mean(axis=0) for band in both)
        for both in _bands((error, own), known[box], longest)
    ]
    if sum(float((pattern**2).mean()) for _, pattern in pairs) < FAINTEST**2:
        return None
    both, lightness, chroma = (
        _ghost([(e[:, part], o[:, part]) for e, o in pairs]) for part in (ALL, LIGHTNESS, CHROMA)
    )
    return Ghosting(both, lightness, chroma, float(where.sum() / mask.sum()))


def opponent(image: FloatImage, camera_to_xyz: Float64, white: float) -> FloatImage:
    """(rows, columns, 3) lightness, yellow against blue, and red against green, of the logarithm of cones' light."""
    matrix = XYZ_TO_LMS @ camera_to_xyz
    matrix = matrix / (matrix.sum(axis=1, keepdims=True) * white)
    cones = np.nan_to_num(image).astype(np.float32) @ matrix.T.astype(np.float32)
    logarithm = np.log(np.maximum(cones, 0) + np.float32(STRAY))
    return np.asarray(logarithm @ OPPONENT.T.astype(np.float32), np.float32)


def _around(lacking: Mask) -> Mask:
    side = 2 * round(AROUND * max(lacking.shape)) + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    return np.asarray(cv2.dilate(lacking.astype(np.uint8), disc) > 0)


def _box(mask: Mask) -> tuple[slice, slice]:
    """The rows and columns of a mask with a pixel."""
    rows, columns = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
    return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)


def _bands(images: Sequence[FloatImage], mask: Mask, longest_px: int) -> Iterator[list[FloatImage]]:
    """Of each image, differences of Gaussian means over the mask alone; ``longest_px``: the whole picture's side."""
    weight = mask.astype(np.float32)
    weighted = [np.where(mask[..., None], image, np.float32(0)) for image in images]
    means = []
    for size in SIZES:
        sigma = size * longest_px / SIGMAS_A_SIZE
        share, *totals = (
            cv2.GaussianBlur(part, (0, 0), sigma, borderType=cv2.BORDER_CONSTANT) for part in (weight, *weighted)
        )
        means.append([total / np.maximum(share, np.float32(1e-4))[..., None] for total in totals])
    for finer, wider in itertools.pairwise(means):
        yield [np.asarray(fine - wide, np.float32) for fine, wide in zip(finer, wider, strict=True)]


def _ghost(pairs: list[tuple[FloatImage, FloatImage]]) -> Ghost:
    """What of each band's error goes along with the pattern of that band, all bands together."""
    along = errors = patterns = 0.0
    for error, pattern in pairs:
        of_pattern = float((pattern.astype(np.float64) ** 2).sum())
        errors += float((error.astype(np.float64) ** 2).sum())
        patterns += of_pattern
        if of_pattern > 0:
            along += float((error.astype(np.float64) * pattern).sum()) ** 2 / of_pattern
    if not (errors > 0 and patterns > FAINTEST**2 * len(pairs[0][1])):
        return Ghost(0.0, 0.0)
    return Ghost((along / errors) ** 0.5, (along / patterns) ** 0.5)
