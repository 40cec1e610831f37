"""A base solve on a calibrated stage next to the synthetic one of the same size, and what each factor between is.

``BENCH_RUN=FOLDER python -m lab.timings calibrated --size medium``: the folder of a calibrated run of that size, for
example of `make demo SIZE=medium`. Processor times, which other programs change less than seconds of the clock.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from controller.optics.calibrate.values import Calibration
from controller.optics.solve.appearance import base_image
from controller.optics.transport import LightTransport, build_transport
from controller.optics.transport.windows.profiles import OTHER, SORTS, UPRIGHT
from controller.stage.artefacts.calibrated import Calibrated
from controller.stage.artefacts.geometry import projectors_of
from lab.timings import Row, at_most
from lab.timings.tools.synthetic import synthetic_calibration
from lab.timings.tools.traced import Trace, traced

NEAR_BEST = 1e-3
SWEEPS = 150
MOST_S = 150.0


@dataclass(frozen=True, slots=True)
class _Stage:
    name: str
    transport: LightTransport
    trace: Trace
    build_s: float

    @property
    def windows(self) -> int:
        return int(self.transport.arrays()["first"][-1])

    def sort(self, which: int) -> float:
        """Share of the windows that are of one sort."""
        counts = np.diff(self.transport.arrays()["first"])
        return float(counts[which::SORTS].sum() / max(counts.sum(), 1))

    @property
    def sweep_s(self) -> float:
        """Processor seconds of a sweep, the median."""
        spent = [self.trace.setup.processor_s, *(sweep.processor_s for sweep in self.trace.sweeps)]
        return float(np.median(np.diff(spent)))

    @property
    def to_near(self) -> tuple[int, float, float]:
        """Sweeps, processor seconds and seconds to near the best."""
        number, at = self.trace.reached(self.trace.best * (1 + NEAR_BEST))
        return number, at.processor_s, at.seconds


def measure(size: str) -> list[Row]:
    """Sizes, sorts of windows, sweeps and times of both, and the factors."""
    run = os.environ.get("BENCH_RUN")
    if not run:
        sys.exit("Set BENCH_RUN to the folder of a calibrated run of this size.")
    calibrated = Calibrated(Path(run), projectors_of(Path(run)))
    made = synthetic_calibration(size)
    stages = [
        _solved("synthetic", made, lambda: build_transport(made)),
        _solved("calibrated", calibrated.calibration, lambda: calibrated.transport),
    ]
    rows = [row for stage in stages for row in _of(stage)]
    one, other = stages
    (few, few_s, _), (many, many_s, _) = one.to_near, other.to_near
    rows += [
        _factor("base, processor time", many_s / few_s),
        _factor("sweeps", many / few),
        _factor("a sweep, processor time", other.sweep_s / one.sweep_s),
        _factor("windows", other.windows / one.windows),
        _factor("a sweep by window", other.sweep_s / other.windows / (one.sweep_s / one.windows)),
        _factor("before the first sweep", other.trace.setup.processor_s / one.trace.setup.processor_s),
    ]
    return rows


def _solved(name: str, calibration: Calibration, transport: Callable[[], LightTransport]) -> _Stage:
    began = time.process_time()
    made = transport()
    build_s = time.process_time() - began
    image = base_image(calibration, "white")
    traced(made, image, calibration.black, 1)
    return _Stage(name, made, traced(made, image, calibration.black, SWEEPS, most_s=MOST_S), build_s)


def _of(stage: _Stage) -> list[Row]:
    sweeps, processor_s, seconds = stage.to_near
    kind = type(stage.transport).__name__
    return [
        at_most(f"{stage.name}: windows", stage.windows / 1e6, None, unit="million",
                how=f"{kind}; {100 * stage.sort(UPRIGHT):.0f} % upright, {100 * stage.sort(OTHER):.1f} % large"),
        at_most(f"{stage.name}: camera pixels lit", float(stage.transport.object_mask.mean()), None, unit="",
                how=f"{stage.transport.pixels} projector pixels, {stage.transport.lit.sum(axis=(1, 2)).tolist()} lit"),
        at_most(f"{stage.name}: transport built", stage.build_s, None, unit="s of processor time", how="once"),
        at_most(f"{stage.name}: before the first sweep", stage.trace.setup.processor_s, None,
                unit="s of processor time", how=f"{stage.trace.setup.seconds:.2f} s"),
        at_most(f"{stage.name}: a sweep", 1000 * stage.sweep_s, None, unit="ms of processor time",
                how=f"median; {stage.trace.sweep}"),
        at_most(f"{stage.name}: base to {NEAR_BEST:g}", processor_s, None, unit="s of processor time",
                how=f"{sweeps} sweeps, {seconds:.2f} s; best of {len(stage.trace.sweeps)}"),
    ]  # fmt: skip


def _factor(what: str, value: float) -> Row:
    return at_most(f"calibrated by synthetic: {what}", value, None, unit="x", how="")
