"""Beyond the paper: error against number of photographs, for the fast mode and for dots."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from controller.stage.steps.modes import DotOptions
from lab.study.output.drawing import Line, plotted
from lab.study.subject.measuring import SET_COLUMNS, set_cells
from lab.study.subject.subject import StageControl, Subject
from lab.study.subject.trial import run_trial
from lab.study.values import Cell, Criterion, Experiment, Figure, Result, ResultTable

SPACINGS_PX: Final = (4, 6, 8, 12)
WIDEST_PX: Final = 16
"""The paper's; 256 more photographs a projector."""
FAST: Final = "fast"


@dataclass(frozen=True, slots=True)
class EffortResult:
    """One calibration: photographs a projector, its grade in percent (worst projector), and an appearance's error."""

    way: str
    photographs: float
    grade_percent: float
    delta_e: float
    delta_e_p95: float
    rmse: float
    cells: tuple[str, ...]


def effort(subject: Subject) -> Result:
    """Calibrate again, with the fast mode and then with dots at growing distances; photograph an appearance with each.

    What the fast mode photographs is photographed once: each of the others begins with it.
    """
    spacings = (*SPACINGS_PX, WIDEST_PX) if subject.size != "small" else SPACINGS_PX
    hand: StageControl = subject.parts.hand
    ways: list[tuple[str, DotOptions]] = [(FAST, DotOptions())]
    ways += [(f"dots, r = {spacing}", DotOptions("paper", spacing)) for spacing in spacings]
    results = []
    for number, (way, options) in enumerate(ways):
        subject.advance(number / len(ways), way)
        key = way.replace(", r = ", "-")
        again = hand.again(key, options, beyond=FAST if way != FAST else None)
        made = run_trial(again.subject, key)
        projectors = len(subject.calibration.projectors)
        found = made.quality
        results.append(
            EffortResult(
                way=way,
                photographs=again.photographs / projectors,
                grade_percent=again.worst_percent,
                delta_e=found.delta_e,
                delta_e_p95=found.delta_e_p95,
                rmse=found.rmse,
                cells=set_cells(found.pixels, made.wanted),
            )
        )
    return Result(_criteria(results), (_table(results),), _figures(results), TEXT)


def _criteria(results: Sequence[EffortResult]) -> tuple[Criterion, ...]:
    fast, dots = results[0], results[1:]
    best = min(dots, key=lambda result: result.delta_e)
    holds = fast.delta_e <= best.delta_e + 0.1
    return (
        Criterion(
            "the fast way is as good as the best dots, within 0.1 CIEDE2000",
            f"{fast.delta_e:.2f} with {fast.photographs:.0f} photographs a projector; "
            f"{best.way}: {best.delta_e:.2f} with {best.photographs:.0f}",
            holds,
            "" if holds else "Dots measure the shape of each pixel separately; the fast way smooths it.",
        ),
        Criterion(
            "and in its 95 % of pixels, within 0.3 CIEDE2000",
            f"{fast.delta_e_p95:.2f}; {best.way}: {best.delta_e_p95:.2f}",
            fast.delta_e_p95 <= best.delta_e_p95 + 0.3,
            "" if fast.delta_e_p95 <= best.delta_e_p95 + 0.3 else "Dots measure places near edges separately.",
        ),
    )


def _table(results: Sequence[EffortResult]) -> ResultTable:
    columns = (
        "calibrated by", "photographs a projector", "grade, worst projector (%)", "CIEDE2000 median", "95 %", "RMSE",
        *SET_COLUMNS,
    )  # fmt: skip
    rows: tuple[tuple[Cell, ...], ...] = tuple(
        (
            result.way,
            round(result.photographs, 1),
            round(result.grade_percent, 2),
            round(result.delta_e, 2),
            round(result.delta_e_p95, 2),
            round(result.rmse, 4),
            *result.cells,
        )
        for result in results
    )
    return ResultTable("effort", "Error by number of photographs", columns, rows)


def _figures(results: Sequence[EffortResult]) -> tuple[Figure, ...]:
    dots = results[1:]
    lines = [
        Line("dots", [result.photographs for result in dots], [result.grade_percent for result in dots]),
        Line("fast", [results[0].photographs], [results[0].grade_percent], "D"),
    ]
    errors = [
        Line("dots", [result.photographs for result in dots], [result.delta_e for result in dots]),
        Line("fast", [results[0].photographs], [results[0].delta_e], "D"),
    ]
    return (
        Figure("grade", "Error of a predicted random pattern, worst projector, by photographs a projector.",
               plotted(lines, x="photographs a projector", y="error of the prediction (%)", y_range=(0, None))),
        Figure("error", "Median CIEDE2000 of a photographed appearance, by photographs a projector.",
               plotted(errors, x="photographs a projector", y="CIEDE2000", y_range=(0, None))),
    )  # fmt: skip


TEXT = """\
The same stage is calibrated several times: with the fast mode, and with dots r pixels apart. Dots need r x r
photographs a projector in addition to those of the fast mode, which locate them; all begin with the same ones of the
fast mode. The grade is the error of a random pattern that was predicted and photographed. Photographs include all
brackets. Dots that are too near to each other overlap where the picture is blurred; dots farther apart cost
photographs. A fast calibration with fewer photographs is not shown: its patterns depend on each other, and none can be
left out alone. That dots take more photographs is no criterion: they come on top of those of the fast mode."""

EFFORT = Experiment(
    name="effort",
    title="Error by number of photographs",
    paper="Beyond the paper: error against number of captures",
    shows="the fast way reaches what dots reach, with far fewer photographs.",
    scene="painted",
    run=effort,
    cost_s=600.0,
)
