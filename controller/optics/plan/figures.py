"""A plan in numbers and pictures: stands and lenses in words of a technician, what the seen surface gets, the room.

The finest wave that superimposed projectors can make follows from the blur of their optics (paper 3.3, Fig. 12). One
projector with fine pixels could make every wave up to half a cycle a pixel. Beyond it, its pixels also show a coarser
wave. Projectors whose pixels lie between each other's cancel that one, so that blur is the limit: it has to be made up
for by light, which ends at full and at none, and smoothness takes a part. All of this is solved here for pixels along
one line, at random places between each other, by the objective of ``solve.bounded``.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final, ParamSpec

import numpy as np
import numpy.typing as npt

from controller.config.defaults import SMOOTHNESS
from controller.core.arrays import ByteImage, Float64, Mask
from controller.core.plotting import figure_of, picture_of
from controller.optics.plan.search import Candidate, PlacementPlan
from controller.optics.plan.values import Illumination, Placement, PlanGoal, Surface

MEAN: Final = 0.5
FAINT: Final = 0.1
"""Grey of the wave and its amplitude, of the target's white."""
KEPT: Final = 0.5
"""The finest wave is that which keeps this part of its contrast."""
LENGTH_PX: Final = 20.0
MARGIN_PX: Final = 4.0
SAMPLES: Final = 5
"""For each pixel."""
DRAWS: Final = 6
SEED: Final = 1
ITERATIONS: Final = 300
FREQUENCIES: Final = np.linspace(0.2, 1.2, 31)


@dataclass(frozen=True, slots=True)
class LineProjector:
    """A projector along the wave.

    ``pitch``: of its pixels, by that of the first projector; ``blur_px``: standard deviation in its own pixels, without
    the pixel's square, the camera's blur included; ``light``: its full light over that of the target's white
    """

    pitch: float
    blur_px: float
    light: float


def finest_wave(projectors: Sequence[LineProjector], *, smoothness: float = SMOOTHNESS) -> float:
    """Cycles a pixel of the first projector up to which a faint wave keeps half of its contrast."""
    return last_kept(FREQUENCIES, kept_contrast(projectors, FREQUENCIES, smoothness=smoothness))


def kept_contrast(
    projectors: Sequence[LineProjector],
    frequencies: Float64,
    *,
    smoothness: float = SMOOTHNESS,
    draws: int = DRAWS,
    seed: int = SEED,
) -> Float64:
    """(F,) amplitude in phase with the target's, over the target's; ``frequencies`` (F,) in cycles a pixel.

    ``draws``: random places of the pixels, over which it is averaged
    """
    rng = np.random.default_rng(seed)
    x = np.arange(0.0, LENGTH_PX, 1.0 / SAMPLES)
    kept = np.zeros(len(frequencies))
    # even steps from the first projector's pixels on: at half a cycle a pixel, what it keeps depends on where they lie
    turns = rng.uniform(0, 1, len(frequencies)) + np.arange(draws)[:, None] / draws
    # row by row: a projector lies where it does without those that follow
    every_place = rng.uniform(0, 1, (len(projectors), draws)).T
    for turn, places in zip(turns, every_place, strict=True):
        phase = 2 * np.pi * (frequencies[:, None] * (x - places[0]) + turn[:, None])
        lights = [_light_of(one, place, x) for one, place in zip(projectors, places, strict=True)]
        made = solved(lights, MEAN + FAINT * np.cos(phase), smoothness) @ np.hstack(lights).T
        kept += [_amplitude(*one, x) / FAINT for one in zip(made, phase, strict=True)]
    return kept / draws


def last_kept(frequencies: Float64, kept: Float64, *, share: float = KEPT) -> float:
    """The first frequency at which the contrast falls below ``share``, by a straight line; no NaN counts."""
    known = np.isfinite(kept)
    frequencies, kept = frequencies[known], kept[known]
    below = np.flatnonzero(kept < share)
    if not below.size:
        return float(frequencies[-1])
    i = int(below[0])
    if i == 0:
        return float(frequencies[0])
    part = (kept[i - 1] - share) / (kept[i - 1] - kept[i])
    return float(frequencies[i - 1] + part * (frequencies[i] - frequencies[i - 1]))


def solved(lights: Sequence[Float64], wanted: Float64, smoothness: float) -> Float64:
    """(F, pixels of all) levels in [0, 1] that minimise the squared residual of each row of ``wanted`` (F, X).

    ``lights``: (X, pixels) of each projector. By accelerated projected gradient, with a step for each pixel.
    """
    light = np.hstack(lights)
    own = np.concatenate([one.T @ one.sum(axis=1) for one in lights])
    strength = smoothness * float(own[own > 0].mean())
    normal = light.T @ light + strength * _roughness([one.shape[1] for one in lights])
    step = 1.0 / np.abs(normal).sum(axis=1)
    data = wanted @ light
    levels = np.full_like(data, 0.5)
    ahead, momentum = levels, 1.0
    for _ in range(ITERATIONS):
        following = np.clip(ahead - step * (ahead @ normal - data), 0, 1)
        grown = 0.5 * (1 + np.sqrt(1 + 4 * momentum**2))
        ahead = following + (momentum - 1) / grown * (following - levels)
        levels, momentum = following, grown
    return np.asarray(levels)


