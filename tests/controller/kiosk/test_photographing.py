"""When a kiosk photographs what its appearances achieve, when it doesn't, and what its results then hold."""

from __future__ import annotations

import contextlib
import json
import threading
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest

from controller.kiosk.decide.interfaces import Finished, Request
from controller.kiosk.jobs.job_handlers import JobHandlers
from controller.kiosk.jobs.job_runner import JobReporter
from controller.kiosk.state import Job
from controller.kiosk.store import runs
from controller.kiosk.store.event_log import EventLog
from controller.stage.services import compare as comparison_services
from controller.stage.services import recalibrate as drift_services
from hal.notices import Level, Notice
from tests.controller.kiosk.vase import graded_run, vase

ROWS = [{"name": "marble", "headline": 1.5}, {"name": "glass", "headline": 2.25}]
CAMERA = Notice(
    "camera-gone", "No photographs are possible without the camera. It is gone.", "Plug it in.", Level.ERROR
)


class Stage:
    """A kiosk's kinds of work on a stage whose devices are lent without being asked."""

    def __init__(self, folder: Path, settings: str = "") -> None:
        self.folder = vase(folder)
        toml = folder / "stage.toml"
        toml.write_text(f"{toml.read_text()}\n{settings}")
        self.missing: Notice | None = None
        self.open = False
        self.log = EventLog(folder / EventLog.FILE)
        self.handlers = JobHandlers(
            folder, self._lend, missing_device=lambda: self.missing, calibrated=lambda: True,
            open_now=lambda: self.open,
        ).table()  # fmt: skip

    @contextlib.contextmanager
    def _lend(self) -> Iterator[Any]:
        yield None

    def do(self, request: Request) -> Finished:
        reporter = JobReporter(Job(1, "work"), self.log, lambda: None)
        return self.handlers[request.kind].do(request, reporter, threading.Event())


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, ...]]:
    """The appearances of each call of the service that photographs; a recalibration succeeds at once."""
    calls: list[tuple[str, ...]] = []

    def photograph(*, names: tuple[str, ...], **_: object) -> Mapping[str, Any]:
        calls.append(names)
        return {"run": "20260104-100000-compare", "appearances": ROWS}

    monkeypatch.setattr(comparison_services, "photograph", photograph)
    monkeypatch.setattr(drift_services, "recalibrate", lambda **_: {"run": "20260103-033000-recalibrate"})
    return calls


AT_NIGHT = Request("quick", light=True, key="drift-check 2026-01-03")
SETTING = "[calibration]\nphotograph_at_night = true\n"


def kinds_after(stage: Stage, request: Request) -> list[str]:
    return [one.kind for one in stage.do(request).then]


def test_what_was_asked_for_is_photographed_and_the_worst_is_told(tmp_path: Path, asked: list[tuple[str, ...]]) -> None:
    finished = Stage(tmp_path).do(Request("compare", light=True, arguments=("marble",)))
    assert asked == [("marble",)]
    assert "The largest median colour difference of a whole object is 2.25, of glass" in finished.outcome.what


@pytest.mark.usefixtures("asked")
def test_photographs_follow_a_nightly_recalibration_only_where_the_stage_asks_for_them(tmp_path: Path) -> None:
    assert kinds_after(Stage(tmp_path / "off"), AT_NIGHT) == ["publish", "report"]
    stage = Stage(tmp_path / "on", SETTING)
    then = stage.do(AT_NIGHT).then
    assert [one.kind for one in then] == ["publish", "report", "compare"]
    assert then[-1].light
    assert kinds_after(stage, Request("quick", light=True)) == ["publish", "report"], "somebody asked, and may again"


def test_no_visitor_sees_the_nightly_photographs_being_taken(tmp_path: Path, asked: list[tuple[str, ...]]) -> None:
    stage = Stage(tmp_path, SETTING)
    nightly = stage.do(AT_NIGHT).then[-1]
    stage.open = True
    assert stage.do(nightly).outcome.code == "photographs-left-out"
    assert not asked
    stage.do(Request("compare", light=True))
    stage.open = False
    stage.do(nightly)
    assert asked == [(), ()]


