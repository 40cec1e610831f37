"""Pictures for pages: strips of crops, maps with a scale, curves; small enough to be kept in the repository."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from matplotlib.ticker import MaxNLocator

from controller.core.arrays import ByteImage, Float64, FloatImage, Mask
from controller.core.plotting import figure_of, picture_of, write
from controller.stage.report.pictures import Crop, crop_around, fitted, to_screen

LARGEST_BYTES = 190_000
"""Of a picture file; a larger one is encoded with less quality, then made smaller."""
LABEL_PX = 22
DPI = 110
_BACKGROUND = (255, 255, 255)
_MARKERS = "os^Dv<>PX*"


@dataclass(frozen=True, slots=True)
class LabelledPicture:
    """One picture of a strip: (rows, columns, 3) uint8, and the words above it."""

    label: str
    picture: ByteImage


def screen(image: FloatImage, camera_to_xyz: Float64, white: float, crop: Crop) -> ByteImage:
    """A radiance picture as a screen shows it, cut to ``crop``."""
    cut = np.ascontiguousarray(image[crop.rows, crop.columns])
    return to_screen(cut, camera_to_xyz, white=white)


def detail(mask: Mask, *, centre: tuple[float, float], size_px: int) -> Crop:
    """A square of ``size_px`` with its middle at a share (down, across) of the object's box, inside the picture."""
    box = crop_around(mask, margin=0.0)
    y = box.rows.start + centre[0] * (box.rows.stop - box.rows.start)
    x = box.columns.start + centre[1] * (box.columns.stop - box.columns.start)
    top = int(np.clip(y - size_px / 2, 0, max(mask.shape[0] - size_px, 0)))
    left = int(np.clip(x - size_px / 2, 0, max(mask.shape[1] - size_px, 0)))
    return Crop(slice(top, top + size_px), slice(left, left + size_px))


