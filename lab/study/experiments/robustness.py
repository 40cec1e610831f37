"""Beyond the paper: which disturbances the method survives."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from controller.core.arrays import FloatImage
from controller.core.errors import CalibrationError
from controller.optics.solve.result.metrics import TITLES
from lab.study.output.drawing import Line, SmallPlot, small_plots
from lab.study.subject.measuring import SET_COLUMNS, set_cells
from lab.study.subject.subject import BenchChange, StageControl, Subject
from lab.study.subject.trial import Trial, photograph_frames, run_trial
from lab.study.values import Cell, Criterion, Experiment, Figure, Result, ResultTable

DOUBLED: Final = 2.0
"""An appearance counts as broken where its error is so many times the undisturbed one."""
JUDGED: Final = ("in_reach", "lit")
"""The pixels that are judged, of ``solve.judged.TITLES``."""
SHOWN: Final = 4.0
"""Times the undisturbed error, up to which the plots go."""
Frames = Sequence[FloatImage]
Changes = Callable[[Subject, float], tuple[BenchChange, ...]]


@dataclass(frozen=True, slots=True)
class Disturbance:
    """A disturbance of growing strength.

    ``levels``: from weak to strong, as far as makes sense; ``limit``: the one of them that users meet, which must not
    double the error; ``undisturbed``: the level at which nothing is disturbed; ``changes``: what is done to the stage
    before it is calibrated; ``after``: after the calibration, without notice; ``frames``: what is done to the frames
    """

    name: str
    unit: str
    levels: tuple[float, ...]
    limit: float
    undisturbed: float = 0.0
    changes: Changes | None = None
    after: Changes | None = None
    frames: Callable[[Frames, float], Frames] | None = None


def _each(subject: Subject, **change: float) -> tuple[BenchChange, ...]:
    return tuple({"what": "projector", "name": part.name, **change} for part in subject.calibration.projectors)


def _every(key: str) -> Changes:
    return lambda subject, level: _each(subject, **{key: level})


def _one(what: str, key: str) -> Changes:
    return lambda _, level: ({"what": what, key: level},)


def _shadow(subject: Subject, level: float) -> tuple[BenchChange, ...]:
    """Of the first projector, from the left as far as that share of the width in which its pixels reach the object."""
    valid = subject.calibration.projectors[0].metapixels.valid
    left, right = np.percentile(np.nonzero(valid)[1], (1, 99))
    return _each(subject, shadow=float((left + level * (right - left)) / valid.shape[1]))[:1]


def quantised(frames: Frames, bits: float) -> Frames:
    """Frames of so many bits a channel: equal steps of the gamma-encoded value."""
    steps = np.float32(2**bits - 1)
    return [np.asarray((np.rint(steps * frame ** np.float32(1 / 2.2)) / steps) ** np.float32(2.2)) for frame in frames]


DISTURBANCES: Final = (
    Disturbance("camera noise", "times all noise", (3, 10, 30, 100, 300), 3, 1, changes=_one("camera", "noise")),
    Disturbance("defocus", "mm before it is calibrated", (100, 300, 1000, 2000), 100, changes=_every("defocus_mm")),
    Disturbance("indirect light", "share that comes back", (0.05, 0.15, 0.4, 1.0), 0.15,
                changes=_one("ambient", "indirect")),
    Disturbance("highlights", "strength of the gloss", (0.05, 1.0), 0.05, changes=_one("object", "gloss")),
    Disturbance("white segment", "times the least channel", (0.1, 0.25, 2.0), 0.25,
                changes=_every("white_segment")),
    Disturbance("misconvergence", "px", (0.25, 0.5, 1.5, 3.0), 0.5, changes=_every("misconverged_px")),
    Disturbance("lamp flicker", "share of the light, short exposures", (0.02, 0.05, 0.1, 0.3), 0.02,
                changes=_every("flicker")),
    Disturbance("gamma error", "factor of the exponents, after calibration", (1.02, 1.05, 1.1, 1.2), 1.05, 1,
                after=_every("gamma")),
    Disturbance("focus lost", "mm after it is calibrated", (30, 100, 200, 400), 30, after=_every("defocus_mm")),
    Disturbance("a visitor's shadow", "of the object's width, one projector, after calibration",
                (0.02, 0.05, 0.15, 0.4, 1.0), 0.15, after=_shadow),
    Disturbance("quantisation", "bits a channel", (7, 6, 5, 4, 3, 2), 6, 8, frames=quantised),
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class DisturbanceResult:
    """One level of one disturbance. ``found`` None: it could not be calibrated, ``why`` says so."""

    disturbance: Disturbance
    level: float
    found: Trial | None
    grade_percent: float | None
    why: str = ""

    def times(self, base: Trial) -> tuple[float, float]:
        """How many times as large the error is as undisturbed: of the median, and of 95 % of the pixels.

        In reach or of all lit pixels, whichever is more: fewer pixels in reach must not look like less error.
        """
        if self.found is None:
            return float("inf"), float("inf")
        median, most = zip(*(_times(self.found, base, pixels) for pixels in JUDGED), strict=True)
        return max(median), max(most)


def _error(trial: Trial, pixels: str) -> tuple[float, float]:
    """CIEDE2000 of one of ``JUDGED``: the median, and 95 %."""
    found = trial.quality.pixels[pixels]
    assert found.delta_e00_median is not None
    assert found.delta_e00_p95 is not None
    return found.delta_e00_median, found.delta_e00_p95


def _times(now: Trial, base: Trial, pixels: str) -> tuple[float, float]:
    median, most = (after / before for after, before in zip(_error(now, pixels), _error(base, pixels), strict=True))
    return median, most


def robustness(subject: Subject) -> Result:
    """Increase every disturbance until the error of the same photographed appearance has doubled in both measures."""
    base = run_trial(subject, "undisturbed")
    results: list[DisturbanceResult] = []
    for number, disturbance in enumerate(DISTURBANCES):
        results += _until_doubled(subject, base, number, disturbance)
    return Result(_criteria(base, results), (_breaking(base, results), _table(base, results)),
                  _figures(base, results), TEXT)  # fmt: skip


def _until_doubled(subject: Subject, base: Trial, number: int, disturbance: Disturbance) -> list[DisturbanceResult]:
    """From weak to strong: what users meet, and more until both have doubled; less only where one has at that level."""
    levels, limit = disturbance.levels, disturbance.levels.index(disturbance.limit)

    def at(place: int) -> DisturbanceResult:
        share = (number + place / len(levels)) / len(DISTURBANCES)
        subject.advance(share, f"{disturbance.name}, {levels[place]:g} {disturbance.unit}")
        return _run_level(subject, base, disturbance, levels[place])

    found = [at(limit)]
    for place in range(limit + 1, len(levels)):
        if min(found[-1].times(base)) > DOUBLED:
            break
        found.append(at(place))
    for place in reversed(range(limit)):
        if max(found[0].times(base)) <= DOUBLED:
            break
        found.insert(0, at(place))
    return found


def _run_level(subject: Subject, undisturbed: Trial, disturbance: Disturbance, level: float) -> DisturbanceResult:
    hand: StageControl = subject.parts.hand
    key = f"{disturbance.name.replace(' ', '-').replace(chr(39), '')}-{level:g}"
    if disturbance.frames is not None:
        made = photograph_frames(subject, key, undisturbed.wanted, disturbance.frames(undisturbed.frames, level))
        return DisturbanceResult(disturbance, level, made, None)
    changes = disturbance.changes or disturbance.after
    assert changes is not None
    hand.disturb(*changes(subject, level))
    try:
        if disturbance.changes is None:
            made = photograph_frames(subject, key, undisturbed.wanted, undisturbed.frames)
            return DisturbanceResult(disturbance, level, made, None)
        again = hand.again(key)
        return DisturbanceResult(disturbance, level, run_trial(again.subject, key), again.worst_percent)
    except CalibrationError as error:
        # Anything else, such as a full disk, ends the experiment: it says nothing about the disturbance.
        return DisturbanceResult(disturbance, level, None, None, error.what)
    finally:
        hand.disturb()


def _of(results: Sequence[DisturbanceResult], disturbance: Disturbance) -> list[DisturbanceResult]:
    return [result for result in results if result.disturbance is disturbance]


def doubles_at(base: Trial, results: Sequence[DisturbanceResult], measure: int) -> float | None:
    """The level where the error has doubled, by a straight line between two levels; None: at none that was tried.

    ``measure``: 0 the median, 1 the 95 %; ``results``: of one disturbance, from weak to strong
    """
    before = results[0].disturbance.undisturbed, 1.0
    for result in results:
        times = result.times(base)[measure]
        if times > DOUBLED:
            if not np.isfinite(times):
                return result.level
            part = (DOUBLED - before[1]) / (times - before[1])
            return before[0] + part * (result.level - before[0])
        before = result.level, times
    return None


def _criteria(base: Trial, results: Sequence[DisturbanceResult]) -> tuple[Criterion, ...]:
    criteria = []
    for disturbance in DISTURBANCES:
        (asked,) = (result for result in _of(results, disturbance) if result.level == disturbance.limit)
        median, most = asked.times(base)
        reached = "could not be calibrated"
        if asked.found is not None:
            reached = "; ".join(_compared(asked.found, base, pixels) for pixels in JUDGED)
        holds = max(median, most) <= DOUBLED
        worse = "both" if min(median, most) > DOUBLED else "the median" if median > most else "the 95 %"
        criteria.append(
            Criterion(
                f"{disturbance.name} of {disturbance.limit:g} ({disturbance.unit}): median and 95 % at most"
                f" {DOUBLED:g} times the undisturbed ones, in reach and of all lit pixels",
                reached,
                holds,
                "" if holds else asked.why or f"Too large: {worse}.",
            )
        )
    return tuple(criteria)


def _compared(now: Trial, base: Trial, pixels: str) -> str:
    """Of one of ``JUDGED``, in words."""
    (before, before_most), (median, most) = _error(base, pixels), _error(now, pixels)
    return (
        f"{TITLES[pixels]}: median {before:.2f} to {median:.2f}, {median / before:.2f} times,"
        f" 95 % {before_most:.1f} to {most:.1f}, {most / before_most:.2f} times"
    )


def _breaking(base: Trial, results: Sequence[DisturbanceResult]) -> ResultTable:
    rows: list[tuple[Cell, ...]] = []
    for disturbance in DISTURBANCES:
        some = _of(results, disturbance)
        doubles: list[Cell] = []
        for measure in (0, 1):
            doubles.append(_breaking_level(base, some, measure))
        rows.append((disturbance.name, disturbance.unit, disturbance.limit, *doubles))
    columns = ("disturbance", "unit", "users meet", "the median doubles at", "the 95 % doubles at")
    return ResultTable("breaking", "Where the error doubles", columns, tuple(rows))


def _breaking_level(base: Trial, some: Sequence[DisturbanceResult], measure: int) -> str:
    level, last = doubles_at(base, some, measure), some[-1]
    if level is None:
        return f"not at {last.level:g}"
    return f"no calibration at {level:g}" if last.found is None and last.level == level else f"{level:.3g}"


def _table(base: Trial, results: Sequence[DisturbanceResult]) -> ResultTable:
    columns = (
        "disturbance", "level", "unit", "CIEDE2000 median", "95 %", "RMSE", "grade, worst projector (%)", "why not",
        *SET_COLUMNS,
    )  # fmt: skip

    def row(name: str, level: Cell, unit: str, found: Trial | None, grade: float | None, why: str) -> tuple[Cell, ...]:
        shown_percent = None if grade is None else round(grade, 2)
        if found is None:
            return (name, level, unit, None, None, None, shown_percent, why, *("",) * len(SET_COLUMNS))
        now = found.quality
        figures = (round(now.delta_e, 2), round(now.delta_e_p95, 2), round(now.rmse, 4))
        return (name, level, unit, *figures, shown_percent, why, *set_cells(now.pixels, found.wanted))

    rows = [row("none", None, "", base, None, "")]
    rows += [
        row(one.disturbance.name, one.level, one.disturbance.unit, one.found, one.grade_percent, one.why)
        for one in results
    ]
    return ResultTable("robustness", "An appearance's error under each disturbance", columns, tuple(rows))


def _figures(base: Trial, results: Sequence[DisturbanceResult]) -> tuple[Figure, ...]:
    return (
        Figure(
            "levels",
            "CIEDE2000 of an appearance over the undisturbed one, by how strong a disturbance is: the median, and what"
            " 95 % of the pixels are within; in reach or of all lit pixels, whichever is more."
            f" Cut off at {SHOWN:g} times.",
            small_plots([_plot(base, _of(results, one)) for one in DISTURBANCES], y="times the undisturbed error",
                        y_range=(0.5, SHOWN)),
        ),
    )  # fmt: skip


def _plot(base: Trial, results: Sequence[DisturbanceResult]) -> SmallPlot:
    one = results[0].disturbance
    some = [result for result in results if result.found is not None]
    unit = one.unit if len(some) == len(results) else f"{one.unit}; no calibration at {results[-1].level:g}"
    levels = [one.undisturbed, *(result.level for result in some)]
    lines = [
        Line(name, levels, [1.0, *(result.times(base)[measure] for result in some)])
        for measure, name in enumerate(("median", "95 % of the pixels"))
    ]
    marks = {"twice the undisturbed error": ("y", DOUBLED), "what users meet": ("x", one.limit)}
    return SmallPlot(one.name, unit, lines, marks)


TEXT = """\
One disturbance at a time, increased until the error has doubled, in the median and in 95 % of the pixels, or as far as
makes sense. Both are judged twice, in reach and over all lit pixels, and the worse counts: a disturbance can also make
fewer pixels reachable. The limits that are asked for are of the size that users meet. Noise, defocus, indirect light,
highlights, white segments, misconvergence (red to the right, blue down) and flicker are present during the
calibration; gamma and focus change afterwards, unnoticed, and a visitor's shadow then covers a part of what one
projector lights of the object; quantisation is that of the frames. Noise is all of the camera's noise, of the light as
of the electronics. Light that comes back evenly from the room depends on the whole frame; a highlight is treated as
paint. Whether twice the error is visible depends on the error. Disturbances are not combined, and highlights are those
of a mildly glossy object, not of a mirror."""

ROBUSTNESS = Experiment(
    name="robustness",
    title="Robustness against disturbances",
    paper="Beyond the paper: robustness",
    shows="the level at which the error doubles, and that what users meet does not double it.",
    scene="painted",
    run=robustness,
    cost_s=1800.0,
)
