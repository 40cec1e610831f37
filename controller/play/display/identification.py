"""The picture by which a technician finds out which projector is which, and whether its picture is whole and sharp."""

from __future__ import annotations

import unicodedata
from collections.abc import Sequence
from functools import cache
from importlib import resources
from typing import Any

import numpy as np
import numpy.typing as npt

from controller.play.frames import FrameSet, OutputSize

_FIRST, _LAST = " ", "~"
_CAPITAL_PX, _MIDDLE_PX, _MARGIN_PX = 56, 44, 6
"""In a letter's picture: the height of a capital, the row of its middle, and the black around it."""


@cache
def _letters() -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.uint8]]:
    """Pictures (characters, rows, columns) of the typeface, the share of ink as 0..255, and how wide each is."""
    letters = resources.files("controller.core").joinpath("typeface", "letters.npz")
    with letters.open("rb") as file, np.load(file) as kept:
        return kept["pictures"], kept["advances"]


def identification(outputs: Sequence[OutputSize]) -> FrameSet:
    """For each output a frame of one pixel, lines to the corners, steps of grey, its number (from 1), name and size."""
    return FrameSet(tuple(_picture(number, output) for number, output in enumerate(outputs, start=1)))


def _picture(number: int, output: OutputSize) -> npt.NDArray[np.uint8]:
    height, width = output.height_px, output.width_px
    image = np.zeros(output.shape, np.uint8)
    along = np.arange(max(width, height))
    rows, columns = along * height // len(along), along * width // len(along)
    image[rows, columns] = image[rows, width - 1 - columns] = 96
    band = height // 12
    if band:
        image[height - 2 * band : height - band] = (np.arange(width) * 16 // width * 17).astype(np.uint8)[None, :, None]
    write_text(image, str(number), centre_row=height * 2 // 5, tall_px=height // 2)
    write_text(image, output.name, centre_row=height * 3 // 4, tall_px=height // 14)
    write_text(image, f"{width}X{height}", centre_row=height // 10, tall_px=height // 14)
    image[[0, -1], :] = image[:, [0, -1]] = 255
    return image


def write_text(image: npt.NDArray[np.uint8], text: str, *, centre_row: int, tall_px: int) -> None:
    """Write white on black round the middle column, as tall as given or smaller where it would not fit."""
    pictures, advances = _letters()
    # A letter with an accent is its letter; what has no likeness here is a question mark.
    plain = [unicodedata.normalize("NFKD", character)[0] for character in text]
    places = [ord(one if _FIRST <= one <= _LAST else "?") - ord(_FIRST) for one in plain]
    line = np.concatenate([pictures[place][:, : advances[place]] for place in places] or [pictures[0][:, :1]], axis=1)
    ink = np.flatnonzero(line.any(axis=1))
    if not ink.size:
        return
    first = max(0, int(ink[0]) - _MARGIN_PX)
    line = line[first : ink[-1] + 1 + _MARGIN_PX]
    scale = min(tall_px / _CAPITAL_PX, (image.shape[1] - 2) / line.shape[1], (image.shape[0] - 2) / line.shape[0])
    rows, columns = round(line.shape[0] * scale), round(line.shape[1] * scale)
    if min(rows, columns) < 1:
        return
    block = _scaled(_scaled(line, rows).T, columns).T
    top = min(max(0, centre_row - round((_MIDDLE_PX - first) * scale)), image.shape[0] - rows)
    left = (image.shape[1] - columns) // 2
    image[top : top + rows, left : left + columns] = np.rint(block).astype(np.uint8)[:, :, None]


def _scaled(picture: npt.NDArray[Any], rows: int) -> npt.NDArray[np.float64]:
    """With so many rows, each the mean of those that it covers."""
    sums = np.insert(np.cumsum(picture, axis=0, dtype=np.float64), 0, 0, axis=0)
    edges = np.linspace(0, len(picture), rows + 1)
    low = np.minimum(edges.astype(int), len(picture) - 1)
    cut = sums[low] + (edges - low)[:, None] * (sums[low + 1] - sums[low])
    return np.asarray(np.diff(cut, axis=0) * rows / len(picture))
