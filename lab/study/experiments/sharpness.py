"""Fig. 11: local sharpness (eq. 9) with one and with all projectors, by a naive inverse and by the full method."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from controller.core.arrays import FloatImage
from controller.optics.solve.bounded.equations import SolveSettings, appearance_weights
from controller.optics.solve.bounded.solver import solve_bounded
from controller.optics.solve.targets.patterns import checkerboard
from controller.optics.solve.targets.values import through_camera
from controller.optics.transport import build_transport
from controller.stage.report.pictures import crop_around
from lab.study.experiments.ablation import paper_model, raw_transport
from lab.study.experiments.residual import brightest_first
from lab.study.output.drawing import LabelledPicture, maps, screen, strip
from lab.study.subject.measuring import SET_COLUMNS, pixel_sets, set_cells, sharpness_map, unbounded_inverse
from lab.study.subject.subject import ReachableTarget, Subject
from lab.study.subject.trial import photograph_target
from lab.study.values import Cell, Criterion, Experiment, Figure, Result, ResultTable

TIE = 0.02
"""Differences of lambda in a neighbourhood below this are not significant."""
MOST = 0.9
PHOTOGRAPH, CHEQUER = "photograph", "chequer"


@dataclass(frozen=True, slots=True)
class SharpnessResult:
    """One way to make one target. ``local``: (rows, columns) lambda around each camera pixel; ``overall``: of all."""

    name: str
    photograph: FloatImage
    local: FloatImage
    overall: float
    cells: tuple[Cell, ...] = ("",) * len(SET_COLUMNS)


@dataclass(frozen=True, slots=True)
class ComparedTarget:
    """One target and its four photographs, the full method with all projectors last."""

    name: str
    wanted: ReachableTarget
    results: Sequence[SharpnessResult]


def local_sharpness(subject: Subject) -> Result:
    """Photograph the four combinations for both targets, and compare where each keeps the target's edges."""
    order = brightest_first(subject)
    alone = build_transport(subject.with_projectors(order[:1]))
    size_px = max(24, subject.mask.shape[1] // 20)
    chequer = through_camera(checkerboard(subject.geometry, subject.mask))
    compared = [
        _compared(subject, order, (number, name), subject.wanted(target, transport=alone), size_px)
        for number, (name, target) in enumerate({PHOTOGRAPH: photograph_target(subject), CHEQUER: chequer}.items())
    ]
    return Result(
        tuple(criterion for one in compared for criterion in _criteria(one)),
        (_table(compared),),
        tuple(figure for one in compared for figure in _figures(subject, one, size_px)),
    )


def _compared(
    subject: Subject, order: Sequence[int], which_target: tuple[int, str], wanted: ReachableTarget, size_px: int
) -> ComparedTarget:
    place, target = which_target
    results = []
    ways = [(which, naive) for which in (order[:1], list(range(len(order)))) for naive in (True, False)]
    for number, (which, naive) in enumerate(ways):
        name = f"{len(which)} projector{'s' * (len(which) > 1)}, {'naive' if naive else 'full'}"
        subject.advance((place + number / len(ways)) / 2, f"{target}, {name}")
        frames = subject.frames_of(which, _frames(subject, which, wanted, naive=naive))
        shot = f"{target}-{len(which)}-{'naive' if naive else 'full'}"
        picture = subject.light.photograph(shot, frames, white=wanted.white)
        cells = set_cells(pixel_sets(subject, picture, wanted), wanted)
        results.append(SharpnessResult(name, picture, *sharpness_map(picture, wanted, wanted.mask, size_px), cells))
    return ComparedTarget(target, wanted, results)


def _frames(subject: Subject, which: Sequence[int], wanted: ReachableTarget, *, naive: bool) -> Sequence[FloatImage]:
    calibration, black = subject.with_projectors(which), subject.calibration.black
    if naive:
        raw = raw_transport(paper_model(calibration), [subject.light.dots(n).shares for n in which])
        return unbounded_inverse(raw, wanted.direct, black)
    weights = appearance_weights(wanted.radiance, wanted.mask, wanted.white)
    return solve_bounded(build_transport(calibration), wanted.direct, black, SolveSettings(weights=weights)).frames


def _behind(results: Sequence[SharpnessResult]) -> FloatImage:
    """By how much the last falls short of the best around each pixel with edges; NaN elsewhere."""
    last = results[-1].local
    best = np.max(np.stack([np.nan_to_num(result.local, nan=-1.0) for result in results]), axis=0)
    return np.asarray(np.where(np.isfinite(last), best - last, np.nan), np.float32)


def _criteria(target: ComparedTarget) -> tuple[Criterion, ...]:
    results = target.results
    behind = _behind(results)
    compared = behind[np.isfinite(behind)]
    share = float((compared <= TIE).mean()) if compared.size else 0.0
    lost = compared[compared > TIE]
    reason = f"Elsewhere another is better, by {np.median(lost):.2f} (median) of lambda." if lost.size else ""
    overall = {result.name: result.overall for result in results}
    most = max(result.overall for result in results[:-1])
    one_naive, one_full, all_naive, all_full = (result.overall for result in results)
    named = target.name
    return (
        Criterion(
            f"{named}: the full method with all projectors is best, within {TIE}, in at least {MOST:.0%} of the "
            "neighbourhoods",
            f"{share:.1%}",
            share >= MOST,
            reason,
        ),
        Criterion(
            f"{named}: its lambda over all that is in reach is the highest",
            ", ".join(f"{name} {value:.3f}" for name, value in overall.items()),
            all_full > most,
        ),
        Criterion(
            f"{named}: full is sharper than naive with one projector", f"{one_naive:.3f} to {one_full:.3f}",
            one_full > one_naive,
        ),
        Criterion(
            f"{named}: full is sharper than naive with all", f"{all_naive:.3f} to {all_full:.3f}", all_full > all_naive
        ),
    )  # fmt: skip


def _table(compared: Sequence[ComparedTarget]) -> ResultTable:
    columns = (
        "target", "way", "lambda, in reach", "lambda, median neighbourhood", "lambda, lowest tenth of neighbourhoods",
        *SET_COLUMNS,
    )  # fmt: skip
    rows = tuple(
        (
            one.name, result.name, result.overall, float(np.nanmedian(result.local)),
            float(np.nanpercentile(result.local, 10)), *result.cells,
        )
        for one in compared
        for result in one.results
    )  # fmt: skip
    return ResultTable("lambda", "Local sharpness", columns, rows)


def _figures(subject: Subject, target: ComparedTarget, size_px: int) -> tuple[Figure, ...]:
    whole, name, results = crop_around(subject.mask), target.name, target.results
    matrix, white = subject.calibration.camera_to_xyz, target.wanted.white
    named = [("target", target.wanted.radiance), *((result.name, result.photograph) for result in results)]
    panels = [LabelledPicture(label, screen(image, matrix, white, whole)) for label, image in named]
    part = whole.rows, whole.columns
    local = {result.name: result.local[part] for result in results}
    return (
        Figure(f"{name}-photographs", f"The {name} and its four photographs.", strip(panels, columns=3)),
        Figure(
            f"{name}-behind",
            f"{name.capitalize()}: by how much the last falls short of the best of the four.",
            maps({"short of the best": _behind(results)[part]}, low=0, high=0.5, label="lambda", colours="magma",
                 columns=1),
        ),
        Figure(
            f"{name}-maps",
            f"{name.capitalize()}: lambda in the neighbourhood of {size_px}x{size_px} camera pixels of each pixel; "
            "grey: fewer than 12 edge pixels.",
            maps(local, low=0, high=1, label="lambda (eq. 9)"),
        ),
    )  # fmt: skip


SHARPNESS = Experiment(
    name="sharpness",
    title="Local sharpness",
    paper="Paper 6, Fig. 11, eq. 9",
    shows="the full method with three projectors is the sharpest everywhere that matters.",
    scene="painted",
    run=local_sharpness,
    cost_s=100.0,
    dots=True,
)
