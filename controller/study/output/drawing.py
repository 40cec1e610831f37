"""Pictures for pages: strips of crops, maps with a scale, curves; small enough to be kept in the repository."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter

from controller.core.arrays import ByteImage, Float64, FloatImage, Mask
from controller.core.lettering import write
from controller.core.plotting import figure_of, picture_of
from controller.report.pictures import Crop, crop_around, fitted, to_screen

LARGEST_BYTES = 190_000
"""Of a picture file; a larger one is encoded with less quality, then made smaller."""
LABEL_PX = 22
DPI = 110
_BACKGROUND = (255, 255, 255)


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
    """A curve: its name, positions and values; ``style`` as matplotlib's."""

    name: str
    x: Sequence[float] | Float64
    y: Sequence[float] | Float64
    style: str = "-o"


def plotted(
    lines: Sequence[Line],
    *,
    x: str,
    y: str,
    marks: Mapping[str, tuple[str, float]] | None = None,
    log_y: bool = False,
    y_range: tuple[float, float] | None = None,
) -> ByteImage:
    """Curves as a picture. ``marks``: label -> ("x" or "y", value), drawn as thin lines across."""
    figure = figure_of((7.2, 4.0), dpi=DPI)
    axes = figure.add_subplot()
    for line in lines:
        axes.plot(line.x, line.y, line.style, label=line.name, markersize=3, linewidth=1.3)
    for label, (axis, value) in (marks or {}).items():
        draw = axes.axvline if axis == "x" else axes.axhline
        draw(value, color="0.45", linewidth=0.8, linestyle="--", label=label)
    if log_y:
        axes.set_yscale("log")
        axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 3, 5, 7)))
        axes.yaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_minor_formatter(NullFormatter())
    if all(float(place).is_integer() for line in lines for place in line.x):
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    if y_range is not None:
        axes.set_ylim(*y_range)
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.grid(True, color="0.9", linewidth=0.6)
    axes.legend(fontsize=8, frameon=False)
    figure.tight_layout()
    return picture_of(figure)


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
