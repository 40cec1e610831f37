"""Plots and maps of a calibration's report, dark as the page; drawn by matplotlib without any window."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any, Final

import matplotlib as mpl
import numpy as np
import numpy.typing as npt
from cycler import cycler

from controller.core.arrays import ByteImage, Float64, FloatImage
from controller.core.plotting import figure_of, picture_of

WIDE_IN, HIGH_IN, DPI = 7.2, 4.2, 100
BACK, INK, DIM = "#1a1815", "#ebe3d6", "#b1a696"
COLOURS: Final = ("#56b4e9", "#e69f00", "#009e73", "#cc79a7", "#f0e442", "#d55e00", "#0072b2")
"""Also distinguishable for colour-blind readers (Okabe and Ito)."""
STYLE: Final[Any] = {
    "figure.facecolor": BACK, "axes.facecolor": BACK, "savefig.facecolor": BACK, "axes.edgecolor": DIM,
    "axes.labelcolor": INK, "text.color": INK, "xtick.color": DIM, "ytick.color": DIM, "grid.color": "#332e27",
    "axes.grid": True, "axes.prop_cycle": cycler(color=list(COLOURS)), "legend.frameon": False, "font.size": 11,
    "axes.spines.top": False, "axes.spines.right": False, "lines.linewidth": 2.0,
}  # fmt: skip


def history(
    errors: Mapping[str, Sequence[float]],
    runs: Sequence[str],
    limit: float,
    *,
    label: str = "error of the prediction, %",
    unit: str = " %",
) -> ByteImage:
    """Each line's error in each run, oldest first, NaN where it has none, with the limit that is asked for."""

    def draw(axes: Any) -> None:
        for name, values in errors.items():
            axes.plot(range(len(runs)), values, marker="o", label=name)
        axes.axhline(limit, color="#f0876b", linestyle="--", label=f"limit {limit:g}{unit}")
        axes.set_xticks(range(len(runs)), [re.sub(r" [0-9]{4}, ", "\n", run) for run in runs])
        axes.set_ylim(bottom=0)
        axes.set_ylabel(label)
        axes.legend(ncols=2, fontsize=9)

    return _plot(draw)


def responses(curves: Mapping[str, Float64]) -> ByteImage:
    """(3, 256) linear light over device value a projector; the green channel, which is most of the light."""

    def draw(axes: Any) -> None:
        for name, curve in curves.items():
            axes.plot(np.arange(curve.shape[1]), curve[1], label=name)
        axes.set_xlabel("device value")
        axes.set_ylabel("linear light, share of white")
        axes.legend()

    return _plot(draw)


def sizes(widths_px: Mapping[str, npt.NDArray[np.floating[Any]]]) -> ByteImage:
    """How large a projector's pixels are in the camera's picture (standard deviation, camera pixels)."""
    top = max((float(np.percentile(values, 99)) for values in widths_px.values() if values.size), default=1.0)

    def draw(axes: Any) -> None:
        for name, values in widths_px.items():
            axes.hist(values, bins=60, range=(0, top), histtype="step", linewidth=2, label=name)
        axes.set_xlabel("size of a metapixel, camera pixels")
        axes.set_ylabel("metapixels")
        axes.legend()

    return _plot(draw)


def reasons(shares: Mapping[str, Mapping[str, float]]) -> ByteImage:
    """What share of the squared error each reason has, a bar a projector."""
    words = sorted({word for one in shares.values() for word in one})

    def draw(axes: Any) -> None:
        left = np.zeros(len(shares))
        for word in words:
            values = np.array([100 * one.get(word, 0.0) for one in shares.values()])
            axes.barh(range(len(shares)), values, left=left, label=word)
            left += values
        axes.set_yticks(range(len(shares)), list(shares))
        axes.invert_yaxis()
        axes.set_xlabel("share of the squared error, %")
        axes.grid(axis="y", visible=False)
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=3, fontsize=9)

    return _plot(draw)


def field(values: FloatImage, label: str, *, least: float | None = None, most: float | None = None) -> ByteImage:
    """A map (rows, columns), NaN left dark, with its scale beside it."""

    def draw(axes: Any) -> None:
        axes.grid(visible=False)
        shown = axes.imshow(np.ma.masked_invalid(values), cmap="viridis", vmin=least, vmax=most)
        axes.set_xticks([])
        axes.set_yticks([])
        for side in axes.spines.values():
            side.set_visible(False)
        bar = axes.figure.colorbar(shown, ax=axes, fraction=0.046, pad=0.03)
        bar.set_label(label)
        bar.outline.set_visible(False)

    return _plot(draw)


def _plot(draw: Any) -> ByteImage:
    with mpl.rc_context(STYLE):
        figure = figure_of((WIDE_IN, HIGH_IN), dpi=DPI, constrained=True)
        draw(figure.add_subplot())
        return picture_of(figure)
