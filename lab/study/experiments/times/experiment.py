"""Section 5: the time of every stage beside the paper's times."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

import numba
import numpy as np

import controller
from controller.optics.solve.appearance import base_image, solve_base
from controller.optics.solve.bounded.equations import SolveSettings, appearance_weights
from controller.optics.solve.bounded.solver import solve_bounded
from controller.optics.solve.scaling.interactive import interactive
from controller.optics.solve.targets.files import shipped_photograph
from controller.optics.solve.targets.values import through_camera
from controller.optics.solve.targets.wrap import wrap_photograph
from controller.optics.transport import build_transport
from controller.run.step_id import StepId
from controller.stage.artefacts.kinds import StepKind
from hal.runtime.compute import usable_cpus
from lab.study.experiments.times.quoted import Quote, quoted
from lab.study.subject.subject import Subject
from lab.study.values import Cell, Criterion, Experiment, Result, ResultTable

TIMINGS: Final = Path(controller.__file__).resolve().parents[1] / "lab" / "timings" / "README.md"
REPEATS: Final = 9
PAPER_PX: Final = 1400 * 1050
AN_HOUR_S, TWO_HOURS_S = 3600.0, 7200.0


PHOTOGRAPHS: Final = (StepKind.BLACK, StepKind.LIGHT, StepKind.CODES)


@dataclass(frozen=True, slots=True)
class TimedStage:
    """One stage of the way.

    ``steps``: kinds of the journal's steps that it is made of; none: it is measured here, under its name. ``each``: the
    mean of those steps, one a projector, else their sum. ``paper_s``: the paper's time, where it
    tells one, and ``paper_on`` what for; ``quotes``: rows of ``lab/timings/README.md`` at size paper that add up to it
    """

    name: str
    steps: tuple[StepKind, ...] = ()
    each: bool = False
    paper_s: float | None = None
    paper_on: str = ""
    quotes: tuple[Quote, ...] = ()

    @property
    def judged(self) -> bool:
        """Whether a fault could miss the paper's time.

        No plausible one could miss its hours, of which we take seconds; an emulated camera's time says nothing.
        """
        return self.paper_s is not None and self.paper_s < AN_HOUR_S and not set(self.steps) & set(PHOTOGRAPHS)


TRANSPORT: Final = "light transport, built"
BASE: Final = "base image"
APPEARANCE: Final = "new appearance, base times scale, to 8-bit frames"
FULL: Final = "new appearance, solved in full"
CALIBRATION: Final = (
    StepKind.EXPOSURE, StepKind.DELAY, *PHOTOGRAPHS, StepKind.CAMERA_RESPONSE, StepKind.CAMERA, StepKind.RADIOMETRY,
    StepKind.PIXELS, StepKind.GEOMETRY, StepKind.MODE, StepKind.VERIFY,
)  # fmt: skip
STAGES: Final = (
    TimedStage("exposures and delays found", (StepKind.EXPOSURE, StepKind.DELAY)),
    TimedStage("all photographs", PHOTOGRAPHS, paper_s=3600.0, paper_on="256 dots a projector and what goes before"),
    TimedStage("radiometry, a projector", (StepKind.RADIOMETRY,), each=True),
    TimedStage(
        "metapixels, a projector", (StepKind.PIXELS,), each=True, paper_s=180.0, paper_on="8 cores",
        quotes=(Quote("calibration/paper size", "decoding, a projector", "value"),
                Quote("calibration/paper size", "metapixels and phase map, a projector", "value")),
    ),
    TimedStage("geometry", (StepKind.GEOMETRY,), paper_s=600.0, paper_on="cores not given",
          quotes=(Quote("calibration/paper size", "geometry, N = 3", "value"),)),
    TimedStage(TRANSPORT, quotes=(Quote("solve", "light transport, build", "paper"),)),
    TimedStage(BASE, paper_s=3600.0, paper_on="8 cores, by regions", quotes=(Quote("solve", "base image", "paper"),)),
    TimedStage(APPEARANCE, paper_s=1.0, paper_on="less than",
          quotes=(Quote("live", "new appearance, float picture in memory to 8-bit frames", "paper"),)),
    TimedStage(FULL),
    TimedStage("all up to the first appearance", CALIBRATION, paper_s=TWO_HOURS_S, paper_on="2 to 3 hours"),
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Durations:
    """Seconds by the clock and of the processor, all threads together; None where it was not measured."""

    wall_s: float
    cpu_s: float | None = None


def times(subject: Subject) -> Result:
    """Read what the calibration took from the run's journal, and take the time of what is solved."""
    load = os.getloadavg()[0]
    measured = _measured(subject)
    journal: Mapping[StepId, float] = subject.parts.context.journal.steps()
    text = TIMINGS.read_text() if TIMINGS.exists() else ""
    here = {stage.name: _spent(stage, journal, measured) for stage in STAGES}
    rows = [_row(stage, here[stage.name], text) for stage in STAGES]
    criteria = tuple(_criterion(stage, here[stage.name], text, subject.size) for stage in STAGES if stage.judged)
    return Result(criteria, (_table(rows, subject.size),), (), f"{TEXT}\n\n{_facts(subject, load)} {_source(text)}")


def _facts(subject: Subject, load: float) -> str:
    parts = subject.calibration.projectors
    pixels = sum(part.metapixels.valid.size for part in parts) / len(parts)
    rows, columns = subject.mask.shape
    times_fewer = round(PAPER_PX / pixels)
    beside = f"{times_fewer} times fewer than" if times_fewer > 1 else "as many as"
    return (
        f"*This run*: size {subject.size}, {len(parts)} projectors of {pixels:.0f} pixels, {beside}"
        f" the paper's, and a camera of {columns}x{rows}; {_cores()} cores, {numba.get_num_threads()}"
        f" of them used for the solves, a load of {load:.1f} when those began."
    )


