"""Beyond the paper: what the world may do before the method breaks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from controller.arrays import FloatImage
from controller.errors import VelaturaError
from controller.study.drawing import Line, plotted
from controller.study.stagehand import Change, Stagehand
from controller.study.subject import Subject
from controller.study.trial import Trial, shown, trial
from controller.study.values import Cell, Criterion, Experiment, Figure, Result, Table

BREAKS: Final = 2.0
"""CIEDE2000 more than undisturbed: from here on an appearance is called broken."""
Frames = Sequence[FloatImage]


@dataclass(frozen=True, slots=True)
class Trouble:
    """Something of growing strength.

    ``changes``: what is done to the stage before it is calibrated; ``after``: once it was calibrated, nobody having
    noticed; ``frames``: what is done to the frames instead. ``expected``: the level at which it is expected to hold
    """

    name: str
    unit: str
    levels: tuple[float, ...]
    holds_at: float
    changes: Callable[[Subject, float], tuple[Change, ...]] | None = None
    after: Callable[[Subject, float], tuple[Change, ...]] | None = None
    frames: Callable[[Frames, float], Frames] | None = None


def _each(subject: Subject, **change: float) -> tuple[Change, ...]:
    return tuple({"what": "projector", "name": part.name, **change} for part in subject.calibration.projectors)


def quantised(frames: Frames, bits: float) -> Frames:
    """Frames of so many bits a channel: equal steps of the gamma-encoded value."""
    steps = np.float32(2**bits - 1)
    return [np.asarray((np.rint(steps * frame ** np.float32(1 / 2.2)) / steps) ** np.float32(2.2)) for frame in frames]


TROUBLES: Final = (
    Trouble("camera noise", "times the read noise", (3.0, 10.0), 3.0,
            changes=lambda _, level: ({"what": "camera", "noise": level},)),
    Trouble("defocus", "mm before it is calibrated", (100.0, 250.0), 100.0,
            changes=lambda subject, level: _each(subject, defocus_mm=level)),
    Trouble("indirect light", "share that comes back", (0.01, 0.05), 0.01,
            changes=lambda _, level: ({"what": "ambient", "indirect": level},)),
    Trouble("highlights", "strength of the gloss", (0.01, 0.05), 0.01,
            changes=lambda _, level: ({"what": "object", "gloss": level},)),
    Trouble("gamma error", "factor of the exponents, after calibration", (1.02, 1.05, 1.1), 1.02,
            after=lambda subject, level: _each(subject, gamma=level)),
    Trouble("focus lost", "mm after it is calibrated", (30.0, 100.0, 200.0), 30.0,
            after=lambda subject, level: _each(subject, defocus_mm=level)),
    Trouble("quantisation", "bits a channel", (7.0, 6.0, 5.0, 4.0), 7.0,
            frames=quantised),
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Met:
    """One level of one trouble. ``delta_e`` None: it could not be calibrated, ``why`` says so."""

    trouble: Trouble
    level: float
    delta_e: float | None
    rmse: float | None
    grade_percent: float | None
    why: str = ""


def robustness(subject: Subject) -> Result:
    """Meet every trouble at every level, and photograph the same appearance."""
    undisturbed = trial(subject, "undisturbed")
    jobs = [(trouble, level) for trouble in TROUBLES for level in trouble.levels]
    found = []
    for number, (trouble, level) in enumerate(jobs):
        subject.advance(number / len(jobs), f"{trouble.name}, {level:g} {trouble.unit}")
        found.append(_met(subject, undisturbed, trouble, level))
    base = undisturbed.quality.delta_e
    return Result(_criteria(base, found), (_table(base, found),), _figures(base, found), TEXT)


def _met(subject: Subject, undisturbed: Trial, trouble: Trouble, level: float) -> Met:
    hand: Stagehand = subject.parts.hand
    key = f"{trouble.name.replace(' ', '-')}-{level:g}"
    if trouble.frames is not None:
        made = shown(subject, key, undisturbed.wanted, trouble.frames(undisturbed.frames, level))
        return Met(trouble, level, made.quality.delta_e, made.quality.rmse, None)
    changes = trouble.changes or trouble.after
    assert changes is not None
    hand.disturb(*changes(subject, level))
    try:
        if trouble.changes is None:
            made = shown(subject, key, undisturbed.wanted, undisturbed.frames)
            return Met(trouble, level, made.quality.delta_e, made.quality.rmse, None)
        again = hand.again(key)
        made = trial(again.subject, key)
        return Met(trouble, level, made.quality.delta_e, made.quality.rmse, again.worst_percent)
    except VelaturaError as error:
        if error.code == "cancelled":
            raise
        return Met(trouble, level, None, None, None, error.what)
    finally:
        hand.disturb()


def _holds(base: float, one: Met) -> bool:
    return one.delta_e is not None and one.delta_e <= base + BREAKS


def _criteria(base: float, found: Sequence[Met]) -> tuple[Criterion, ...]:
    criteria = []
    for trouble in TROUBLES:
        some = [one for one in found if one.trouble is trouble]
        (asked,) = (one for one in some if one.level == trouble.holds_at)
        broken = [one for one in some if not _holds(base, one)]
        where = f"; breaks at {broken[0].level:g}" if broken else f"; holds to {some[-1].level:g}, the last tried"
        reached = "could not be calibrated" if asked.delta_e is None else f"{asked.delta_e:.2f} after {base:.2f}"
        criteria.append(
            Criterion(
                f"{trouble.name} of {trouble.holds_at:g} ({trouble.unit}): at most {BREAKS:g} CIEDE2000 more",
                reached + where,
                _holds(base, asked),
                asked.why,
            )
        )
    return tuple(criteria)


def _table(base: float, found: Sequence[Met]) -> Table:
    columns = ("trouble", "level", "unit", "CIEDE2000 median", "RMSE", "grade, worst projector (%)", "why not")

    def rounded(value: float | None, digits: int) -> Cell:
        return None if value is None else round(value, digits)

    rows: list[tuple[Cell, ...]] = [("none", None, "", round(base, 2), None, None, "")]
    rows += [
        (one.trouble.name, one.level, one.trouble.unit, rounded(one.delta_e, 2), rounded(one.rmse, 4),
         rounded(one.grade_percent, 2), one.why)
        for one in found
    ]  # fmt: skip
    return Table("robustness", "An appearance's error under each trouble", columns, tuple(rows))


def _figures(base: float, found: Sequence[Met]) -> tuple[Figure, ...]:
    lines = []
    for trouble in TROUBLES:
        some = [one for one in found if one.trouble is trouble and one.delta_e is not None]
        steps = [float(1 + trouble.levels.index(one.level)) for one in some]
        lines.append(Line(trouble.name, [0.0, *steps], [base, *(one.delta_e or 0.0 for one in some)]))
    return (
        Figure("robustness", "Median CIEDE2000 by level; the table has what the levels are.",
               plotted(lines, x="level (0: undisturbed)", y="CIEDE2000",
                       marks={"broken": ("y", base + BREAKS)}, log_y=True)),
    )  # fmt: skip


TEXT = """\
One trouble at a time, at growing strength. Noise, defocus, indirect light and highlights are there when the stage
is calibrated, and the calibration does what it can; gamma and focus change afterwards, and nobody notices;
quantisation is that of the frames. The model knows of neither indirect light nor highlights: light that comes back
evenly from the room looks to a calibration like a brighter white, but it depends on the whole frame; a highlight is
taken for paint. *Broken* is a limit of ours, not of the eye. Troubles are not combined, and highlights are of a
mildly glossy object, not of a mirror."""

ROBUSTNESS = Experiment(
    name="robustness",
    title="What the world may do",
    paper="Beyond the paper: robustness",
    shows="error curves, and where it breaks.",
    scene="painted",
    run=robustness,
    cost_s=900.0,
)
