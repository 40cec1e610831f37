"""Beyond the paper: how much a calibration's photographs buy, the fast way and by dots."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from controller.session.modes import DotOptions
from controller.study.drawing import Line, plotted
from controller.study.stagehand import Stagehand
from controller.study.subject import Subject
from controller.study.trial import trial
from controller.study.values import Criterion, Experiment, Figure, Result, Table

SPACINGS_PX: Final = (4, 6, 8, 12)
WIDEST_PX: Final = 16
"""The paper's; 256 photographs a projector more."""
FAST: Final = "fast"


@dataclass(frozen=True, slots=True)
class Bought:
    """One calibration: photographs a projector, its grade in percent (worst projector), and an appearance's error."""

    way: str
    photographs: float
    grade_percent: float
    delta_e: float
    rmse: float


def effort(subject: Subject) -> Result:
    """Calibrate anew, the fast way and by dots farther and farther apart; photograph an appearance with each."""
    spacings = (*SPACINGS_PX, WIDEST_PX) if subject.size != "small" else SPACINGS_PX
    hand: Stagehand = subject.parts.hand
    ways: list[tuple[str, DotOptions]] = [(FAST, DotOptions())]
    ways += [(f"dots, r = {spacing}", DotOptions("paper", spacing)) for spacing in spacings]
    found = []
    for number, (way, options) in enumerate(ways):
        subject.advance(number / len(ways), way)
        key = way.replace(", r = ", "-")
        again = hand.again(key, options)
        made = trial(again.subject, key)
        projectors = len(subject.calibration.projectors)
        found.append(
            Bought(way, again.photographs / projectors, again.worst_percent, made.quality.delta_e, made.quality.rmse)
        )
    return Result(_criteria(found), (_table(found),), _figures(found), TEXT)


def _criteria(found: Sequence[Bought]) -> tuple[Criterion, ...]:
    fast, dots = found[0], found[1:]
    best = min(dots, key=lambda one: one.delta_e)
    holds = fast.delta_e <= best.delta_e + 0.1
    return (
        Criterion(
            "the fast way is as good as the best dots, within 0.1 CIEDE2000",
            f"{fast.delta_e:.2f} with {fast.photographs:.0f} photographs a projector; "
            f"{best.way}: {best.delta_e:.2f} with {best.photographs:.0f}",
            holds,
            "" if holds else "Dots measure each pixel's shape by itself, which the fast way smooths.",
        ),
        Criterion(
            "and takes fewer photographs than any dots",
            f"{fast.photographs:.0f} a projector against {min(one.photographs for one in dots):.0f}",
            fast.photographs < min(one.photographs for one in dots),
        ),
    )


def _table(found: Sequence[Bought]) -> Table:
    columns = ("calibrated by", "photographs a projector", "grade, worst projector (%)", "CIEDE2000 median", "RMSE")
    rows = tuple(
        (one.way, round(one.photographs, 1), round(one.grade_percent, 2), round(one.delta_e, 2), round(one.rmse, 4))
        for one in found
    )
    return Table("effort", "What photographs buy", columns, rows)


def _figures(found: Sequence[Bought]) -> tuple[Figure, ...]:
    dots = found[1:]
    lines = [
        Line("dots", [one.photographs for one in dots], [one.grade_percent for one in dots]),
        Line("fast", [found[0].photographs], [found[0].grade_percent], "D"),
    ]
    errors = [
        Line("dots", [one.photographs for one in dots], [one.delta_e for one in dots]),
        Line("fast", [found[0].photographs], [found[0].delta_e], "D"),
    ]
    return (
        Figure("grade", "Error of a predicted random pattern, worst projector, by photographs a projector.",
               plotted(lines, x="photographs a projector", y="error of the prediction (%)")),
        Figure("error", "Median CIEDE2000 of a photographed appearance, by photographs a projector.",
               plotted(errors, x="photographs a projector", y="CIEDE2000")),
    )  # fmt: skip


TEXT = """\
The same stage is calibrated from nothing again and again: the fast way, and with dots r pixels apart (r x r
photographs a projector more than the fast way's, which locate them). The grade is the error of a random pattern
that was predicted and photographed. Photographs count all brackets. Dots that are too near to each other run into
one another where the picture is blurred; dots farther apart cost photographs. What a fast calibration with fewer
photographs than its plan would lose is not shown: its patterns depend on each other, and none can be left out
alone."""

EFFORT = Experiment(
    name="effort",
    title="What photographs buy",
    paper="Beyond the paper: error against number of captures",
    shows="the fast way reaches what dots reach, with far fewer photographs.",
    scene="painted",
    run=effort,
    cost_s=600.0,
)
