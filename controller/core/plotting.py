"""Figures of matplotlib without a window, and letters in pictures, in the typeface that ships with Velatura.

matplotlib is imported with the first figure, so that other code does not wait for it.
"""

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


def figure_of(size_in: tuple[float, float], *, dpi: int, constrained: bool = False) -> Any:
    """An empty figure (width, height) in inches; ``constrained``: its parts do not overlap."""
    # Agg directly: pyplot would look for a window system, and keeps every figure in memory.
    import matplotlib as mpl
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    mpl.rcParams["font.family"] = [register_for_plots(), "DejaVu Sans"]
    figure = Figure(figsize=size_in, dpi=dpi, layout="constrained" if constrained else None)
    FigureCanvasAgg(figure)
    return figure


def picture_of(figure: Any) -> ByteImage:
    """(rows, columns, 3) uint8 RGB of a figure of ``figure_of``, whose background must be opaque."""
    figure.canvas.draw()
    return np.array(np.asarray(figure.canvas.buffer_rgba())[..., :3], np.uint8)
