"""`velatura demo` at size small, from cold lamps to a report: what it says, and what it leaves behind."""

from __future__ import annotations

import json
import re
import time
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from controller.play.control.launch import start_player
from controller.stage.sessions.check import check_stage
from controller.stage.sessions.open import player_settings
from hal.deadline import in_seconds
from hal.registry import OpenContext
from plugins.display.player import DRIVER, PlayerDisplay
from tests.end_to_end.conftest import FinishedDemo
from tests.end_to_end.program import Record, asked, lamps, processes_on, run_of, shots

APPEARANCES = ["photograph", "new-pattern", "checkerboard", "gloss"]
pytestmark = [pytest.mark.long, pytest.mark.timeout(1200)]
DOCUMENT = Path(__file__).parents[2] / "docs" / "reference" / "bundle-format.md"


@pytest.fixture(scope="module")
def report(finished_demo: FinishedDemo) -> Any:
    return json.loads((finished_demo.out / "report.json").read_text())


@pytest.fixture(scope="module")
def page(finished_demo: FinishedDemo) -> str:
    return (finished_demo.out / "report.html").read_text()


def test_it_ends_well_and_says_where_the_report_lies(finished_demo: FinishedDemo) -> None:
    ended = finished_demo.ended
    assert (ended.code, ended.stderr) == (0, "")
    assert ended.result == {
        "report": str(finished_demo.out / "report.html"),
        "figures": str(finished_demo.out / "report.json"),
        "stage": str(finished_demo.stage),
    }


def test_the_report_has_every_promised_key(report: Any) -> None:
    assert {"count", "seconds"} <= report["captures"].keys()
    assert "reprojection_rms_px" in report["geometry"]
    assert report["radiometry"].keys() == {"left", "right", "above"}
    assert {"fitted", "failed", "seconds"} <= report["metapixels"].keys()
    assert {"seconds", "iterations", "objective", "kkt"} <= report["solve"].keys()
    assert [one["name"] for one in report["appearances"]] == APPEARANCES
    for one in report["appearances"]:
        assert {"seconds", "delta_e00_median", "delta_e00_p95", "rmse", "sharpness_lambda"} <= one.keys()
    assert {"bytes", "ratio"} <= report["bundle"].keys()
    assert {"swaps_per_s", "interval_p50_ms", "interval_p99_ms", "rss_bytes"} <= report["playback"].keys()
    assert {"cores", "memory_bytes"} <= report["machine"].keys()


def test_its_figures_are_what_a_good_calibration_gives(report: Any, finished_demo: FinishedDemo) -> None:
    assert report["captures"]["count"] == len(shots(run_of(finished_demo.stage))) > 100
    assert 0 < report["geometry"]["reprojection_rms_px"] < 0.1
    # in the room, light between surfaces makes grade B of two projectors
    assert {row["grade"] for row in report["verification"].values()} <= {"A", "B"}
    assert all(0.04 < row["indirect"]["median"] < 0.12 for row in report["verification"].values())
    assert 0.9 < sum(row["light_share"] for row in report["verification"].values()) < 2, "they overlap in part"
    assert report["metapixels"]["fitted"] > 0.3 * 3 * 280 * 210
    assert report["bundle"]["ratio"] > 1.5
    assert all(0.5 < one["reachable_share"] <= 1 for one in report["appearances"])


@pytest.mark.parametrize("name", APPEARANCES)
def test_every_appearance_comes_within_four_of_its_target_and_twice_as_near_as_one_projector(
    report: Any, name: str
) -> None:
    (one,) = (one for one in report["appearances"] if one["name"] == name)
    assert one["delta_e00_median"] <= 4.0
    # Against the target as asked; where it was adapted to the light that there is, ours keeps some distance on purpose.
    assert one["traditional"]["delta_e00_median"] >= 2.0 * one["delta_e00_median"]
    assert one["adapted"]["delta_e00_median"] <= 4.0


def test_appearances_swap_sixty_times_a_second(report: Any, finished_demo: FinishedDemo, tmp_path: Path) -> None:
    rate_hz = report["playback"]["swaps_per_s"]
    if rate_hz < 59.0:  # other tests held this one up: its bundle once more, as the demo plays it
        rate_hz = played_again(finished_demo.stage, tmp_path)
    assert rate_hz >= 59.0
    assert abs(report["playback"]["interval_p50_ms"] - 1000 / 60) < 1.0


def played_again(stage: Path, folder: Path) -> float:
    """Swaps a second of four seconds of the installed bundle in a player of its own."""
    settings = replace(player_settings(check_stage(stage).stage, folder, plays=True), frames=folder / "out.frame")
    with start_player(folder, settings):
        display = DRIVER.open({}, OpenContext(stage=folder, runtime=folder), in_seconds(20))
        assert isinstance(display, PlayerDisplay)
        before = display.playing(deadline=in_seconds(20)).swaps
        items = [(name, 1 / 60) for name in APPEARANCES]
        began = display.play_sequence(items, repeat=60, rate_hz=60, deadline=in_seconds(20))
        while (now := display.playing(deadline=in_seconds(20))).running:
            time.sleep(0.2)
        display.close()
    return float((now.swaps - before - 1) / (now.presented_at_s - began.at_s))


