"""What the demo's appearances achieve, photographed again by the running kiosk."""

from __future__ import annotations

import json
import shutil
import threading
from pathlib import Path

import pytest

from controller.kiosk.api.control import call_kiosk
from controller.stage.sessions.bench import BenchProcess
from tests.end_to_end.conftest import FinishedDemo
from tests.end_to_end.kiosk import codes, copied, wait_for
from tests.end_to_end.program import Command, velatura

pytestmark = [pytest.mark.long, pytest.mark.timeout(600)]
NAME = "gloss"


def test_the_kiosk_photographs_an_appearance_and_finds_what_the_demo_found(
    finished_demo: FinishedDemo, tmp_path: Path
) -> None:
    stage = copied(finished_demo.stage, tmp_path / "stage")
    rows = json.loads((finished_demo.out / "report.json").read_text())["appearances"]
    (then,) = (row for row in rows if row["name"] == NAME)
    with BenchProcess(stage, cancel=threading.Event()), Command("kiosk", "serve", stage, "--no-panel") as kiosk:
        wait_for(lambda: bool(codes(stage)))
        wait_for(lambda: call_kiosk(stage, "status")["state"] == "playing")
        outcome = velatura("kiosk", "photograph", stage, NAME)
        assert outcome.code == 0, outcome.records[-1]
        (found,) = call_kiosk(stage, "comparisons")
        report = call_kiosk(stage, "report", run=found["history"][0]["run"])
        wait_for(lambda: call_kiosk(stage, "status")["state"] == "playing")
        assert kiosk.interrupt().code == 0
    newest = found["history"][0]
    assert newest["in_reach"] == pytest.approx(then["delta_e00_median"], rel=0.1)
    assert 0 < newest["in_reach_share"] < 1
    assert newest["sharpness"] == pytest.approx(then["sharpness_lambda"], abs=0.05)
    assert sorted(found["pictures"]) == ["achieved", "before", "error", "resolution", "target"]
    assert Path(report).stat().st_size > 50_000
    shutil.rmtree(stage)