def _light_of(one: LineProjector, place: float, x: Float64) -> Float64:
    """(X, pixels): light at ``x`` of each pixel; the first one's middle lies ``place`` pixels off a whole one."""
    from scipy.special import erf

    count = int(np.ceil((LENGTH_PX + 2 * MARGIN_PX) / one.pitch)) + 1
    middle = one.pitch * (place + np.arange(count)) - MARGIN_PX
    distance = (x[:, None] - middle) / one.pitch
    wide = np.sqrt(2.0) * max(one.blur_px, 1e-3)
    return np.asarray(one.light * 0.5 * (erf((distance + 0.5) / wide) - erf((distance - 0.5) / wide)))


def _roughness(counts: Sequence[int]) -> Float64:
    """The quadratic form of the squared differences between adjacent pixels of each projector."""
    total, start = sum(counts), 0
    form = np.zeros((total, total))
    for count in counts:
        difference = np.diff(np.eye(count), axis=0)
        form[start : start + count, start : start + count] = difference.T @ difference
        start += count
    return form


def _amplitude(made: Float64, phase: Float64, x: Float64) -> float:
    inside = (x > MARGIN_PX) & (x < LENGTH_PX - MARGIN_PX)
    parts = np.stack([np.cos(phase), np.sin(phase), np.ones_like(x), x - x.mean()], axis=1)[inside]
    return float(np.linalg.lstsq(parts, made[inside], rcond=None)[0][0])


@dataclass(frozen=True, slots=True)
class CombinedLight:
    """What projectors light together at each of N points, each where it is of use.

    ``lux`` (N,): the sum of them; ``detail_mm`` (N,): of the finest, infinite where there is none; ``count`` (N,)
    """

    lux: Float64
    detail_mm: Float64
    count: npt.NDArray[np.int64]


def combined_light(lit: Sequence[Illumination], useful: Mask) -> CombinedLight:
    """``useful`` (projectors, N) bool: where each of ``lit`` is of use."""
    return CombinedLight(
        np.where(useful, [one.lux for one in lit], 0.0).sum(axis=0),
        np.where(useful, [one.detail_mm for one in lit], np.inf).min(axis=0),
        useful.sum(axis=0),
    )


WAVE_POINTS: Final = 7
CAMERA_BLUR_PX: Final = 0.25
"""Of a projector pixel: what a camera adds whose pixels are a third of that, blurred by 0.7 of its own."""


def figures_of(best: PlacementPlan, surface: Surface, goal: PlanGoal) -> dict[str, Any]:
    """Placements in words of a stand and a lens, and what the seen surface gets of each and of all."""
    weight = surface.area_m2 / surface.area_m2.sum()
    found = combined_light([one.lit for one in best.candidates], np.stack([one.useful for one in best.candidates]))
    lux, detail, count = found.lux, found.detail_mm, found.count
    return {
        "quality": best.quality,
        "tried": best.tried,
        "seen_area_m2": float(surface.area_m2.sum()),
        "share_reached": float(weight @ (count > 0)),
        "share_overlapped": float(weight @ (count >= goal.overlap)),
        "share_bright_enough": float(weight @ (lux >= goal.lux)),
        "share_fine_enough": float(weight @ (detail <= goal.detail_mm)),
        "lux_median": _weighted(lux, weight, 0.5),
        "lux_p5": _weighted(lux, weight, 0.05),
        "detail_mm_median": _finite(_weighted(detail, weight, 0.5)),
        "detail_mm_p95": _finite(_weighted(detail, weight, 0.95)),
        **_finest_waves([one.lit for one in best.candidates], [one.useful for one in best.candidates], weight),
        "projectors": [_placed(one.placement) | _alone(one.useful, one.lit, weight) for one in best.candidates],
    }


def camera_figures(cameras: Sequence[Candidate], best: PlacementPlan, surface: Surface) -> dict[str, Any]:
    """Places of cameras, and which share of what is lit each and all of them see."""
    lit = surface.area_m2 * np.any([one.useful for one in best.candidates], axis=0)
    lit /= lit.sum()
    return {
        "cameras": [_placed(one.placement) | {"share_seen": float(lit @ one.useful)} for one in cameras],
        "share_seen": float(lit @ np.any([one.useful for one in cameras], axis=0)),
    }


