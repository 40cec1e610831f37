"""Fig. 10 by square size, exposure and normalisation: where the paper's fall and ours meet."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np

from controller.core.arrays import ByteImage, FloatImage, Mask
from controller.optics.solve.bounded.solver import solve_bounded
from controller.optics.solve.targets.patterns import CHECKERBOARD, checkerboard
from controller.optics.solve.targets.values import Target, through_camera
from controller.optics.transport import LightTransport, build_transport
from lab.study.experiments.residual import PAPER, mean_of
from lab.study.output.drawing import Line, SmallPlot, small_plots
from lab.study.subject.measuring import predicted, region_means
from lab.study.subject.subject import ReachableTarget, Subject
from lab.study.values import Cell, Criterion, Experiment, Figure, Result, ResultTable

USUAL: Final = 8.0
SQUARES: Final = (4.0, USUAL, 16.0)
"""Across the object; the page of Fig. 10 has the usual number."""
ALL_DIMMER: Final = "all can make 99.9 %"
EXPOSURES: Final = {"all can make 95 %": 3, "two can make 95 %": 2, "one can make 95 %": 1, ALL_DIMMER: 3}
"""As bright as so many projectors can make that share of what they light."""
NORMALISED: Final = (
    "rms over the target's white", "its square", "mean difference over the target's white",
    "rms over the region's own rms", "the square of that",
)  # fmt: skip
NEAR: Final = 1.5
"""Times: a sweep meets the paper where none of its three figures is farther off."""
SHOWN: Final = 10.0
"""Times the paper's figure, up to which the plots go."""


@dataclass(frozen=True, slots=True)
class Combination:
    """Mean residual of one to three projectors, photographed and by the model."""

    squares: float
    exposure: str
    normalised: str
    shown: tuple[float, ...]
    by_model: tuple[float, ...]

    @property
    def off(self) -> float:
        """How many times the one farthest from the paper's is more, or less, than it."""
        return max(max(ours / paper, paper / ours) for ours, paper in zip(self.shown, PAPER.values(), strict=True))

    @property
    def falls(self) -> bool:
        return all(after < before for before, after in pairwise(self.shown))

    def __str__(self) -> str:
        return f"{self.squares:g} squares, {self.exposure}, {self.normalised}"


def sweep(subject: Subject) -> Result:
    """Solve and photograph every square size at every exposure with one to three projectors; normalise in each way."""
    transports = {count: build_transport(subject.with_projectors(range(count))) for count in PAPER}
    made: list[Combination] = []
    for number, squares in enumerate(SQUARES):
        look = dataclasses.replace(CHECKERBOARD, squares_across=squares)
        target = through_camera(checkerboard(subject.geometry, subject.mask, look))
        for place, exposure in enumerate(EXPOSURES):
            subject.advance((number + place / len(EXPOSURES)) / len(SQUARES), f"{squares:g} squares, {exposure}")
            made += _combinations(subject, transports, target, squares, exposure)
    return Result(_criteria(made), (_table(made),), _figures(made))


def _combinations(
    subject: Subject, transports: dict[int, LightTransport], target: Target, squares: float, exposure: str
) -> list[Combination]:
    share = 0.999 if exposure == ALL_DIMMER else 0.95
    wanted = subject.wanted(target, share=share, transport=transports[EXPOSURES[exposure]])
    everywhere: Mask = wanted.valid & subject.mask
    shown, by_model = [], []
    for count, transport in transports.items():
        frames = solve_bounded(transport, wanted.direct, subject.calibration.black).frames
        name = f"{squares:g}-{list(EXPOSURES).index(exposure)}-{count}"
        picture = subject.light.photograph(name, subject.frames_of(range(count), frames), white=wanted.white)
        shown.append(normalised(picture, wanted, everywhere))
        by_model.append(normalised(predicted(subject, frames, transport), wanted, everywhere))
    return [
        Combination(squares, exposure, way, tuple(one[way] for one in shown), tuple(one[way] for one in by_model))
        for way in NORMALISED
    ]


