"""Fig. 9: the paper's regions of three sizes beside the global solve: their differences and their times."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from controller.arrays import FloatImage, Mask
from controller.solve.bounded import solve_bounded
from controller.solve.regions import solve_regions
from controller.study.drawing import Panel, detail, maps, screen, strip
from controller.study.measuring import predicted
from controller.study.subject import Subject, Wanted
from controller.study.trial import photograph_target
from controller.study.values import Criterion, Experiment, Figure, Result, Table

SIZES = (8, 16, 32)
LARGEST = 1 / 255
CROP_PX = {"small": 192, "medium": 384, "paper": 768}
"""Side of the piece of the camera's picture that is solved: regions of all of it take a minute each, and more."""
QUICKEST = ("osqp", "clarabel", "lsq_linear")


@dataclass(frozen=True, slots=True)
class Made:
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
    made: list[Made] = []

    def keep(name: str, frames: Sequence[FloatImage], seconds: float, objective: float) -> None:
        picture = subject.light.photograph(f"{len(made)}", frames, white=wanted.white)
        made.append(Made(name, seconds, objective, predicted(transport, frames, black), picture))

    for number, size_px in enumerate(SIZES):

        def progress(share: float, number: int = number, size_px: int = size_px) -> None:
            subject.advance((number + share) / (len(SIZES) + 1), f"regions of {size_px}")

        found = solve_regions(
            transport, wanted.radiance, black, solver=solver, size_px=size_px, weights=weights, progress=progress
        )
        keep(f"regions of {size_px}", found.frames, found.seconds, found.objective)
    whole = solve_bounded(transport, wanted.radiance, black, weights=weights)
    keep("global", whole.frames, whole.seconds, whole.objective)
    again = subject.light.photograph("again", whole.frames, white=wanted.white)
    inner = np.zeros(subject.mask.shape, np.bool_)
    rim = max(SIZES) // 2
    inner[crop.rows.start + rim : crop.rows.stop - rim, crop.columns.start + rim : crop.columns.stop - rim] = True
    mask: Mask = inner & wanted.mask
    noise = _mean_difference(again, made[-1].photograph, wanted, mask)
    text = f"Here {CROP_PX[subject.size]} camera pixels a side, regions by {solver}."
    return Result(
        _criteria(made, wanted, mask, noise), (_times(made), _pairs(made, wanted, mask)),
        _figures(subject, wanted, made, mask), text,
    )  # fmt: skip


def _mean_difference(one: FloatImage, other: FloatImage, wanted: Wanted, mask: Mask) -> float:
    return float(np.abs(one - other)[mask].mean(dtype=np.float64) / wanted.white)


def _criteria(made: Sequence[Made], wanted: Wanted, mask: Mask, noise: float) -> tuple[Criterion, ...]:
    pairs = [(a, b) for k, a in enumerate(made) for b in made[k + 1 :]]
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


def _times(made: Sequence[Made]) -> Table:
    best = min(one.objective for one in made)
    rows = tuple((one.name, one.seconds, 100 * (one.objective / best - 1)) for one in made)
    return Table("times", "Times and objectives", ("way", "seconds", "objective above the best, %"), rows)


def _pairs(made: Sequence[Made], wanted: Wanted, mask: Mask) -> Table:
    rows = tuple(
        (
            a.name, b.name, 255 * _mean_difference(a.light, b.light, wanted, mask),
            255 * float(np.percentile(np.abs(a.light - b.light)[mask], 99) / wanted.white),
            255 * _mean_difference(a.photograph, b.photograph, wanted, mask),
        )
        for k, a in enumerate(made) for b in made[k + 1 :]
    )  # fmt: skip
    columns = ("one", "other", "mean by the model, of 255", "99 % by the model, of 255", "mean photographed, of 255")
    return Table("pairs", "Differences between the ways", columns, rows)


def _figures(subject: Subject, wanted: Wanted, made: Sequence[Made], mask: Mask) -> tuple[Figure, ...]:
    crop = detail(subject.mask, centre=(0.4, 0.3), size_px=CROP_PX[subject.size])
    matrix = subject.calibration.camera_to_xyz
    panels = [Panel(one.name, screen(one.photograph, matrix, wanted.white, crop)) for one in made]
    last = made[-1]
    told = {
        f"{one.name}, less global": np.where(
            mask, np.abs(one.light - last.light).mean(axis=2) * 255 / wanted.white, np.nan
        )[crop.rows, crop.columns]
        for one in made[:-1]
    }
    return (
        Figure("photographs", "The solved piece, photographed.", strip(panels, columns=4)),
        Figure(
            "differences",
            "Difference of the light by the model from the global solve's, in 255ths of the target's white.",
            maps(told, low=0, high=4, label="of 255", colours="inferno", columns=3),
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