def _finest_waves(lit: Sequence[Illumination], useful: Sequence[Mask], weight: Float64) -> dict[str, float | None]:
    """Length of the finest wave by the sharpest projector and by all, median over points of the seen surface.

    Along the longer sides of pixels, as bright as the sharpest projector alone can reach in 95 % of its light.
    """
    reached = np.where(np.any(useful, axis=0), weight, 0.0)
    if not reached.any():
        return {"wave_mm_one": None, "wave_mm_all": None}
    share = np.cumsum(reached) / reached.sum()
    one, every = [], []
    for point in np.searchsorted(share, (np.arange(WAVE_POINTS) + 0.5) / WAVE_POINTS):
        there = sorted((n for n in range(len(lit)) if useful[n][point]), key=lambda n: lit[n].detail_mm[point])
        side_mm = lit[there[0]].pixel_mm[point, 0]
        white = _weighted(lit[there[0]].lux, np.where(useful[there[0]], weight, 0.0), 0.05) / (MEAN + FAINT)
        line = [
            LineProjector(
                lit[n].pixel_mm[point, 0] / side_mm,
                float(np.hypot(lit[n].blur_px[point], CAMERA_BLUR_PX)),
                lit[n].lux[point] / white,
            )
            for n in there
        ]
        alone = finest_wave(line[:1])
        one.append(side_mm / alone)
        # coarse projectors that cost the sharpest one some of its contrast can stay dark
        every.append(side_mm / max(alone, finest_wave(line)))
    return {"wave_mm_one": float(np.median(one)), "wave_mm_all": float(np.median(every))}


def _placed(placement: Placement) -> dict[str, Any]:
    ahead = placement.rotation[2]
    return {
        "model": placement.model.name,
        "place": placement.mounting_point.name,
        "position_m": list(placement.mounting_point.position_m),
        "rotation": placement.rotation.tolist(),
        "pan_degrees": math.degrees(math.atan2(ahead[0], ahead[2])),
        "tilt_up_degrees": math.degrees(math.asin(-ahead[1])),
        "throw_ratio": placement.throw_ratio,
        "focal_px": placement.focal_px,
        "centre_px": list(placement.centre_px),
        "focus_m": placement.focus_m,
    }


def _alone(useful: Mask, lit: Illumination, weight: Float64) -> dict[str, Any]:
    """What one projector does where it is of use."""
    share = float(weight @ useful)
    inside = np.where(useful, weight, 0.0)
    return {
        "share_reached": share,
        "lux_median": _of(lit.lux, useful, inside, 0.5),
        "detail_mm_median": _of(lit.detail_mm, useful, inside, 0.5),
        "blur_px_median": _of(lit.blur_px, useful, inside, 0.5),
        "blur_px_p95": _of(lit.blur_px, useful, inside, 0.95),
        "grazing_loss_mean": float(inside @ (1.0 - lit.cosine)) / share if share else None,
    }


def _of(values: Float64, useful: Mask, inside: Float64, share: float) -> float | None:
    return _finite(_weighted(np.where(useful, values, 0.0), inside, share))


def _weighted(values: Float64, weight: Float64, share: float) -> float:
    """The value below which ``share`` of the weight lies; of no weight, 0."""
    order = np.argsort(values, kind="stable")
    summed = np.cumsum(weight[order])
    if summed[-1] <= 0:
        return 0.0
    return float(values[order[min(int(np.searchsorted(summed, share * summed[-1])), len(order) - 1)]])


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


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
def layout(
    placements: Sequence[Placement], cameras: Sequence[Placement], surface: Surface, audience_m: Float64
) -> ByteImage:
    """The room from above and from the right: object, projectors with their light, what cameras see, the audience."""
    devices = [(one, str(n + 1), COLOURS[n % len(COLOURS)], "-") for n, one in enumerate(placements)]
    devices += [(one, f"C{n + 1}", DIM, ":") for n, one in enumerate(cameras)]
    figure = figure_of((10.0, 4.6), dpi=DPI, constrained=True)
    above, side = figure.subplots(1, 2)
    _room(above, devices, surface, audience_m, across=0, up=2, sign=1.0)
    _room(side, devices, surface, audience_m, across=2, up=1, sign=-1.0)
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
    axes: Any, devices: Sequence[tuple[Placement, str, str, str]], surface: Surface, audience_m: Float64, *,
    across: int, up: int, sign: float,
) -> None:  # fmt: skip
    """One projection of the room; ``sign`` turns what points down. ``devices``: with number, colour and line."""
    seen = surface.points_m[surface.area_m2 > 0]
    axes.plot(seen[:, across], sign * seen[:, up], ".", color=DIM, markersize=1.2)
    axes.plot(audience_m[:, across], sign * audience_m[:, up], "^", color=INK, markersize=7, label="audience")
    for placement, number, colour, line in devices:
        at = placement.position_m
        for corner in _cone(placement, seen):
            ends = [at[across], corner[across]], sign * np.array([at[up], corner[up]])
            axes.plot(*ends, line, color=colour, linewidth=0.8)
        axes.plot(at[across], sign * at[up], "o" if line == "-" else "s", color=colour, markersize=9)
        axes.annotate(number, (at[across], sign * at[up]), color=BACK, ha="center", va="center", fontsize=8)
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
