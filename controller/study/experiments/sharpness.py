"""Fig. 11: local sharpness (eq. 9) with one and with all projectors, by a naive inverse and by the full method."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from controller.core.arrays import FloatImage
from controller.report.pictures import crop_around
from controller.solve.bounded.solver import solve_bounded
from controller.solve.bounded.weights import appearance_weights
from controller.study.experiments.ablation import paper_model, raw_transport
from controller.study.experiments.residual import brightest_first
from controller.study.lab.measuring import SET_COLUMNS, pixel_sets, set_cells, sharpness_map, unbounded_inverse
from controller.study.lab.subject import ReachableTarget, Subject
from controller.study.lab.trial import photograph_target
from controller.study.output.drawing import LabelledPicture, maps, screen, strip
from controller.study.values import Cell, Criterion, Experiment, Figure, Result, ResultTable
from controller.transport import build_transport

TIE = 0.02
"""Differences of lambda in a window below this are not significant."""
MOST_WINDOWS = 0.9


@dataclass(frozen=True, slots=True)
class SharpnessResult:
    name: str
    photograph: FloatImage
    local: FloatImage
    overall: float
    cells: tuple[Cell, ...] = ("",) * len(SET_COLUMNS)


def local_sharpness(subject: Subject) -> Result:
    """Photograph the four combinations, and compare where each keeps the target's edges."""
    order = brightest_first(subject)
    every = list(range(len(order)))
    alone = build_transport(subject.with_projectors(order[:1]))
    target = photograph_target(subject)
    wanted = subject.wanted(target, transport=alone)
    window_px = max(24, subject.mask.shape[1] // 20)
    results = []
    ways = [(which, naive) for which in (order[:1], every) for naive in (True, False)]
    for number, (which, naive) in enumerate(ways):
        name = f"{len(which)} projector{'s' * (len(which) > 1)}, {'naive' if naive else 'full'}"
        subject.advance(number / len(ways), name)
        frames = subject.frames_of(which, _frames(subject, which, wanted, naive=naive))
        picture = subject.light.photograph(f"{len(which)}-{'naive' if naive else 'full'}", frames, white=wanted.white)
        cells = set_cells(pixel_sets(subject, picture, wanted), wanted)
        results.append(SharpnessResult(name, picture, *sharpness_map(picture, wanted, wanted.mask, window_px), cells))
    return Result(_criteria(results), (_table(results),), _figures(subject, wanted, results, window_px))


def _frames(subject: Subject, which: Sequence[int], wanted: ReachableTarget, *, naive: bool) -> Sequence[FloatImage]:
    calibration, black = subject.with_projectors(which), subject.calibration.black
    if naive:
        raw = raw_transport(paper_model(calibration), [subject.light.dots(n).shares for n in which])
        return unbounded_inverse(raw, wanted.direct, black)
    weights = appearance_weights(wanted.radiance, wanted.mask, wanted.white)
    return solve_bounded(build_transport(calibration), wanted.direct, black, weights=weights).frames


def _behind(results: Sequence[SharpnessResult]) -> FloatImage:
    """By how much the last falls short of the best, in each window with edges; NaN in the others."""
    last = results[-1].local
    best = np.max(np.stack([np.nan_to_num(result.local, nan=-1.0) for result in results]), axis=0)
    return np.asarray(np.where(np.isfinite(last), best - last, np.nan), np.float32)


def _criteria(results: Sequence[SharpnessResult]) -> tuple[Criterion, ...]:
    behind = _behind(results)
    compared = behind[np.isfinite(behind)]
    share = float((compared <= TIE).mean()) if compared.size else 0.0
    lost = compared[compared > TIE]
    reason = (
        f"In {lost.size} windows another is better, by {np.median(lost):.2f} (median) of lambda." if lost.size else ""
    )
    overall = {result.name: result.overall for result in results}
    most = max(result.overall for result in results[:-1])
    one_naive, one_full, all_naive, all_full = (result.overall for result in results)
    return (
        Criterion(
            f"the full method with all projectors is best, within {TIE}, in at least {MOST_WINDOWS:.0%} of the windows",
            f"{share:.1%}",
            share >= MOST_WINDOWS,
            reason,
        ),
        Criterion(
            "its lambda over all that is in reach is the highest",
            ", ".join(f"{name} {value:.3f}" for name, value in overall.items()),
            all_full > most,
        ),
        Criterion(
            "full is sharper than naive with one projector", f"{one_naive:.3f} to {one_full:.3f}", one_full > one_naive
        ),
        Criterion("full is sharper than naive with all", f"{all_naive:.3f} to {all_full:.3f}", all_full > all_naive),
    )


def _table(results: Sequence[SharpnessResult]) -> ResultTable:
    columns = (
        "way",
        "lambda, in reach",
        "lambda, median window",
        "lambda, lowest tenth of windows",
        "windows",
        *SET_COLUMNS,
    )
    rows = tuple(
        (
            result.name, result.overall, float(np.nanmedian(result.local)), float(np.nanpercentile(result.local, 10)),
            int(np.isfinite(result.local).sum()), *result.cells,
        )
        for result in results
    )  # fmt: skip
    return ResultTable("lambda", "Local sharpness", columns, rows)


def _figures(
    subject: Subject, wanted: ReachableTarget, results: Sequence[SharpnessResult], window_px: int
) -> tuple[Figure, ...]:
    whole = crop_around(subject.mask)
    matrix = subject.calibration.camera_to_xyz
    named = [("target", wanted.radiance), *((result.name, result.photograph) for result in results)]
    panels = [LabelledPicture(name, screen(image, matrix, wanted.white, whole)) for name, image in named]
    return (
        Figure("photographs", "The target and the four photographs.", strip(panels, columns=3)),
        Figure(
            "behind",
            "By how much the last falls short of the best of the four.",
            maps({"short of the best": _behind(results)}, low=0, high=0.5, label="lambda", colours="magma", columns=1),
        ),
        Figure(
            "maps",
            f"lambda in windows of {window_px}x{window_px} camera pixels; grey: fewer than 12 edge pixels.",
            maps({result.name: result.local for result in results}, low=0, high=1, label="lambda (eq. 9)"),
        ),
    )


SHARPNESS = Experiment(
    name="sharpness",
    title="Local sharpness",
    paper="Paper 6, Fig. 11, eq. 9",
    shows="the full method with three projectors is the sharpest everywhere that matters.",
    scene="painted",
    run=local_sharpness,
    cost_s=60.0,
    dots=True,
)
