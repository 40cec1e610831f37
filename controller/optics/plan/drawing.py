"""A plan's pictures: who stands where, and what the object gets, as the audience sees it."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any, Final, ParamSpec

import numpy as np

from controller.core.arrays import ByteImage, Float64
from controller.core.plotting import figure_of, picture_of
from controller.optics.plan.values import Placement, Surface

Arguments = ParamSpec("Arguments")
BACK, INK, DIM, LINE = "#17181b", "#e8e6e1", "#9b9890", "#34363b"
COLOURS: Final = ("#f0a35e", "#6db3f2", "#7fc98b", "#d58ad8", "#e5d36b", "#f0876b", "#8fd6d0", "#b5a7f0")
DPI: Final = 150
STYLE: Final[Any] = {
    "figure.facecolor": BACK, "axes.facecolor": BACK, "text.color": INK, "axes.edgecolor": LINE,
    "axes.labelcolor": DIM, "xtick.color": DIM, "ytick.color": DIM, "font.size": 10.0,
}  # fmt: skip


def _in_style(draw: Callable[Arguments, ByteImage]) -> Callable[Arguments, ByteImage]:
    """The whole drawing in our colours; matplotlib is imported by the first."""

    @functools.wraps(draw)
    def drawn(*args: Arguments.args, **kwargs: Arguments.kwargs) -> ByteImage:
        import matplotlib as mpl

        with mpl.rc_context(STYLE):
            return draw(*args, **kwargs)

    return drawn


@_in_style
def layout(placements: Sequence[Placement], surface: Surface, audience_m: Float64) -> ByteImage:
    """The room from above and from the right: object, projectors with their cones of light, and the audience."""
    figure = figure_of((10.0, 4.6), dpi=DPI, constrained=True)
    above, side = figure.subplots(1, 2)
    _room(above, placements, surface, audience_m, across=0, up=2, sign=1.0)
    _room(side, placements, surface, audience_m, across=2, up=1, sign=-1.0)
    above.set(title="from above", xlabel="to the right (m)", ylabel="away from the audience (m)")
    side.set(title="from the right", xlabel="away from the audience (m)", ylabel="up (m)")
    return picture_of(figure)


@_in_style
def value_map(values: Float64, title: str, unit: str, *, lowest: float, highest: float) -> ByteImage:
    """``values`` (rows, columns), NaN beside the object, as colours from ``lowest`` to ``highest`` with their scale."""
    rows, columns = values.shape
    figure = figure_of((1.1 + 2.9 * columns / rows, 3.1), dpi=DPI, constrained=True)
    axes = figure.add_subplot()
    shown = axes.imshow(values, vmin=lowest, vmax=highest, cmap="viridis", interpolation="nearest")
    axes.set_title(title)
    axes.set_axis_off()
    bar = figure.colorbar(shown, ax=axes, fraction=0.05, pad=0.03)
    bar.set_label(unit)
    bar.outline.set_edgecolor(LINE)
    return picture_of(figure)


def _room(
    axes: Any, placements: Sequence[Placement], surface: Surface, audience_m: Float64, *, across: int, up: int,
    sign: float,
) -> None:  # fmt: skip
    """One projection of the room; ``sign`` turns what points down."""
    seen = surface.points_m[surface.area_m2 > 0]
    axes.plot(seen[:, across], sign * seen[:, up], ".", color=DIM, markersize=1.2)
    axes.plot(audience_m[:, across], sign * audience_m[:, up], "^", color=INK, markersize=7, label="audience")
    for number, placement in enumerate(placements):
        at, colour = placement.position_m, COLOURS[number % len(COLOURS)]
        for corner in _cone(placement, seen):
            axes.plot([at[across], corner[across]], sign * np.array([at[up], corner[up]]), color=colour, linewidth=0.8)
        axes.plot(at[across], sign * at[up], "o", color=colour, markersize=9)
        axes.annotate(str(number + 1), (at[across], sign * at[up]), color=BACK, ha="center", va="center", fontsize=8)
    axes.set_aspect("equal", adjustable="datalim")
    axes.grid(color=LINE, linewidth=0.5)


def _cone(placement: Placement, seen: Float64) -> Float64:
    """The picture's corners (4, 3) at the depth of the object's middle."""
    width, height = placement.model.size_px
    corners = np.array([(x, y) for x in (-0.5, width - 0.5) for y in (-0.5, height - 0.5)])
    flat = (corners - placement.centre_px) / placement.focal_px
    depth = float(((seen - placement.position_m) @ placement.rotation[2]).mean())
    local = np.concatenate((flat, np.ones((4, 1))), axis=1) * depth
    return np.asarray(placement.position_m + local @ placement.rotation)
