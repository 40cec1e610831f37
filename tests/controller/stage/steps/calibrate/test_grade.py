from __future__ import annotations

import json
from pathlib import Path

import pytest

from controller.core.errors import CalibrationError
from controller.run.progress import Silent
from controller.stage.artefacts.grade import graded, passes
from controller.stage.steps.calibrate.gate import compare_with_last, require
from hal.notices import Level


class Heard(Silent):
    def __init__(self) -> None:
        self.loud: list[str] = []

    def say(self, text: str, level: Level = Level.INFO) -> None:
        if level is Level.WARNING:
            self.loud.append(text)


def run_with(folder: Path, **percent: float) -> Path:
    folder.mkdir()
    rows = {
        name: {"relative_rms": value / 100, "reasons": [{"sentence": "The projector is out of focus."}]}
        for name, value in percent.items()
    }
    (folder / "verification.json").write_text(json.dumps(rows))
    return folder


def test_the_worst_projector_decides(tmp_path: Path) -> None:
    run = run_with(tmp_path / "run", left=1.0, right=9.0)
    assert graded(run) == pytest.approx({"left": 1.0, "right": 9.0})
    with pytest.raises(CalibrationError) as caught:
        require(run, 8.0, accepted=False, reporter=Silent())
    assert (caught.value.code, caught.value.exit_code) == ("calibration-below-grade", 1)
    for word in ("right", "9.0 %", "8 %", "out of focus"):
        assert word in caught.value.what
    require(run, 10.0, accepted=False, reporter=Silent())


def test_a_person_can_accept_it_loudly_and_it_stays_accepted(tmp_path: Path) -> None:
    run, heard = run_with(tmp_path / "run", left=9.0), Heard()
    require(run, 8.0, accepted=True, reporter=heard)
    assert len(heard.loud) == 1
    assert passes(run, 8.0)
    require(run, 8.0, accepted=False, reporter=heard)


def test_a_prediction_that_failed_altogether_is_refused(tmp_path: Path) -> None:
    assert not passes(run_with(tmp_path / "run", left=float("nan")), 8.0)


def test_a_worse_calibration_is_told_of_although_it_passes(tmp_path: Path) -> None:
    last, heard = run_with(tmp_path / "last", left=1.5), Heard()
    compare_with_last(run_with(tmp_path / "alike", left=1.6), last, heard)
    assert heard.loud == []
    compare_with_last(run_with(tmp_path / "worse", left=3.0), last, heard)
    assert len(heard.loud) == 1