def strip(panels: Sequence[LabelledPicture], *, columns: int, width_px: int = 1200) -> ByteImage:
    """Panels of one size in rows of ``columns``, each with its label above; enlarged ones keep their pixels' edges."""
    cell = max(1, (width_px - 4 * (columns - 1)) // columns)
    drawn = [_labelled(panel, cell) for panel in panels]
    high = max(part.shape[0] for part in drawn)
    rows = []
    for start in range(0, len(drawn), columns):
        row = np.full((high, columns * (cell + 4) - 4, 3), _BACKGROUND, np.uint8)
        for place, part in enumerate(drawn[start : start + columns]):
            left = place * (cell + 4)
            row[: part.shape[0], left : left + cell] = part
        rows.append(row)
    return np.concatenate(rows, axis=0)


def _labelled(panel: LabelledPicture, width: int) -> ByteImage:
    rows, columns = panel.picture.shape[:2]
    factor = width / columns
    how = cv2.INTER_AREA if factor < 1 else cv2.INTER_NEAREST
    picture = cv2.resize(panel.picture, (width, max(1, round(rows * factor))), interpolation=how)
    head = np.full((LABEL_PX, width, 3), _BACKGROUND, np.uint8)
    write(head, panel.label, (2, LABEL_PX // 2), 15, (20, 20, 20))
    return np.concatenate([head, np.asarray(picture, np.uint8)], axis=0)


def encoded_webp(picture: ByteImage, *, longest_px: int = 1400) -> bytes:
    """A picture as WebP bytes, no larger than ``LARGEST_BYTES``."""
    data = b""
    while longest_px > 200:
        image = np.ascontiguousarray(fitted(picture, longest_px=longest_px)[..., ::-1])
        for quality in (88, 75, 60):
            ok, encoded = cv2.imencode(".webp", image, [cv2.IMWRITE_WEBP_QUALITY, quality])
            assert ok
            data = bytes(encoded.tobytes())
            if len(data) <= LARGEST_BYTES:
                return data
        longest_px = int(0.8 * longest_px)
    return data


@dataclass(frozen=True, slots=True)
class Line:
    """A curve: its name, positions and values; ``style`` as matplotlib's, or nothing: each line has its own marker."""

    name: str
    x: Sequence[float] | Float64
    y: Sequence[float] | Float64
    style: str = ""


Marks = Mapping[str, tuple[str, float]]
"""Label -> ("x" or "y", value): thin lines across."""
Range = tuple[float | None, float | None]
"""Least and most of an axis; None: as the values are."""


def plotted(
    lines: Sequence[Line], *, x: str, y: str, marks: Marks | None = None, y_range: Range | None = None
) -> ByteImage:
    """Curves as a picture, with their names beside it, where they hide nothing."""
    figure = figure_of((9.6, 4.0), dpi=DPI, constrained=True)
    axes = figure.add_subplot()
    _curves(axes, lines, marks or {}, y_range)
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    figure.legend(loc="outside right upper", fontsize=8, frameon=False)
    return picture_of(figure)


@dataclass(frozen=True, slots=True)
class SmallPlot:
    """One of several plots side by side: its ``title``, what is along ``x``, and its own curves and marks."""

    title: str
    x: str
    lines: Sequence[Line]
    marks: Marks


def small_plots(plots: Sequence[SmallPlot], *, y: str, y_range: Range, columns: int = 3) -> ByteImage:
    """Plots of one y axis side by side. A name that several use is explained once."""
    rows = -(-len(plots) // columns)
    figure = figure_of((9.6, 2.3 * rows + 0.4), dpi=DPI, constrained=True)
    grid = figure.subplots(rows, columns, squeeze=False, sharey=True)
    named: dict[str, Any] = {}
    for place, axes in enumerate(grid.ravel()):
        if place >= len(plots):
            axes.axis("off")
            continue
        one = plots[place]
        _curves(axes, one.lines, one.marks, y_range)
        axes.set_title(one.title, fontsize=9)
        axes.set_xlabel(one.x, fontsize=8)
        axes.tick_params(labelsize=8)
        named |= {name: drawn for drawn, name in zip(*axes.get_legend_handles_labels(), strict=True)}
    figure.supylabel(y, fontsize=9)
    figure.legend(list(named.values()), list(named), loc="outside upper center", ncols=len(named), fontsize=8,
                  frameon=False)  # fmt: skip
    return picture_of(figure)


def _curves(axes: Any, lines: Sequence[Line], marks: Marks, y_range: Range | None) -> None:
    for number, line in enumerate(lines):
        style = line.style or f"-{_MARKERS[number % len(_MARKERS)]}"
        axes.plot(line.x, line.y, style, label=line.name, markersize=4, linewidth=1.3, alpha=0.9)
    for number, (label, (axis, value)) in enumerate(marks.items()):
        draw = axes.axvline if axis == "x" else axes.axhline
        draw(value, color="0.35", linewidth=0.9, linestyle=("--", ":", "-.")[number % 3], label=label)
    if all(float(place).is_integer() for line in lines for place in line.x):
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    if y_range is not None:
        axes.set_ylim(*y_range)
        bottom, top = axes.get_ylim()
        if y_range[1] is None:  # by itself matplotlib's margin is of the data's range, too little above a whole marker
            axes.set_ylim(top=top + 0.04 * (top - bottom))
    axes.grid(True, color="0.9", linewidth=0.6)


def maps(
    panels: Mapping[str, FloatImage], *, low: float, high: float, label: str, colours: str = "viridis", columns: int = 2
) -> ByteImage:
    """Maps (rows, columns), NaN grey, side by side with one scale of colours."""
    rows = -(-len(panels) // columns)
    shape = next(iter(panels.values())).shape
    height = 3.6 * shape[0] / shape[1] * rows + 0.35 * rows
    figure = figure_of((3.6 * columns + 1.0, max(height, 1.6)), dpi=DPI, constrained=True)
    grid = figure.subplots(rows, columns, squeeze=False)
    drawn = None
    for place, axes in enumerate(grid.ravel()):
        axes.axis("off")
        if place < len(panels):
            name = list(panels)[place]
            axes.set_title(name, fontsize=9)
            shown = np.ma.masked_invalid(panels[name])
            axes.imshow(np.full((*shape, 3), 0.88), interpolation="nearest")
            drawn = axes.imshow(shown, vmin=low, vmax=high, cmap=colours, interpolation="nearest")
    bar = figure.colorbar(drawn, ax=list(grid.ravel()), shrink=0.8, pad=0.02)
    bar.set_label(label, fontsize=9)
    return picture_of(figure)
