"""Fig. 10: what is left of a checkerboard's target with more and more superimposed projectors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np

from controller.core.arrays import FloatImage, Mask
from controller.optics.solve.bounded.solver import solve_bounded
from controller.optics.solve.targets.patterns import checkerboard
from controller.optics.solve.targets.values import through_camera
from controller.optics.transport import build_transport
from controller.stage.report.pictures import crop_around
from lab.study.output.drawing import LabelledPicture, detail, maps, screen, strip
from lab.study.subject.measuring import (
    SET_COLUMNS,
    Quality,
    normalised_residual,
    predicted,
    quality,
    region_means,
    set_cells,
)
from lab.study.subject.subject import ReachableTarget, Subject
from lab.study.values import Cell, Criterion, Experiment, Figure, Result, ResultTable

PAPER: Final = {1: 0.051, 2: 0.014, 3: 0.007}
"""Mean normalised residual by number of projectors (paper 6, Fig. 10)."""
COUNTS: Final = (1, 2, 3, 4, 6)
PLAIN: Final = 0.01
"""Standard deviation of the target in a region without an edge, of white."""
BRIGHT, DIM = "all can make it", "one can make it"
"""The two exposures: as bright as all projectors together can be, and as the first can be alone."""


@dataclass(frozen=True, slots=True)
class ResidualResult:
    """A checkerboard made by ``count`` projectors: residual per region, as the model predicts and as photographed.

    Over all pixels that any of the projectors lights; ``plain``: the photographed mean over the regions that hold no
    edge of a square
    """

    exposure: str
    count: int
    wanted: ReachableTarget
    photograph: FloatImage
    by_model: FloatImage
    by_photograph: FloatImage
    plain: float
    quality: Quality
    noise: float = float("nan")

    @property
    def figures(self) -> dict[str, float]:
        """What has to fall with each projector."""
        return {
            "mean": mean_of(self.by_photograph),
            "median region": float(np.nanmedian(self.by_photograph)),
            "95 % of regions": float(np.nanpercentile(self.by_photograph, 95)),
            "CIEDE2000": self.quality.delta_e,
        }


def residual(subject: Subject) -> Result:
    """Solve the same checkerboard for the first projector, the first two and so on; photograph each."""
    every = len(subject.calibration.projectors)
    counts = [count for count in COUNTS if count <= every]
    target = through_camera(checkerboard(subject.geometry, subject.mask))
    alone = build_transport(subject.with_projectors([0]))
    exposures = {BRIGHT: subject.wanted(target), DIM: subject.wanted(target, transport=alone)}
    results = []
    for place, (exposure, wanted) in enumerate(exposures.items()):
        for number, count in enumerate(counts):
            subject.advance((place + number / len(counts)) / 2, f"{_by(count)}, as bright as {exposure}")
            results.append(_made(subject, exposure, wanted, count, again=count == counts[-1]))
    return Result(_criteria(results), (_table(results),), _figures(subject, results))


def _made(subject: Subject, exposure: str, wanted: ReachableTarget, count: int, *, again: bool) -> ResidualResult:
    which = list(range(count))
    transport = build_transport(subject.with_projectors(which))
    solution = solve_bounded(transport, wanted.direct, subject.calibration.black)
    frames = subject.frames_of(which, solution.frames)
    name = f"{'bright' if exposure == BRIGHT else 'dim'}-{count}"
    picture = subject.light.photograph(name, frames, white=wanted.white)
    everywhere: Mask = wanted.valid & subject.mask
    shown = normalised_residual(picture, wanted, everywhere)
    noise = float("nan")
    if again:
        other = subject.light.photograph(f"{name}-again", frames, white=wanted.white)
        noise = _noise(picture, other, wanted.white, everywhere)
    return ResidualResult(
        exposure=exposure,
        count=count,
        wanted=wanted,
        photograph=picture,
        by_model=normalised_residual(predicted(subject, solution.frames, transport), wanted, everywhere),
        by_photograph=shown,
        plain=mean_of(shown[plain_regions(wanted, everywhere)]),
        quality=quality(subject, picture, wanted, everywhere),
        noise=noise,
    )


def plain_regions(wanted: ReachableTarget, mask: Mask) -> Mask:
    """Regions of 16x16 camera pixels that are of one colour in the target."""
    light = wanted.radiance.mean(axis=2) / np.float32(wanted.white)
    mean, squared = region_means(light, mask), region_means(light * light, mask)
    with np.errstate(invalid="ignore"):
        plain: Mask = squared - mean * mean < PLAIN**2
    return plain


def brightest_first(subject: Subject) -> list[int]:
    """The projectors by how many camera pixels they light, most first."""
    lit = subject.transport.lit
    return [int(n) for n in np.argsort(-lit.reshape(len(lit), -1).sum(axis=1), kind="stable")]


def mean_of(regions: FloatImage) -> float:
    """Mean of the regions that are known."""
    known = regions[np.isfinite(regions)]
    return float(known.mean()) if known.size else float("nan")


def _noise(first: FloatImage, other: FloatImage, white: float, mask: Mask) -> float:
    """Rms noise of one photograph over the target's white, from two of the same frames."""
    difference = ((first - other) / np.float32(white))[mask]
    return float(np.sqrt((difference.astype(np.float64) ** 2).mean() / 2))


def _by(count: int) -> str:
    return f"{count} projector{'s' * (count > 1)}"


def _at(results: Sequence[ResidualResult], exposure: str) -> list[ResidualResult]:
    return [result for result in results if result.exposure == exposure]


