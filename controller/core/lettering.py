"""Letters in pictures and plots, in the typeface that ships with Velatura; the panel has it, too."""

from __future__ import annotations

import functools
from importlib import resources
from pathlib import Path
from typing import Any, Final

import numpy as np

from controller.core.arrays import ByteImage

NAME: Final = "Velatura Sans"
Colour = tuple[int, int, int]


def font_file() -> Path:
    """The typeface as a TrueType file."""
    return Path(str(resources.files("controller.core").joinpath("typeface", "velatura-sans.ttf")))


@functools.lru_cache(maxsize=32)
def _font(size_px: int) -> Any:
    from PIL import ImageFont

    return ImageFont.truetype(str(font_file()), size_px)


def text_size(text: str, size_px: int) -> tuple[int, int]:
    """(width, height) in pixels of a line of text, its height that of capital letters with descenders."""
    font = _font(max(4, size_px))
    ascent, descent = font.getmetrics()
    return round(font.getlength(text)), ascent + descent


def write(picture: ByteImage, text: str, at: tuple[int, int], size_px: int, colour: Colour) -> None:
    """Write a line of text into ``picture`` (rows, columns, 3) uint8; ``at``: left end and middle of its height.

    ``colour`` in the picture's own order of channels. What lies beyond the picture is cut off.
    """
    from PIL import Image, ImageDraw

    canvas = Image.fromarray(picture)
    ImageDraw.Draw(canvas).text(at, text, fill=colour, font=_font(max(4, size_px)), anchor="lm")
    picture[...] = np.asarray(canvas, np.uint8)


@functools.cache
def register_for_plots() -> str:
    """Make matplotlib know the typeface; its name there."""
    from matplotlib import font_manager

    font_manager.fontManager.addfont(font_file())
    return NAME
