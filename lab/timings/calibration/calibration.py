"""A real calibration of random stages through real devices, and then against what the stages really are.

A goal holds where the worst stage (or projector of one) reaches it; that is the value, median and best stand beside it.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from controller.core.arrays import FloatImage
from controller.core.errors import VelaturaError
from controller.demo import DEFAULT_ROOM
from controller.optics.calibrate.correspondence.captures import completed
from controller.optics.calibrate.correspondence.decode import decode
from controller.optics.calibrate.metapixels.from_phase import fit_metapixels
from controller.run.step_id import StepId
from controller.stage.artefacts.calibration import read_calibration, read_captures
from controller.stage.artefacts.kinds import StepKind
from controller.stage.artefacts.pattern_plans import PlanUsed
from controller.stage.artefacts.photographs import Developed
from controller.stage.artefacts.projectors import Light, Pixels
from lab.timings import Row, at_least, at_most, peak_bytes
from lab.timings.tools.judge import geometry_errors, map_errors, metapixel_errors, pattern_errors, radiometry_errors
from lab.timings.tools.stage import FIRST_SEED, CalibratedStage, calibrated_stage, over
from lab.timings.tools.truth import Truth

STAGES = {"small": 5, "medium": 3, "paper": 1}
CODES = ("gray-", "phase-", "blur-")


@dataclass(slots=True)
class Found:
    """Figures by name, a value for each stage (or each projector of each stage), and stages that failed."""

    values: dict[str, list[float]] = field(default_factory=dict)
    failed: list[str] = field(default_factory=list)

    def add(self, figures: dict[str, float]) -> None:
        for name, value in figures.items():
            self.values.setdefault(name, []).append(value)


def measure(size: str, *, room: str = DEFAULT_ROOM) -> list[Row]:
    """Calibrate ``STAGES`` random stages of a size in a room of the bench and compare with their truths."""
    found, stages = Found(), STAGES[size]
    for seed in range(FIRST_SEED, FIRST_SEED + stages):
        try:
            with calibrated_stage(size, seed, room=room) as stage:
                _judge(stage, found)
        except VelaturaError as error:
            found.failed.append(f"seed {seed}: {error.what}")
    return _rows(found, stages, paper=size == "paper")


def _judge(stage: CalibratedStage, found: Found) -> None:
    calibration = read_calibration(stage.run, stage.names)
    truth = Truth(stage.folder)
    found.add({"captures": stage.shots / len(stage.names), "calibration s": stage.wall_s})
    found.add({"geometry s": stage.seconds[StepId(StepKind.GEOMETRY)]})
    shot_s = [s for step, s in stage.seconds.items() if step.kind in (StepKind.LIGHT, StepKind.CODES)]
    found.add({"shooting s": sum(shot_s) / len(stage.names)})
    found.add(geometry_errors(stage, truth))
    for n, part in enumerate(calibration.projectors):
        found.add(radiometry_errors(truth, n, part.radiometry))
        found.add(map_errors(truth, n, stage.run))
        found.add(metapixel_errors(truth, n, part.metapixels))
    for figures in pattern_errors(stage, truth):
        found.add(figures)
    found.add(_timed(stage.run, stage.names[0]))


def _timed(run: Path, name: str) -> dict[str, float]:
    """Seconds of decoding and of the metapixels, compiled by the calibration before; photographs are read meanwhile."""
    light = Light.read(run, name)
    taken = read_captures(run, name)
    ready: dict[str, FloatImage] = {"black": light.black, "white": light.white + light.black}
    rows, columns = Pixels.read(run, name).valid.shape
    plan = PlanUsed.read(run, name).plan((columns, rows))
    captures = completed(Developed(taken, ready), plan)
    reading = _seconds(lambda: [captures[key] for key in taken if key.startswith(CODES)])
    correspondence = decode(captures, plan)
    return {
        "developing s": reading,
        "decode s": _seconds(lambda: decode(captures, plan)),
        "metapixels s": _seconds(lambda: fit_metapixels(captures, plan, correspondence)),
    }


def _seconds(work: Callable[[], object]) -> float:
    began = time.perf_counter()
    work()
    return time.perf_counter() - began


def _rows(found: Found, stages: int, *, paper: bool) -> list[Row]:
    done = len(found.values.get("captures", ()))
    rows = [
        at_least(
            "stages calibrated", done, stages, unit=f"of {stages}", how="; ".join(found.failed) or "every one converged"
        )
    ]
    if not done:
        return rows

    def worst(figure: str, key: str, goal: float | None, *, unit: str, scale: float = 1.0, more: str = "") -> None:
        values = [scale * value for value in found.values[key] if np.isfinite(value)]
        how = over(values) + (f"; {more}" if more else "")
        rows.append(at_most(figure, max(values), goal, unit=unit, how=how))

    def at_paper(goal: float) -> float | None:
        return goal if paper else None

    worst(
        "captures a projector", "captures", at_paper(36), unit="", more="brackets, mosaics and random pattern included"
    )
    worst("correspondences, in focus, head-on", "map in focus px", 0.05, unit="projector px rms")
    worst("correspondences, all", "map px", None, unit="projector px rms", more="without those off by more than 1 px")
    worst("correspondences off by more than 1 px", "map gross", None, unit="%", scale=100)
    worst("metapixel centre, in focus", "centre in focus px", 0.05, unit="camera px rms", more="one surface, x and y")
    worst("metapixel centre, defocused", "centre defocused px", 0.10, unit="camera px rms", more="one surface, x and y")
    worst("metapixel centre, any place", "centre px", None, unit="camera px, median", more="folds and edges too")
    worst("metapixel sigma, relative", "sigma", 2.0, unit="% rms", scale=100, more="one surface")
    worst("metapixels judged as on one surface", "judged", None, unit="%", scale=100, more="the others: edges, folds")
    worst("metapixel sigma, bias", "sigma bias", None, unit="%", scale=100, more="median of measured / true - 1")
    worst("projector linearisation", "response", 0.5, unit="% of full scale", scale=100, more="largest of 3 x 256")
    worst("colour mixing", "mixing", None, unit="%", scale=100, more="largest of nine entries")
    _pattern_rows(worst)
    _geometry_rows(worst)
    worst(
        "decode, a projector",
        "decode s",
        at_paper(5.0),
        unit="s",
        more=f"development {over(found.values['developing s'])} s in it",
    )
    worst("metapixels, a projector", "metapixels s", at_paper(8.0), unit="s", more="with the development of nine")
    worst("geometry", "geometry s", at_paper(60.0), unit="s", more="in the run, compiling included at the first")
    worst("photographing, a projector", "shooting s", None, unit="s", more="exposures at a quarter of their length")
    rows.append(
        at_most(
            "peak memory of the process", peak_bytes() / 1e9, at_paper(3.0), unit="GB", how="truth and judging included"
        )
    )
    return rows


def _pattern_rows(worst: Callable[..., None]) -> None:
    worst(
        "predicted random pattern", "random photographed", 2.0, unit="% rms", scale=100, more="against its photograph"
    )
    worst("the same without noise", "random", None, unit="% rms", scale=100, more="white image still measured")
    worst("noise of that photograph", "random noise", None, unit="% rms", scale=100)
    worst(
        "predicted one-pixel chequers", "chequers", None, unit="% rms", scale=100, more="against a noise-free picture"
    )
    worst("predicted two-pixel columns", "columns", None, unit="% rms", scale=100, more="against a noise-free picture")
    worst(
        "column of T, one surface",
        "column of T, one surface",
        2.5,
        unit="% rms",
        scale=100,
        more="single pixels, 3 camera px or more from edges and folds",
    )
    worst("column of T, everywhere", "column of T", None, unit="% rms", scale=100, more="edges and folds too")


def _geometry_rows(worst: Callable[..., None]) -> None:
    worst("shape", "shape mm", 0.2, unit="mm rms", more="after alignment by a similarity; pixels beyond 5 mm left out")
    worst("shape beyond 5 mm", "shape gross", None, unit="%", scale=100)
    worst("projector poses, turned", "pose degrees", 0.2, unit="degrees", more="worst projector")
    worst("projector poses, displaced", "pose mm", 4.0, unit="mm", more="worst projector, scale aligned")
    worst("scale", "scale", None, unit="%", scale=100, more="the tape measure's 1 % is in it")


__all__: Sequence[str] = ("measure",)
