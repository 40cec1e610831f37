"""Draws the patterns: as linear light, and as the device values that a projector shows."""

from __future__ import annotations

import math
from typing import Final

import cv2
import numpy as np

from controller.core.arrays import ByteImage, FloatImage
from controller.core.errors import UsageError
from controller.optics.capture.encoding import encode_frame
from controller.optics.capture.patterns import CELL_PX, Pattern, PatternKind, cells_of_frame

PARTS_ACROSS: Final = 8
"""Of the grade's pattern: so many large bright and dark parts along its longer side, about."""
DARKEST, STEEPNESS, OWN_COLOUR = 0.05, 4.0, 0.5
"""Light of the dark ones, how sharp their borders are, and how much colours differ."""


def frame(pattern: Pattern, size_px: tuple[int, int]) -> FloatImage:
    """The pattern as linear light.

    Returns
    -------
    float32 in [0, 1], (rows, columns) where the pattern is grey, (rows, columns, 3) where it is coloured

    Raises UsageError("mosaic-has-no-light") for COLOUR_TILES, whose light is what is to be measured.
    """
    width, height = size_px
    x, y = np.arange(width, dtype=np.float64)[None, :], np.arange(height, dtype=np.float64)[:, None]
    match pattern.kind:
        case PatternKind.FLAT:
            return np.full((height, width, 3), pattern.colour, np.float32)
        case PatternKind.GRAY:
            line = _gray_line(pattern, (width, height)[pattern.axis])
            across = line[None, :] if pattern.axis == 0 else line[:, None]
            return np.broadcast_to(across, (height, width)).copy()
        case PatternKind.COLOUR_GRAY:
            image = np.zeros((height, width, 3), np.float32)
            for channel, place in enumerate(pattern.coloured_bits):
                if place is not None:
                    axis, bit, bits = place
                    one = Pattern("", PatternKind.GRAY, axis=axis, bit=bit, bits=bits)
                    image[..., channel] = frame(one, size_px)
            return image
        case PatternKind.SINUSOID:
            angle = 2 * np.pi * (pattern.frequency[0] * x + pattern.frequency[1] * y) - pattern.phase_rad
            return (0.5 + 0.5 * np.cos(angle)).astype(np.float32)
        case PatternKind.RANDOM:
            image = _random_image(pattern.seed, size_px)
            return image * _large_parts(pattern.seed, size_px) if pattern.coarse else image
        case PatternKind.COLOUR_TILES:
            raise UsageError(
                "mosaic-has-no-light",
                what=f"Pattern {pattern.name} is given in device values; its light is not known.",
                remedy="Use device_frame for it.",
            )


def device_frame(
    pattern: Pattern,
    size_px: tuple[int, int],
    response: np.ndarray[tuple[int, ...], np.dtype[np.float64]] | None = None,
) -> ByteImage:
    """The pattern as (rows, columns, 3) uint8 device values.

    ``response`` (3, 256) is needed only where ``pattern.needs_response``; without it UsageError("response-missing").
    """
    width, height = size_px
    if pattern.kind is PatternKind.COLOUR_TILES:
        cells = tile_levels(pattern, size_px)
        return np.repeat(np.repeat(cells, CELL_PX, axis=0), CELL_PX, axis=1)[:height, :width].copy()
    light = frame(pattern, size_px)
    if light.ndim == 2:
        light = np.broadcast_to(light[:, :, None], (height, width, 3))
    if not pattern.needs_response:
        return (light > 0.5).astype(np.uint8) * np.uint8(255)
    if response is None:
        raise UsageError(
            "response-missing",
            what=f"Pattern {pattern.name} can't be shown before the projector's response is measured.",
            remedy="Capture the colour tiles first.",
        )
    return encode_frame(np.ascontiguousarray(light), response)


def _gray_line(pattern: Pattern, pixels: int) -> FloatImage:
    cell = np.arange(pixels) // CELL_PX
    code = cell ^ (cell >> 1)
    return ((code >> (pattern.bits - 1 - pattern.bit)) & 1).astype(np.float32)


def _random_image(seed: int, size_px: tuple[int, int]) -> FloatImage:
    """Coloured blocks over smooth noise: every frequency that an appearance may hold, none of them in step."""
    width, height = size_px
    random = np.random.default_rng(seed + 7919)
    blocks = random.random((height // 6 + 1, width // 6 + 1, 3), dtype=np.float32)
    image = 0.4 * np.repeat(np.repeat(blocks, 6, axis=0), 6, axis=1)[:height, :width]
    for sigma_px, share in ((1.5, 0.3), (12.0, 0.3)):
        noise = cv2.GaussianBlur(random.standard_normal((height, width, 3), dtype=np.float32), (0, 0), sigma_px)
        image += share * np.clip(0.5 + 0.25 * noise / noise.std(), 0, 1)
    return np.ascontiguousarray(np.clip(image, 0, 1), dtype=np.float32)


def _large_parts(seed: int, size_px: tuple[int, int]) -> FloatImage:
    """Factors of large parts, a tenth of the picture wide and more, in each channel some of its own."""
    width, height = size_px
    random = np.random.default_rng(seed + 15485863)
    side = max(width, height) / PARTS_ACROSS
    parts = random.standard_normal((4, math.ceil(height / side) + 3, math.ceil(width / side) + 3), dtype=np.float32)
    parts = np.stack([OWN_COLOUR * own + parts[3] for own in parts[:3]], axis=2)
    rows, columns = parts.shape[:2]
    grown = cv2.resize(parts, (round(columns * side), round(rows * side)), interpolation=cv2.INTER_CUBIC)
    first = round(side)
    inside = grown[first : first + height, first : first + width]
    return np.asarray(DARKEST + (1 - DARKEST) / (1 + np.exp(-STEEPNESS * inside)), np.float32)


def tile_levels(pattern: Pattern, size_px: tuple[int, int]) -> ByteImage:
    """(cells down, cells across, 3) uint8: the device values of COLOUR_TILES in each Gray cell.

    In each channel every level comes equally often (0 and 255 a little more), in its own order: the channels
    are independent, and the mean light of the tiles is the same everywhere.
    """
    across, down = cells_of_frame(size_px)
    side = pattern.tile_cells
    tiles = (-(-down // side), -(-across // side))
    random = np.random.default_rng(pattern.seed + 104729)
    number = tiles[0] * tiles[1]
    even = np.clip(np.rint(np.linspace(-8, 263, number)), 0, 255).astype(np.uint8)
    levels = np.stack([random.permutation(even) for _ in range(3)], axis=-1).reshape(*tiles, 3)
    return np.repeat(np.repeat(levels, side, axis=0), side, axis=1)[:down, :across]
