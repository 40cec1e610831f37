"""Experiments of the study on the bench's own optics and a real calibration, not on a model of the program.

`make nightly` does all of them with devices, photographs and recalibrations; these are those that take seconds.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
import tifffile

from controller.core.arrays import FloatImage
from controller.stage.artefacts.calibrated import Calibrated
from controller.stage.artefacts.geometry import read_geometry
from controller.stage.sessions.check import check_stage
from controller.stage.steps.appearance.solving import device_frames
from lab.study.experiments.frequency.experiment import PLANNED, rising_sinusoid
from lab.study.experiments.live import live_pictures
from lab.study.experiments.residual import BRIGHT, residual
from lab.study.subject.measuring import SET_COLUMNS
from lab.study.subject.subject import Dots, Subject
from lab.study.subject.trial import run_trial
from lab.study.values import Result, column
from lab.timings.tools.truth import Truth, developed
from plugins.emulated.optics.sensor import REFERENCE_APERTURE_F
from tests.end_to_end.conftest import FinishedDemo
from tests.end_to_end.program import run_of

pytestmark = [pytest.mark.long, pytest.mark.timeout(1200)]


@dataclass
class BenchLight:
    """Photographs of what the bench's optics show, without noise, in the calibration's unit."""

    calibrated: Calibrated
    truth: Truth
    aperture_f: float
    names: list[str] = field(default_factory=list)

    def photograph(self, name: str, frames: Sequence[FloatImage], *, white: float) -> FloatImage:
        assert name not in self.names
        self.names.append(name)
        shown = device_frames(self.calibrated.calibration, frames)
        sensor = self.truth.bench.camera.sensor
        steps = sensor.white_level - sensor.black_level
        opening = (REFERENCE_APERTURE_F / self.aperture_f) ** 2
        unit = np.float32(sensor.electrons_per_light_s * opening / (sensor.electrons_per_step * steps))
        light = unit * self.truth.picture([shown[name] for name in self.calibrated.projectors])
        return developed(light, float(light.max()))

    def dots(self, n: int, *, plain: bool = False) -> Dots:
        raise AssertionError("experiments that need dots are done by `make nightly`")


def aperture_of(photograph: Path) -> float:
    """The f-number in a photograph's EXIF data."""
    with tifffile.TiffFile(photograph) as file:
        over, under = file.pages.first.tags["ExifTag"].value["FNumber"]
    return float(over / under)


@pytest.fixture(scope="module")
def subject(finished_demo: FinishedDemo) -> Subject:
    run, names = run_of(finished_demo.stage), check_stage(finished_demo.stage).names
    calibrated = Calibrated(run, names)
    light = BenchLight(calibrated, Truth(finished_demo.stage), aperture_of(next(run.rglob("*.dng"))))
    return Subject(
        calibration=calibrated.calibration,
        geometry=read_geometry(run, names),
        transport=calibrated.transport,
        light=light,
        indirect=calibrated.indirect,
    )


@pytest.fixture
def fresh(subject: Subject) -> Subject:
    """With no photograph taken yet."""
    assert isinstance(subject.light, BenchLight)
    subject.light.names.clear()
    return subject


def test_a_photograph_of_the_optics_is_one_that_the_demo_took(fresh: Subject, finished_demo: FinishedDemo) -> None:
    (told,) = (one for one in json.loads((finished_demo.out / "report.json").read_text())["appearances"]
               if one["name"] == "photograph")  # fmt: skip
    found = run_trial(fresh, "photograph")
    assert found.quality.delta_e == pytest.approx(told["delta_e00_median"], rel=0.5)
    assert found.quality.pixels["in_reach"].left_out_share > 0.04


@pytest.mark.parametrize("run", [residual, live_pictures, rising_sinusoid], ids=lambda run: run.__name__)
def test_an_experiment_judges_everything_that_it_asks_and_leaves_no_figure_out(
    fresh: Subject, run: Callable[[Subject], Result]
) -> None:
    result = run(fresh)
    assert result.figures
    assert all(one.holds is not None and one.reached for one in result.criteria)
    for table in result.tables:
        assert table.rows
        for name in set(table.columns) & set(SET_COLUMNS):
            assert all(column(table, name)), name
    if run is rising_sinusoid:
        planned = [one.holds for one in result.criteria if one.asked.endswith(PLANNED)]
        assert planned == [True, True]
    if run is residual:
        (table,) = result.tables
        mean = dict(zip(zip(column(table, "as bright as"), column(table, "projectors"), strict=True),
                        column(table, "photographed, mean"), strict=True))  # fmt: skip
        assert float(str(mean[BRIGHT, 1])) > 2 * float(str(mean[BRIGHT, 3])), "one projector lacks light"