def _criteria(results: Sequence[ResidualResult]) -> tuple[Criterion, ...]:
    bright = _at(results, BRIGHT)
    # The paper's figures are of as bright as three can make it: more make a target for which three lack light.
    found = [_as_in_paper(bright)] if [result.count for result in bright] == list(PAPER) else []
    return (*found, *(_falls(_at(results, exposure), exposure) for exposure in (BRIGHT, DIM)))


def _as_in_paper(bright: Sequence[ResidualResult]) -> Criterion:
    above = [result for result in bright if mean_of(result.by_photograph) > PAPER[result.count]]
    reached = ", ".join(
        f"{mean_of(result.by_photograph):.4f} (by the model {mean_of(result.by_model):.4f})" for result in bright
    )
    return Criterion(
        f"mean normalised residual, photographed, as bright as {BRIGHT}: at most"
        f" {', '.join(map(str, PAPER.values()))} with {', '.join(map(str, PAPER))} projectors",
        reached,
        not above,
        " ".join(_reason(result, bright[-1].noise) for result in above),
    )


def _reason(result: ResidualResult, noise: float) -> str:
    asked = PAPER[result.count]
    lacking = 1 - result.wanted.mask.sum() / max((result.wanted.valid).sum(), 1)
    text = (
        f"In regions without an edge it is {result.plain:.4f}; the photograph's noise alone is {noise:.4f} rms."
        f" {lacking:.1%} of the pixels are brighter than all projectors together can be."
    )
    below = mean_of(result.by_model) <= asked
    rest = "the rest is the calibration's error and noise" if below else (
        "light is lacking, or edges are finer than the projectors' pixels"
    )  # fmt: skip
    return f"{_by(result.count)}: the solve itself is {'below' if below else 'above'} {asked}: {rest}. {text}"


def _falls(results: Sequence[ResidualResult], exposure: str) -> Criterion:
    by_count = [result.figures for result in results]
    rising = [name for name in by_count[0] if not all(b[name] < a[name] for a, b in pairwise(by_count))]
    text = "; ".join(
        f"{name} {' > '.join(f'{one[name]:.2f}' if name == 'CIEDE2000' else f'{one[name]:.4f}' for one in by_count)}"
        for name in by_count[0]
    )
    return Criterion(
        f"mean, median region, 95 % of regions and CIEDE2000 fall with each projector, as bright as {exposure}",
        text,
        not rising,
        f"Does not fall each time: {', '.join(rising)}." if rising else "",
    )


def _table(results: Sequence[ResidualResult]) -> ResultTable:
    columns = (
        "as bright as", "projectors", "paper", "photographed, mean", "photographed, median region",
        "photographed, 95 % of regions", "photographed, regions without an edge", "by the model, mean",
        "noise of the photograph", "CIEDE2000 median", "CIEDE2000 95 %", "SSIM", "lambda", *SET_COLUMNS,
    )  # fmt: skip
    rows: list[tuple[Cell, ...]] = []
    for result in results:
        figures, noise = result.figures, _at(results, result.exposure)[-1].noise
        rows.append((
            result.exposure, result.count, PAPER.get(result.count) if result.exposure == BRIGHT else None,
            figures["mean"], figures["median region"], figures["95 % of regions"], result.plain,
            mean_of(result.by_model), noise, result.quality.delta_e, result.quality.delta_e_p95, result.quality.ssim,
            result.quality.sharpness, *set_cells(result.quality.pixels, result.wanted),
        ))  # fmt: skip
    return ResultTable("residual", "Residual by number of projectors, over all lit pixels", columns, tuple(rows))


def _figures(subject: Subject, results: Sequence[ResidualResult]) -> tuple[Figure, ...]:
    whole = crop_around(subject.mask)
    crop = detail(subject.mask, centre=(0.5, 0.7), size_px=max(48, subject.mask.shape[1] // 8))
    matrix = subject.calibration.camera_to_xyz
    panels, close = [], []
    for exposure in (BRIGHT, DIM):
        some = _at(results, exposure)
        wanted = some[0].wanted
        named = [(f"target, {exposure}", wanted.radiance), *((_by(one.count), one.photograph) for one in some)]
        panels += [LabelledPicture(name, screen(image, matrix, wanted.white, whole)) for name, image in named]
        close += [LabelledPicture(name, screen(image, matrix, wanted.white, crop)) for name, image in named]
    columns = len(panels) // 2
    regions = {f"{_by(one.count)}, {one.exposure}": one.by_photograph for one in results}
    top = max(0.02, float(np.nanpercentile(_at(results, BRIGHT)[0].by_photograph, 90)))
    return (
        Figure("photographs", "The checkerboard and its photographs, each as bright as its target's white.",
               strip(panels, columns=columns)),
        Figure("crops", "The same in the right half, closer: camera pixels enlarged.", strip(close, columns=columns)),
        Figure(
            "maps",
            "Normalised residual of each region of 16x16 camera pixels, photographed; grey: no projector lights it.",
            maps(regions, low=0, high=top, label="rms over the target's white", colours="inferno",
                 columns=len(regions) // 2),
        ),
    )  # fmt: skip


RESIDUAL = Experiment(
    name="residual",
    title="Residual with one, two and three projectors",
    paper="Paper 6, Fig. 10",
    shows="the mean normalised residual is at or below the paper's 0.051, 0.014, 0.007, and every figure falls.",
    scene="grazing",
    run=residual,
    cost_s=60.0,
)
RESIDUAL_SIX = Experiment(
    name="residual-six",
    title="Residual with one to six projectors",
    paper="Paper 6, Fig. 10, continued",
    shows="the residual keeps falling with four and six projectors.",
    scene="curved-six",
    run=residual,
    cost_s=120.0,
    optional=True,
)