def test_the_page_is_one_file_that_asks_nobody_for_anything(page: str) -> None:
    assert not re.search(r"https?:|url\((?!data:font/ttf;base64,)|<script|<link|@import|srcset", page, re.IGNORECASE)
    sources = re.findall(r'src="([^"]*)"', page)
    assert len(sources) >= 6 * len(APPEARANCES)
    assert all(source.startswith("data:image/") for source in sources)


def test_the_page_shows_direct_and_indirect_light(page: str) -> None:
    assert "Direct and indirect light" in page
    assert "Share of indirect light" in page


def test_the_page_shows_every_appearance_with_before_target_achieved_and_error(page: str, report: Any) -> None:
    sections = re.findall(r"<section>\n<div class=\"near\">.*?</section>", page, re.DOTALL)[: len(APPEARANCES)]
    for section, one in zip(sections, report["appearances"], strict=True):
        assert re.findall(r"<figcaption>([A-Z][a-z ]+?) <span>", section) == [
            "Before", "Target", "Achieved", "Error", "Traditional", "Its error",
        ]  # fmt: skip
        assert f"{one['delta_e00_median']:.2f}" in section


def test_a_second_implementation_accepts_the_bundle_as_signed_by_this_stage(finished_demo: FinishedDemo) -> None:
    (program,) = re.findall(r"```python\n(.*?)```", DOCUMENT.read_text(), re.DOTALL)
    reader: dict[str, Any] = {}
    exec(program, reader)
    data = (finished_demo.stage / "bundles" / "current").read_bytes()
    tables = tomllib.loads((finished_demo.stage / "stage.toml").read_text())
    index = reader["read_index"](data, [bytes.fromhex(key) for key in tables["bundle"]["trusted_keys"]])
    assert [one["name"] for one in index["appearances"]] == APPEARANCES
    frames = [reader["read_image"](data, index, name, "P1") for name in APPEARANCES]
    assert all(frame.shape == (210, 280, 3) for frame in frames)
    assert all(np.ptp(frame) > 100 for frame in frames)
    with pytest.raises(ValueError, match="not signed by us"):
        reader["read_index"](data, [bytes(32)])


def test_every_kernel_it_calls_was_compiled_ahead(finished_demo: FinishedDemo) -> None:
    """If not: run the demo with VELATURA_CACHE on an empty folder, then ``python -m hal.runtime.kernels record``."""
    assert finished_demo.compiled == []


def test_time_left_is_told_all_the_way_and_comes_down(finished_demo: FinishedDemo) -> None:
    progress = [record["progress"] for record in finished_demo.ended.records if "progress" in record]
    fractions = [one["fraction"] for one in progress]
    assert fractions == sorted(fractions)
    assert fractions[-1] == 1.0
    assert progress[-1]["left_s"] == 0.0
    begun = max(one["fraction"] for one in progress if one["phase"] == "skipped")
    assert all(one["left_s"] is not None for one in progress if one["fraction"] > begun + 0.15 * (1 - begun))


def test_no_process_no_lamp_and_no_unfinished_file_stays_behind(finished_demo: FinishedDemo) -> None:
    assert processes_on(finished_demo.stage) == []
    assert set(lamps(finished_demo.stage).values()) == {False}
    assert [path for path in finished_demo.out.rglob("*") if ".part" in path.name] == []
    assert {path.name for path in finished_demo.out.iterdir()} == {"stage", "report.html", "report.json"}


def test_ctrl_c_while_it_solves_leaves_lamps_cooling_and_says_so_in_a_sentence(finished_demo: FinishedDemo) -> None:
    stopped = finished_demo.stopped
    assert stopped.code == 130
    assert stopped.error == {
        "code": "cancelled",
        "what": "The work was stopped on request.",
        "remedy": "Run the same command to continue from here.",
    }
    assert stopped.stderr == ""
    assert finished_demo.lamps_then == {"left": False, "right": False, "above": False}
    assert finished_demo.last_event_then.startswith("cooling -> off")
    assert finished_demo.processes_then == []


def test_the_same_command_then_goes_on_and_repeats_neither_photograph_nor_finished_step(
    finished_demo: FinishedDemo,
) -> None:
    run = run_of(finished_demo.stage)
    now = shots(run)
    assert len(finished_demo.shots_then) > 90  # 31 a projector, and black
    assert {name: now[name] for name in finished_demo.shots_then} == finished_demo.shots_then
    assert asked(run, "SELECT outcome FROM runs ORDER BY id") == [("cancelled",), ("done",)]
    assert skipped(finished_demo.ended.records) >= {"Reconstructing the object and the poses", "Solving the base image"}


def skipped(records: list[Record]) -> set[str]:
    told = (record["progress"] for record in records if "progress" in record)
    return {one["step"] for one in told if one["phase"] == "skipped"}
