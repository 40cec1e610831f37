"""An appearance beside what one projector makes of its target, at our exposure and at its own."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from controller.core.arrays import FloatImage, Mask
from controller.optics.calibrate.values import Calibration
from controller.optics.solve.result.metrics import (
    TITLES,
    Comparison,
    PixelSet,
    as_table,
    by_pixels,
    compare,
    visible_object,
)
from controller.stage.artefacts.kinds import StepKind
from controller.stage.artefacts.published import Dimmed, read_photograph_of
from controller.stage.artefacts.solved import RequestedTarget, Solved
from controller.stage.report.page import Goal

GOAL_TIMES_BETTER = 3.0
GOAL_TIMES_BETTER_DIMMED = 1.0
"""With its own exposure, one projector has light enough: what is left is resolution, and being nearer at all counts."""
LEAST_ERROR = 1e-9


@dataclass(frozen=True, slots=True)
class AtItsExposure:
    """One projector at the exposure that it can reach, ``exposure`` times ours, and ours at our own exposure.

    Both over the pixels that both reach; ``left_out_share``: those of the visible object that are not among them;
    ``pixels``: the one projector's photograph by sets of pixels
    """

    exposure: float
    theirs: Comparison
    ours: Comparison
    left_out_share: float
    pixels: dict[str, PixelSet]

    @property
    def times_better(self) -> float:
        return self.theirs.delta_e00_median / max(self.ours.delta_e00_median, LEAST_ERROR)


@dataclass(frozen=True, slots=True)
class OneProjector:
    """``photograph`` and figures of one projector at our exposure; ``dimmed``: at its own, None where not known."""

    photograph: FloatImage
    figures: Comparison
    pixels: dict[str, PixelSet]
    dimmed: AtItsExposure | None

    def times_better(self, ours: Comparison) -> float:
        return self.figures.delta_e00_median / max(ours.delta_e00_median, LEAST_ERROR)


def one_projector(
    run: Path, name: str, calibration: Calibration, solved: Solved, photograph: FloatImage, mask: Mask
) -> OneProjector:
    """``photograph``: ours; ``mask`` (rows, columns): where we are compared. Raises what ``metrics.compare`` raises."""
    asked, matrix = solved.requested, calibration.camera_to_xyz
    alone = read_photograph_of(run, StepKind.TRADITIONAL, name)
    figures = compare(alone, asked.target, matrix, solved.exposure, mask)
    pixels = _by_pixels(calibration, alone, asked, solved.exposure)
    dimmed = Dimmed.read(run, name)
    return OneProjector(
        alone, figures, pixels, None if dimmed is None else _dimmed(calibration, solved, photograph, dimmed)
    )


def _dimmed(calibration: Calibration, solved: Solved, photograph: FloatImage, dimmed: Dimmed) -> AtItsExposure | None:
    asked, matrix, lit = solved.requested, calibration.camera_to_xyz, calibration.object_mask
    both: Mask = asked.reachable & dimmed.reachable & lit
    if not both.any():
        return None
    theirs = RequestedTarget(dimmed.target, dimmed.reachable, asked.valid)
    return AtItsExposure(
        exposure=dimmed.exposure / solved.exposure,
        theirs=compare(dimmed.photograph, dimmed.target, matrix, dimmed.exposure, both),
        ours=compare(photograph, asked.target, matrix, solved.exposure, both),
        left_out_share=1 - float(both.sum()) / max(int(visible_object(lit).sum()), 1),
        pixels=_by_pixels(calibration, dimmed.photograph, theirs, dimmed.exposure),
    )


def _by_pixels(
    calibration: Calibration, photograph: FloatImage, asked: RequestedTarget, white: float
) -> dict[str, PixelSet]:
    return by_pixels(
        photograph, asked.target, calibration.camera_to_xyz, white,
        reachable=asked.reachable, valid=asked.valid, lit=calibration.object_mask,
    )  # fmt: skip


def as_figures(one: OneProjector, ours: Comparison) -> dict[str, Any]:
    """For report.json (docs/reference/report.md)."""
    dimmed = one.dimmed
    return {
        "traditional": {**_compared(one.figures), "pixels": as_table(one.pixels)},
        "times_better": one.times_better(ours),
        "dimmed": None if dimmed is None else {
            "exposure": dimmed.exposure,
            **_compared(dimmed.theirs),
            "ours": _compared(dimmed.ours),
            "left_out_share": dimmed.left_out_share,
            "pixels": as_table(dimmed.pixels),
        },
        "times_better_dimmed": None if dimmed is None else dimmed.times_better,
    }  # fmt: skip


def _compared(found: Comparison) -> dict[str, float]:
    return {
        "delta_e00_median": found.delta_e00_median,
        "delta_e00_p95": found.delta_e00_p95,
        "rmse": found.rmse,
        "sharpness_lambda": found.sharpness_lambda,
    }


def as_rows(one: OneProjector, ours: Comparison) -> tuple[tuple[str, str], ...]:
    """For the page: both comparisons, and one projector by sets of pixels."""
    rows = [("one projector at our exposure", f"{_pair(one.figures)} in reach; ours {one.times_better(ours):.1f} times"
             f" nearer; {_sets(one.pixels, 'lit', 'visible')}")]  # fmt: skip
    if (dimmed := one.dimmed) is not None:
        rows.append(
            ("one projector at its own exposure",
             f"{_pair(dimmed.theirs)}, ours there {_pair(dimmed.ours)}: {dimmed.times_better:.1f} times nearer, at"
             f" {dimmed.exposure:.2f} of our light, where both reach it ({100 * dimmed.left_out_share:.1f} % left"
             f" out); {_sets(dimmed.pixels, 'lit', 'visible')}")
        )  # fmt: skip
    return tuple(rows)


def _pair(found: Comparison) -> str:
    return f"{found.delta_e00_median:.2f} / {found.delta_e00_p95:.2f}"


def _sets(pixels: Mapping[str, PixelSet], *names: str) -> str:
    return "; ".join(
        f"{TITLES[name]} {pixels[name].delta_e00_median:.2f} / {pixels[name].delta_e00_p95:.2f}"
        for name in names
        if pixels[name].delta_e00_median is not None
    )


def goals(compared: Mapping[str, tuple[OneProjector, Comparison]]) -> tuple[Goal, ...]:
    """Both improvements, each of the appearance where it is least; by title, one projector's and ours."""
    same = {title: one.times_better(ours) for title, (one, ours) in compared.items()}
    own = {title: one.dimmed.times_better for title, (one, _) in compared.items() if one.dimmed is not None}
    found = [_goal("Least improvement over one projector at our exposure", same, GOAL_TIMES_BETTER)]
    if own:
        found.append(_goal("Least improvement over one projector at its own", own, GOAL_TIMES_BETTER_DIMMED))
    return tuple(found)


def _goal(name: str, times: Mapping[str, float], goal: float) -> Goal:
    title = min(times, key=times.__getitem__)
    return Goal(name, f"{times[title]:.1f} times", f"more than {goal:g} times", times[title] > goal, title)