def test_without_a_camera_it_says_why_it_can_not(tmp_path: Path) -> None:
    stage = Stage(tmp_path)
    request = Request("compare", light=True)
    assert stage.handlers["compare"].refusal(request) is None
    stage.missing = CAMERA
    assert stage.handlers["compare"].refusal(request) == CAMERA


def compared_run(stage: Path, name: str, calibration: str, medians: dict[str, float]) -> None:
    run = stage / "runs" / name
    run.mkdir(parents=True)
    for number, (one, median) in enumerate(medians.items()):
        figures = {"name": one, "title": one, "calibration": calibration, "photographed_unix_s": 1e9 + number,
                   "delta_e00_median": median, "delta_e00_p95": 5.0, "rmse": 0.01, "sharpness_lambda": 0.7,
                   "reachable_share": None, "window_px": 16}  # fmt: skip
        (run / f"compared-{one}.json").write_text(json.dumps(figures))
        (run / f"compared-{one}-error.jpg").write_bytes(b"\xff\xd8")


def test_the_results_hold_each_appearance_newest_first_and_the_calibrations_colour_difference(tmp_path: Path) -> None:
    first = graded_run(tmp_path, "20260101-100000-calibrate", {"left": 0.01})
    second = graded_run(tmp_path, "20260103-033000-recalibrate", {"left": 0.015})
    compared_run(tmp_path, "20260102-100000-compare", first.name, {"marble": 1.0, "glass": 2.0})
    compared_run(tmp_path, "20260102-110000-compare", first.name, {"marble": 0.5})
    compared_run(tmp_path, "20260104-100000-compare", second.name, {"marble": 1.5})
    marble, glass = runs.comparisons(tmp_path, ["marble", "glass", "wood"])
    assert [one.delta_e for one in marble.history] == [1.5, 0.5, 1.0]
    assert marble.pictures == {"error": tmp_path / "runs" / "20260104-100000-compare" / "compared-marble-error.jpg"}
    assert glass.history[0].run == "20260102-100000-compare"
    assert {one.run: one.delta_e for one in runs.grades(tmp_path, 8.0)} == {first.name: 2.0, second.name: 1.5}


def test_the_headline_counts_the_whole_object_and_not_only_what_was_in_reach(tmp_path: Path) -> None:
    calibration = graded_run(tmp_path, "20260101-100000-calibrate", {"left": 0.01})
    compared_run(tmp_path, "20260102-100000-compare", calibration.name, {"marble": 0.66})
    path = tmp_path / "runs" / "20260102-100000-compare" / "compared-marble.json"
    sets = {"in_reach": (0.66, 0.55), "lit": (7.0, 0.1), "visible": (8.5, 0.0)}
    pixels = {
        name: {"delta_e00_median": median, "delta_e00_p95": 20.0, "left_out_share": left}
        for name, (median, left) in sets.items()
    }
    beside = {"pixels": pixels, "adapted": {"delta_e00_median": 0.4}, "held_back": 1.3}
    path.write_text(json.dumps(json.loads(path.read_text()) | beside))
    (newest,) = runs.comparisons(tmp_path, ["marble"])[0].history
    assert (newest.delta_e, newest.delta_e_p95, newest.in_reach) == (8.5, 20.0, 0.66)
    assert newest.in_reach_share == pytest.approx(0.45)
    assert (newest.aimed, newest.held_back) == (0.4, 1.3), "beside what was aimed at, and why white is no brighter"
    assert [one.delta_e for one in runs.grades(tmp_path, 8.0)] == [8.5]


def test_a_drift_check_measures_how_far_apart_several_computers_change(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[object] = []

    def check(*, skew: bool | None, **_: object) -> Mapping[str, Any]:
        calls.append(skew)
        return {"run": "20260104-033000-drift", "advice": "nothing"}

    monkeypatch.setattr(drift_services, "check_drift", check)
    assert Stage(tmp_path).do(Request("drift", light=True)).outcome.code == "drift-none"
    assert calls == [None], "where there are several"