def _cores() -> int:
    return usable_cpus()


def _source(text: str) -> str:
    if text:
        return (
            "*At the paper's size* is quoted from the tables of `lab/timings/README.md` of the day when this "
            "page was made; they give the load of each measurement."
        )
    return "`lab/timings/README.md` is missing beside this program, so nothing is quoted at the paper's size."


def _measured(subject: Subject) -> dict[str, Durations]:
    """Seconds of what follows the calibration, on this stage. Compiled, or read from the cache, before."""
    calibration, black = subject.calibration, subject.calibration.black
    found: dict[str, Durations] = {}
    subject.advance(0.0, "light transport")
    build_transport(calibration)
    found[TRANSPORT] = _fastest(partial(build_transport, calibration), 1)
    even = base_image(calibration, "white")
    solve_bounded(subject.transport, even, black, SolveSettings(most_iterations=2))
    subject.advance(0.2, "base image")
    base = solve_base(subject.transport, even, black)
    found[BASE] = _fastest(partial(solve_base, subject.transport, even, black), 1)
    subject.advance(0.6, "new appearance")
    photograph = shipped_photograph("astronaut")
    wanted = subject.wanted(through_camera(wrap_photograph(photograph, subject.geometry, subject.mask)))
    radiometries = [part.radiometry for part in calibration.projectors]
    ready = interactive(subject.transport, base, black, radiometries, subject.indirect)
    ready.frames(wanted.radiance)
    found[APPEARANCE] = _fastest(partial(ready.frames, wanted.radiance), REPEATS)
    subject.advance(0.7, "a full solve")
    weights = appearance_weights(wanted.radiance, wanted.mask, wanted.white)
    full = partial(solve_bounded, subject.transport, wanted.direct, black, SolveSettings(weights=weights))
    found[FULL] = _fastest(full, 1)
    return found


def _fastest(work: Callable[[], object], repeats: int) -> Durations:
    """The least of each clock over the repeats."""
    found = []
    for _ in range(repeats):
        began = np.array([time.perf_counter(), time.process_time()])
        work()
        found.append(np.array([time.perf_counter(), time.process_time()]) - began)
    wall_s, cpu_s = np.min(found, axis=0)
    return Durations(float(wall_s), float(cpu_s))


def _spent(stage: TimedStage, journal: Mapping[StepId, float], measured: Mapping[str, Durations]) -> Durations | None:
    """None where the journal knows no step of that stage."""
    if not stage.steps:
        return measured[stage.name]
    seconds = [spent_s for step, spent_s in journal.items() if step.kind in stage.steps]
    if not seconds:
        return None
    total = float(np.mean(seconds)) if stage.each else float(np.sum(seconds))
    if stage.steps == CALIBRATION:
        total += measured[TRANSPORT].wall_s + measured[BASE].wall_s + measured[APPEARANCE].wall_s
    return Durations(total)


def _row(stage: TimedStage, here: Durations | None, text: str) -> tuple[Cell, ...]:
    seconds, words = quoted(text, stage.quotes)
    return (
        stage.name,
        None if here is None else float(f"{here.wall_s:.3g}"),
        None if here is None or here.cpu_s is None else float(f"{here.cpu_s:.3g}"),
        None if seconds is None else float(f"{seconds:.3g}"),
        words,
        stage.paper_s,
        stage.paper_on,
    )


def _criterion(stage: TimedStage, here: Durations | None, text: str, size: str) -> Criterion:
    assert stage.paper_s is not None
    asked = f"{stage.name}: at the paper's size no longer than the paper's {stage.paper_s:g} s"
    seconds, words = quoted(text, stage.quotes)
    if size == "paper" and here is not None:
        holds = here.wall_s <= stage.paper_s
        return Criterion(asked, f"{here.wall_s:.3g} s", holds, "" if holds else "Measured in this run; see its load.")
    also = "" if here is None else f"; {here.wall_s:.3g} s at size {size}"
    if seconds is None:
        return Criterion(asked, f"not measured at that size{also}", None, "Measured only at this run's size.")
    holds = seconds <= stage.paper_s
    return Criterion(asked, f"{seconds:.3g} s, quoted{also}", holds, "" if holds else f"As measured: {words}.")


def _table(rows: Sequence[tuple[Cell, ...]], size: str) -> ResultTable:
    columns = (
        "stage", f"seconds, this run, {size}", "of the processor", "seconds at the paper's size, quoted",
        "as it stands there", "the paper's seconds", "the paper's with",
    )  # fmt: skip
    return ResultTable("times", "Seconds of every stage", columns, tuple(rows))


TEXT = """\
The calibration's seconds are wall times from this run's journal. The bench, which computes every photograph, shares
the machine with it, and the load at that time was not recorded. The later stages were repeated for this table with
compiled code: the least of nine for the new appearance, one for the others, as wall time and processor time. The paper
calibrated with a real camera and 256 dots a projector, on eight cores of 3 GHz. An emulated camera does not show how
long a real one takes, so photographs and total are not judged, nor what took the paper an hour: that could not be
missed. The paper avoids a full solve for
each new appearance and gives no time for one."""

TIMES = Experiment(
    name="times",
    title="Times",
    paper="Paper 5",
    shows="the stages that could be slower than the paper's are not, on two cores.",
    scene="painted",
    run=times,
    cost_s=20.0,
)
