"""Beyond the paper: which disturbances the method survives."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from controller.core.arrays import FloatImage
from controller.core.errors import VelaturaError
from controller.study.lab.subject import BenchChange, StageControl, Subject
from controller.study.lab.trial import Trial, shown, trial
from controller.study.output.drawing import Line, plotted
from controller.study.values import Cell, Criterion, Experiment, Figure, Result, ResultTable

BREAKS: Final = 2.0
"""CIEDE2000 more than undisturbed: from this value an appearance counts as broken."""
Frames = Sequence[FloatImage]


@dataclass(frozen=True, slots=True)
class Disturbance:
    """A disturbance of growing strength.

    ``changes``: what is done to the stage before it is calibrated; ``after``: after the calibration, without
    notice; ``frames``: what is done to the frames instead. ``expected``: the level at which it is expected to hold
    """

    name: str
    unit: str
    levels: tuple[float, ...]
    holds_at: float
    changes: Callable[[Subject, float], tuple[BenchChange, ...]] | None = None
    after: Callable[[Subject, float], tuple[BenchChange, ...]] | None = None
    frames: Callable[[Frames, float], Frames] | None = None


def _each(subject: Subject, **change: float) -> tuple[BenchChange, ...]:
    return tuple({"what": "projector", "name": part.name, **change} for part in subject.calibration.projectors)


def quantised(frames: Frames, bits: float) -> Frames:
    """Frames of so many bits a channel: equal steps of the gamma-encoded value."""
    steps = np.float32(2**bits - 1)
    return [np.asarray((np.rint(steps * frame ** np.float32(1 / 2.2)) / steps) ** np.float32(2.2)) for frame in frames]


DISTURBANCES: Final = (
    Disturbance("camera noise", "times the read noise", (3.0, 10.0), 3.0,
            changes=lambda _, level: ({"what": "camera", "noise": level},)),
    Disturbance("defocus", "mm before it is calibrated", (100.0, 250.0), 100.0,
            changes=lambda subject, level: _each(subject, defocus_mm=level)),
    Disturbance("indirect light", "share that comes back", (0.01, 0.05), 0.01,
            changes=lambda _, level: ({"what": "ambient", "indirect": level},)),
    Disturbance("highlights", "strength of the gloss", (0.01, 0.05), 0.01,
            changes=lambda _, level: ({"what": "object", "gloss": level},)),
    Disturbance("gamma error", "factor of the exponents, after calibration", (1.02, 1.05, 1.1), 1.02,
            after=lambda subject, level: _each(subject, gamma=level)),
    Disturbance("focus lost", "mm after it is calibrated", (30.0, 100.0, 200.0), 30.0,
            after=lambda subject, level: _each(subject, defocus_mm=level)),
    Disturbance("quantisation", "bits a channel", (7.0, 6.0, 5.0, 4.0), 7.0,
            frames=quantised),
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class DisturbanceResult:
    """One level of one trouble. ``delta_e`` None: it could not be calibrated, ``why`` says so."""

    disturbance: Disturbance
    level: float
    delta_e: float | None
    rmse: float | None
    grade_percent: float | None
    why: str = ""


def robustness(subject: Subject) -> Result:
    """Meet every trouble at every level, and photograph the same appearance."""
    undisturbed = trial(subject, "undisturbed")
    jobs = [(disturbance, level) for disturbance in DISTURBANCES for level in disturbance.levels]
    results = []
    for number, (disturbance, level) in enumerate(jobs):
        subject.advance(number / len(jobs), f"{disturbance.name}, {level:g} {disturbance.unit}")
        results.append(_run_level(subject, undisturbed, disturbance, level))
    base = undisturbed.quality.delta_e
    return Result(_criteria(base, results), (_table(base, results),), _figures(base, results), TEXT)


def _run_level(subject: Subject, undisturbed: Trial, disturbance: Disturbance, level: float) -> DisturbanceResult:
    hand: StageControl = subject.parts.hand
    key = f"{disturbance.name.replace(' ', '-')}-{level:g}"
    if disturbance.frames is not None:
        made = shown(subject, key, undisturbed.wanted, disturbance.frames(undisturbed.frames, level))
        return DisturbanceResult(disturbance, level, made.quality.delta_e, made.quality.rmse, None)
    changes = disturbance.changes or disturbance.after
    assert changes is not None
    hand.disturb(*changes(subject, level))
    try:
        if disturbance.changes is None:
            made = shown(subject, key, undisturbed.wanted, undisturbed.frames)
            return DisturbanceResult(disturbance, level, made.quality.delta_e, made.quality.rmse, None)
        again = hand.again(key)
        made = trial(again.subject, key)
        return DisturbanceResult(disturbance, level, made.quality.delta_e, made.quality.rmse, again.worst_percent)
    except VelaturaError as error:
        if error.code == "cancelled":
            raise
        return DisturbanceResult(disturbance, level, None, None, None, error.what)
    finally:
        hand.disturb()


def _holds(base: float, result: DisturbanceResult) -> bool:
    return result.delta_e is not None and result.delta_e <= base + BREAKS


def _criteria(base: float, results: Sequence[DisturbanceResult]) -> tuple[Criterion, ...]:
    criteria = []
    for disturbance in DISTURBANCES:
        some = [result for result in results if result.disturbance is disturbance]
        (asked,) = (result for result in some if result.level == disturbance.holds_at)
        broken = [result for result in some if not _holds(base, result)]
        where = f"; breaks at {broken[0].level:g}" if broken else f"; holds to {some[-1].level:g}, the last tried"
        reached = "could not be calibrated" if asked.delta_e is None else f"{asked.delta_e:.2f} after {base:.2f}"
        criteria.append(
            Criterion(
                f"{disturbance.name} of {disturbance.holds_at:g} ({disturbance.unit}): "
                f"at most {BREAKS:g} CIEDE2000 more",
                reached + where,
                _holds(base, asked),
                asked.why,
            )
        )
    return tuple(criteria)


def _table(base: float, results: Sequence[DisturbanceResult]) -> ResultTable:
    columns = ("trouble", "level", "unit", "CIEDE2000 median", "RMSE", "grade, worst projector (%)", "why not")

    def rounded(value: float | None, digits: int) -> Cell:
        return None if value is None else round(value, digits)

    rows: list[tuple[Cell, ...]] = [("none", None, "", round(base, 2), None, None, "")]
    rows += [
        (result.disturbance.name, result.level, result.disturbance.unit, rounded(result.delta_e, 2),
         rounded(result.rmse, 4),
         rounded(result.grade_percent, 2), result.why)
        for result in results
    ]  # fmt: skip
    return ResultTable("robustness", "An appearance's error under each disturbance", columns, tuple(rows))


def _figures(base: float, results: Sequence[DisturbanceResult]) -> tuple[Figure, ...]:
    lines = []
    for disturbance in DISTURBANCES:
        some = [result for result in results if result.disturbance is disturbance and result.delta_e is not None]
        steps = [float(1 + disturbance.levels.index(result.level)) for result in some]
        lines.append(Line(disturbance.name, [0.0, *steps], [base, *(result.delta_e or 0.0 for result in some)]))
    return (
        Figure("robustness", "Median CIEDE2000 by level; the table lists the levels.",
               plotted(lines, x="level (0: undisturbed)", y="CIEDE2000",
                       marks={"broken": ("y", base + BREAKS)}, log_y=True)),
    )  # fmt: skip


TEXT = """\
One disturbance at a time, at growing strength. Noise, defocus, indirect light and highlights are present during the
calibration; gamma and focus change afterwards, unnoticed; quantisation is that of the frames. The model contains
neither indirect light nor highlights. Light that comes back evenly from the room looks like a brighter white, but it
depends on the whole frame; a highlight is treated as paint. *Broken* is our own limit, not one of visibility.
Disturbances are not combined, and highlights are those of a mildly glossy object, not of a mirror."""

ROBUSTNESS = Experiment(
    name="robustness",
    title="Robustness against disturbances",
    paper="Beyond the paper: robustness",
    shows="error curves, and the level at which it breaks.",
    scene="painted",
    run=robustness,
    cost_s=900.0,
)
