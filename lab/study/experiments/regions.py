"""Fig. 9: the paper's regions of three sizes beside the global solve: their differences and their times."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from controller.core.arrays import FloatImage, Mask
from controller.optics.solve.bounded.engine import SolveContext
from controller.optics.solve.bounded.equations import SolveSettings
from controller.optics.solve.bounded.solver import solve_bounded
from lab.study.output.drawing import LabelledPicture, detail, maps, screen, strip
from lab.study.regions import RegionCut, solve_regions
from lab.study.subject.measuring import predicted
from lab.study.subject.subject import ReachableTarget, Subject
from lab.study.subject.trial import photograph_target
from lab.study.values import Criterion, Experiment, Figure, Result, ResultTable

SIZES = (8, 16, 32)
LARGEST = 1 / 255
CROP_PX = {"small": 192, "medium": 384, "paper": 768}
"""Side of the piece of the camera's picture that is solved: regions of the whole picture take a minute or more each."""
QUICKEST = ("osqp", "clarabel", "lsq_linear")


@dataclass(frozen=True, slots=True)
class RegionResult:
    name: str
    seconds: float
    objective: float
    light: FloatImage
    photograph: FloatImage


def regions(subject: Subject) -> Result:
    """Solve a piece of one target by regions and globally; photograph each."""
    target = photograph_target(subject)
    wanted = subject.wanted(target)
    crop = detail(subject.mask, centre=(0.4, 0.3), size_px=CROP_PX[subject.size])
    weights = np.zeros(subject.mask.shape, np.float32)
    weights[crop.rows, crop.columns] = 1
    black, transport = subject.calibration.black, subject.transport
    solver = next(name for name in QUICKEST if name == "lsq_linear" or importlib.util.find_spec(name) is not None)
    results: list[RegionResult] = []

    def keep(name: str, frames: Sequence[FloatImage], seconds: float, objective: float) -> None:
        picture = subject.light.photograph(f"{len(results)}", frames, white=wanted.white)
        results.append(RegionResult(name, seconds, objective, predicted(subject, frames), picture))

    for number, size_px in enumerate(SIZES):

        def progress(_: int, left: float, number: int = number, size_px: int = size_px) -> None:
            subject.advance((number + 1 - left) / (len(SIZES) + 1), f"regions of {size_px}")

        found = solve_regions(
            transport,
            wanted.direct,
            black,
            SolveSettings(weights=weights),
            SolveContext(progress=progress),
            cut=RegionCut(solver=solver, size_px=size_px),
        )
        keep(f"regions of {size_px}", found.frames, found.seconds, found.objective)
    whole = solve_bounded(transport, wanted.direct, black, SolveSettings(weights=weights))
    keep("global", whole.frames, whole.seconds, whole.objective)
    again = subject.light.photograph("again", whole.frames, white=wanted.white)
    inner = np.zeros(subject.mask.shape, np.bool_)
    rim = max(SIZES) // 2
    inner[crop.rows.start + rim : crop.rows.stop - rim, crop.columns.start + rim : crop.columns.stop - rim] = True
    mask: Mask = inner & wanted.mask
    noise = _mean_difference(again, results[-1].photograph, wanted, mask)
    text = f"Here {CROP_PX[subject.size]} camera pixels a side, regions by {solver}."
    return Result(
        _criteria(results, wanted, mask, noise), (_times(results), _pairs(results, wanted, mask)),
        _figures(subject, wanted, results, mask), text,
    )  # fmt: skip


def _mean_difference(first: FloatImage, other: FloatImage, wanted: ReachableTarget, mask: Mask) -> float:
    return float(np.abs(first - other)[mask].mean(dtype=np.float64) / wanted.white)


def _criteria(
    results: Sequence[RegionResult], wanted: ReachableTarget, mask: Mask, noise: float
) -> tuple[Criterion, ...]:
    pairs = [(a, b) for k, a in enumerate(results) for b in results[k + 1 :]]
    model = {f"{a.name} and {b.name}": _mean_difference(a.light, b.light, wanted, mask) for a, b in pairs}
    shown = {f"{a.name} and {b.name}": _mean_difference(a.photograph, b.photograph, wanted, mask) for a, b in pairs}
    worst = max(model, key=lambda name: model[name])
    worst_shown = max(shown, key=lambda name: shown[name])
    return (
        Criterion(
            "mean difference of the light that any two make, by the model: below 1/255 of the target's white",
            f"at most {255 * model[worst]:.2f}/255 ({worst})",
            model[worst] < LARGEST,
        ),
        Criterion(
            "mean difference of any two photographs: below 1/255 more than two photographs of the same frames differ",
            f"at most {255 * shown[worst_shown]:.2f}/255 ({worst_shown}); the same frames twice {255 * noise:.2f}/255",
            shown[worst_shown] - noise < LARGEST,
        ),
    )


def _times(results: Sequence[RegionResult]) -> ResultTable:
    best = min(result.objective for result in results)
    rows = tuple((result.name, result.seconds, 100 * (result.objective / best - 1)) for result in results)
    return ResultTable("times", "Times and objectives", ("way", "seconds", "objective above the best, %"), rows)


def _pairs(results: Sequence[RegionResult], wanted: ReachableTarget, mask: Mask) -> ResultTable:
    rows = tuple(
        (
            a.name, b.name, 255 * _mean_difference(a.light, b.light, wanted, mask),
            255 * float(np.percentile(np.abs(a.light - b.light)[mask], 99) / wanted.white),
            255 * _mean_difference(a.photograph, b.photograph, wanted, mask),
        )
        for k, a in enumerate(results) for b in results[k + 1 :]
    )  # fmt: skip
    columns = ("one", "other", "mean by the model, of 255", "99 % by the model, of 255", "mean photographed, of 255")
    return ResultTable("pairs", "Differences between the variants", columns, rows)


def _figures(
    subject: Subject, wanted: ReachableTarget, results: Sequence[RegionResult], mask: Mask
) -> tuple[Figure, ...]:
    crop = detail(subject.mask, centre=(0.4, 0.3), size_px=CROP_PX[subject.size])
    matrix = subject.calibration.camera_to_xyz
    panels = [LabelledPicture(result.name, screen(result.photograph, matrix, wanted.white, crop)) for result in results]
    last = results[-1]
    differences = {
        f"{result.name}, less global": np.where(
            mask, np.abs(result.light - last.light).mean(axis=2) * 255 / wanted.white, np.nan
        )[crop.rows, crop.columns]
        for result in results[:-1]
    }
    return (
        Figure("photographs", "The solved piece, photographed.", strip(panels, columns=4)),
        Figure(
            "differences",
            "Difference of the light by the model from the global solve's, in 255ths of the target's white.",
            maps(differences, low=0, high=4, label="of 255", colours="inferno", columns=3),
        ),
    )


REGIONS = Experiment(
    name="regions",
    title="Regions of 8, 16 and 32, and global",
    paper="Paper 3.2, Fig. 9",
    shows="the differences between them are below 1/255 on average; and the time of each.",
    scene="painted",
    run=regions,
    cost_s=60.0,
)
