"""Light by way of other surfaces, seen where coarse stripes are dark: what each part of a picture alone throws back.

White images say how much indirect light there is, but not whether object or room throws it back. The Gray code's coarse
stripes, which are photographed anyway, light one half or quarter of the picture: all light between them is indirect.
"""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np

from controller.core.arrays import FloatImage, Mask
from controller.core.channels import finite
from controller.optics.calibrate.correspondence.captures import Captures, coloured
from controller.optics.capture.pattern_frames import frame
from controller.optics.capture.patterns import Pattern, PatternPlan
from controller.optics.transport.indirect.blocks import down

BLOCKS: Final = 1200
"""About so many in the whole picture."""
ENOUGH_PIXELS: Final = 400_000
COARSE_BITS: Final = 3
"""Of each axis: finer stripes light all surfaces alike."""
CLEAR_PX: Final = 6
"""Projector pixels from the nearest stripe: blur reaches no farther."""


def blocks_of(shape: tuple[int, ...]) -> tuple[tuple[int, int], int]:
    """(rows, columns) of the blocks of a camera picture of ``shape``, and camera pixels along a block."""
    stride = stride_of(shape)
    side = stride * max(1, round(float(np.sqrt(shape[0] * shape[1] / BLOCKS)) / stride))
    return (-(-shape[0] // side), -(-shape[1] // side)), side


def stride_of(shape: tuple[int, ...]) -> int:
    """Every so many camera pixels stand for all where stripes are looked at; blocks are a multiple of it."""
    return max(1, round(float(np.sqrt(shape[0] * shape[1] / ENOUGH_PIXELS))))


def coarse_stripes(plan: PatternPlan) -> tuple[Pattern, ...]:
    """The patterns whose dark parts tell; none where the code is shown in colours."""
    return tuple(pattern for axis in (0, 1) for pattern in plan.gray(axis)[:COARSE_BITS])


def stripe_parts(pattern: Pattern, size_px: tuple[int, int], position_px: FloatImage) -> tuple[FloatImage, Mask]:
    """(rows, columns): the pattern's light, 0 to 1, where camera pixels look, and where they see none of it directly.

    ``size_px`` (width, height) of the projector; ``position_px`` (rows, columns, 2), NaN where not known
    """
    lit = frame(pattern, size_px)
    near = cv2.dilate(lit, np.ones((2 * CLEAR_PX + 1,) * 2, np.uint8))
    known: Mask = finite(position_px)
    at = np.where(known[..., None], position_px, np.float32(-1e4)).astype(np.float32)
    shown, around = (
        cv2.remap(image, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=beyond)
        for image, beyond in ((lit, 0.0), (near, 1.0))
    )
    return np.asarray(shown, np.float32), np.asarray(known & (around < 0.01))


def dark_light(captures: Captures, plan: PatternPlan, position_px: FloatImage) -> FloatImage | None:
    """(patterns, blocks, 3): the light of blocks in the dark parts of each coarse pattern, mean over the whole block.

    ``captures``: linear photographs in one unit, with ``black`` and ``gray-*``; what is not measured counts as dark.
    Of the pixels that ``thinned`` keeps. None where the plan shows no such patterns.

    Raises CalibrationError as ``coloured``.
    """
    shape = position_px.shape[:2]
    stride, (grid, side) = stride_of(shape), blocks_of(shape)
    black, at = thinned(coloured(captures, "black", (shape[0], shape[1])), stride), thinned(position_px, stride)
    found = []
    for pattern in coarse_stripes(plan):
        dark = stripe_parts(pattern, plan.size_px, at)[1]
        light = np.nan_to_num(thinned(coloured(captures, pattern.name, (shape[0], shape[1])), stride) - black)
        kept = np.where(dark[..., None], light, np.float32(0)).astype(np.float32)
        found.append(down(kept, grid, side // stride))
    return np.stack(found) if found else None


def thinned(image: FloatImage, stride: int) -> FloatImage:
    """Every ``stride``-th pixel of an image (rows, columns, k)."""
    return np.ascontiguousarray(image[::stride, ::stride], np.float32)
