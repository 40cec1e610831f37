"""A stage whose light is no longer as calibrated: its appearances are corrected by photographs, and nothing is lost."""

from __future__ import annotations

import json
import threading
from pathlib import Path

import pytest

from controller.stage.sessions.bench import BenchProcess, bench_of
from hal.values import Power
from tests.end_to_end.conftest import FinishedDemo
from tests.end_to_end.kiosk import copied
from tests.end_to_end.program import Command, powers, shots, velatura, wrong_code

pytestmark = [pytest.mark.long, pytest.mark.timeout(600)]
NAME = "gloss"
INDIRECT = {"what": "ambient", "indirect": 0.08}
WORSE = 1.5
LEFT = 1.1
"""With 8 % more indirect light, before and after one photograph; times the error without it, refined by the demo."""


def photographed(stage: Path) -> float:
    outcome = velatura("photograph", stage, NAME)
    assert outcome.code == 0, outcome.records[-1]
    (row,) = outcome.records[-1]["result"]["appearances"]
    return float(row["delta_e00_median"])


def test_indirect_light_goes_with_one_photograph_and_a_kill_costs_none(
    finished_demo: FinishedDemo, tmp_path: Path
) -> None:
    stage = copied(finished_demo.stage, tmp_path / "stage")
    report = json.loads((finished_demo.out / "report.json").read_text())
    (undisturbed,) = (one["delta_e00_median"] for one in report["appearances"] if one["name"] == NAME)
    bench_of(stage).disturb(stage, [INDIRECT])
    assert velatura("appearance", stage, NAME, "--refine", "0").code == 0
    with BenchProcess(stage, cancel=threading.Event()):
        assert photographed(stage) > WORSE * undisturbed
        with Command("appearance", stage, NAME, "--refine", "1") as killed:
            killed.wait_for("Refining", fraction=0.4)
            killed.kill()
        (run,) = (stage / "runs").glob("*-refine")
        taken = shots(run)
        assert len(taken) == 3
        outcome = velatura("appearance", stage, NAME, "--refine", "1")
        assert outcome.code == 0, outcome.records[-1]
        kept = shots(run)
        assert {file: kept[file] for file in taken} == taken, "the killed run's photographs are used"
        assert len(kept) == 2 * 3, "one photograph corrects, the next one confirms"
        assert outcome.records[-1]["result"]["refined"].startswith(f"Refined {NAME}: ")
        assert photographed(stage) < LEFT * undisturbed
        assert set(powers(stage).values()) <= {Power.OFF, Power.COOLING}


def test_a_stage_without_its_devices_keeps_what_was_solved_unless_asked(
    finished_demo: FinishedDemo, tmp_path: Path
) -> None:
    stage = copied(finished_demo.stage, tmp_path / "stage")
    assert velatura("appearance", stage, NAME, "--refine", "0").code == 0
    outcome = velatura("appearance", stage, NAME)
    assert outcome.code == 0, outcome.records[-1]
    said = [record["message"]["text"] for record in outcome.records if "message" in record]
    assert [text for text in said if text.startswith("The appearances were not refined: ")]
    assert velatura("appearance", stage, NAME, "--refine", "1").code == 3
    wrong_code(velatura("appearance", stage, NAME, "--refine", "10"))