def normalised(achieved: FloatImage, wanted: ReachableTarget, mask: Mask) -> dict[str, float]:
    """Mean over regions of 16x16 camera pixels, in each of ``NORMALISED``."""
    white = np.float32(wanted.white)
    difference = (achieved - wanted.radiance) / white
    squared = region_means((difference**2).mean(axis=2), mask)
    own = region_means(((wanted.radiance / white) ** 2).mean(axis=2), mask)
    means = (
        np.sqrt(squared), squared, region_means(np.abs(difference).mean(axis=2), mask), np.sqrt(squared / own),
        squared / own,
    )  # fmt: skip
    return dict(zip(NORMALISED, map(mean_of, means), strict=True))


def _criteria(made: Sequence[Combination]) -> tuple[Criterion, ...]:
    rising = [str(one) for one in made if not one.falls]
    near = sorted((one for one in made if one.off <= NEAR), key=lambda one: one.off)
    nearest = min(made, key=lambda one: one.off)
    return (
        Criterion(
            "the residual falls with each projector, whatever the squares, the exposure and the normalisation",
            f"in {len(made) - len(rising)} of {len(made)}",
            not rising,
            f"It does not with: {'; '.join(rising)}." if rising else "",
        ),
        Criterion(
            f"somewhere in the sweep all three of the paper's figures are met within {NEAR:g} times",
            "; ".join(f"{one}: {one.off:.2f} times" for one in near) or f"nearest: {nearest}: {nearest.off:.2f} times",
            bool(near),
        ),
    )


def _table(made: Sequence[Combination]) -> ResultTable:
    counts = [f"{count} projector{'s' * (count > 1)}" for count in PAPER]
    columns = (
        "squares across", "as bright as", "normalised", *counts, *(f"{count}, by the model" for count in counts),
        "fall from one to three", "times off the paper's, at most",
    )  # fmt: skip
    rows: list[tuple[Cell, ...]] = [(None, "the paper, not reported", "not reported", *PAPER.values(), None, None, None,
                                     PAPER[1] / PAPER[3], 1.0)]  # fmt: skip
    rows += [
        (one.squares, one.exposure, one.normalised, *one.shown, *one.by_model, one.shown[0] / one.shown[-1], one.off)
        for one in made
    ]
    title = "Mean residual by squares, exposure and normalisation, over all lit pixels, photographed"
    return ResultTable("sweep", title, columns, tuple(rows))


def _figures(made: Sequence[Combination]) -> tuple[Figure, ...]:
    brightest = next(iter(EXPOSURES))
    exposures = {one: one.exposure for one in made if one.squares == USUAL}
    squares = {one: f"{one.squares:g} squares" for one in made if one.exposure == brightest}
    named = (("exposures", f"{USUAL:g} squares across", exposures), ("squares", f"As bright as {brightest}", squares))
    return tuple(
        Figure(name, f"{what}: mean residual over the paper's. Cut off at {SHOWN:g} times.", _plots(lines))
        for name, what, lines in named
    )


def _plots(lines: Mapping[Combination, str]) -> ByteImage:
    """One plot a normalisation; ``lines``: the names of the combinations' curves."""
    plots = []
    for way in NORMALISED:
        curves = [
            Line(name, list(PAPER), [ours / paper for ours, paper in zip(one.shown, PAPER.values(), strict=True)])
            for one, name in lines.items()
            if one.normalised == way
        ]
        plots.append(SmallPlot(way, "projectors", curves, {"the paper's": ("y", 1.0)}))
    return small_plots(plots, y="times the paper's", y_range=(0.0, SHOWN))


RESIDUAL_SWEEP = Experiment(
    name="residual-sweep",
    title="Residual by squares, exposure and normalisation",
    paper="Paper 6, Fig. 10, what it does not tell",
    shows="where in the sweep the paper's fall from one to three projectors and ours meet.",
    scene="grazing",
    run=sweep,
    cost_s=120.0,
)
