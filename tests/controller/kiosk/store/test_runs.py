"""What past runs left: also where the disk has damaged some of it, which must cost no other run and no kiosk."""

from __future__ import annotations

import json
import os
import threading
import time
from pathlib import Path

import pytest

from controller.config.models import CalibrationTable
from controller.core.errors import UsageError
from controller.kiosk.service import Service
from controller.kiosk.store import runs
from controller.kiosk.store.event_log import EventLog
from controller.run.journal import Journal, JournalError
from controller.stage.sessions.calibrations import finished_calibrations
from controller.stage.sessions.check import check_stage
from tests.controller.kiosk.vase import graded_run, vase

FIRST, SECOND, THIRD = (f"2026010{day}-100000-calibrate" for day in (1, 2, 3))
DAMAGE = {
    "empty": "", "cut": '{"left": {"relative_rms": 0.0', "a list": "[1, 2]", "a number": "7",
    "no figures": '{"left": {}}', "words": '{"left": {"relative_rms": "small"}}', "no object": '{"left": 3}',
}  # fmt: skip


@pytest.mark.parametrize("how", list(DAMAGE))
def test_a_damaged_grade_hides_its_own_run_alone(tmp_path: Path, how: str) -> None:
    graded_run(tmp_path, FIRST, {"left": 0.01, "right": 0.031})
    damaged = graded_run(tmp_path, SECOND, {"left": 0.02})
    (damaged / "verification.json").write_text(DAMAGE[how])
    (grade,) = runs.grades(tmp_path, 8.0)
    assert (grade.run, grade.grade, grade.kept) == (FIRST, "B", True)
    assert grade.note == "Largest predicted error: 3.1 % in right"
    assert runs.names(tmp_path) == (FIRST,)
    with pytest.raises(UsageError) as caught:
        runs.results(tmp_path, SECOND, 8.0)
    assert caught.value.code == "run-unknown"
    assert runs.results(tmp_path, FIRST, 8.0).figures == (("Error of left", "1.00 %"), ("Error of right", "3.10 %"))


def test_a_drift_check_says_how_far_apart_outputs_changed_where_that_was_measured(tmp_path: Path) -> None:
    figures = {"advice": "nothing", "camera": {"found": True, "rms_px": 0.04}}
    for day, skew in enumerate(
        (None, {"apart_s": 0.0083, "uncertain_s": 0.0006}, {"apart_s": None, "uncertain_s": 0.16})
    ):
        run = tmp_path / "runs" / f"2026010{day + 1}-033000-drift"
        run.mkdir(parents=True)
        (run / "drift.json").write_text(json.dumps(figures))
        if skew is not None:
            (run / "skew.json").write_text(json.dumps(skew))
    found = [(one.moved_px, one.apart_s, one.uncertain_s) for one in runs.drifts(tmp_path)]
    assert found == [(0.04, None, 0.16), (0.04, 0.0083, 0.0006), (0.04, None, None)]


def test_a_damaged_journal_costs_its_own_calibration_alone(tmp_path: Path) -> None:
    graded_run(tmp_path, FIRST, {"left": 0.01})
    graded_run(tmp_path, SECOND, {"left": 0.01}, finished=False)
    (graded_run(tmp_path, THIRD, {"left": 0.01}) / Journal.FILE).write_bytes(b"no database, but long enough" * 40)
    assert [run.name for run in finished_calibrations(tmp_path)] == [FIRST]
    assert {one.run: one.kept for one in runs.grades(tmp_path, 8.0)} == {FIRST: True, SECOND: False, THIRD: False}


def test_a_journal_that_can_not_be_used_now_is_no_missing_calibration_and_stops_no_grades(tmp_path: Path) -> None:
    run = graded_run(tmp_path, FIRST, {"left": 0.01})
    (run / Journal.FILE).unlink()
    (run / Journal.FILE).mkdir()
    with pytest.raises(JournalError):
        finished_calibrations(tmp_path)
    assert [one.run for one in runs.grades(tmp_path, 8.0)] == [FIRST]


def test_a_run_that_vanishes_between_two_looks_leaves_the_grades(tmp_path: Path) -> None:
    graded_run(tmp_path, FIRST, {"left": 0.01})
    (tmp_path / "runs" / "20260104-100000-compare").symlink_to(tmp_path / "nowhere")
    assert [one.run for one in runs.grades(tmp_path, 8.0)] == [FIRST]


@pytest.mark.parametrize("name", [b"20260104-100000-\xff", b"zz <script>", b"20260104-100000-calibrate (copy)"])
def test_a_folder_that_is_no_run_of_ours_is_shown_nowhere(tmp_path: Path, name: bytes) -> None:
    graded_run(tmp_path, FIRST, {"left": 0.01})
    graded_run(tmp_path, os.fsdecode(name), {"left": 0.01})
    assert [one.run for one in runs.grades(tmp_path, 8.0)] == [FIRST]
    assert runs.names(tmp_path) == (FIRST,)


def test_no_name_leads_out_of_the_runs(tmp_path: Path) -> None:
    outside = tmp_path / "20260101-100000-calibrate"
    outside.mkdir()
    (outside / "verification.json").write_text("{}")
    stage = tmp_path / "stage"
    graded_run(stage, FIRST, {"left": 0.01})
    for name in (f"../../{FIRST}", f"../runs/{FIRST}", "", ".", FIRST + "\n", "x" * 500):
        with pytest.raises(UsageError) as caught:
            runs.results(stage, name, 8.0)
        assert caught.value.code == "run-unknown"
        assert len(caught.value.what) < 200


def test_the_beginning_of_a_run_is_told_by_its_name() -> None:
    at = time.mktime((2026, 7, 1, 10, 0, 5, 0, 0, -1))
    assert runs.began_s("20260701-100005-calibrate") == at
    for name in ("", "calibrate", "20261301-100005-calibrate", "00010101-000000-x", "99991231-235959-x"):
        assert isinstance(runs.began_s(name), float)


def test_an_unknown_error_is_told_and_the_decisions_go_on(tmp_path: Path) -> None:
    checked = check_stage(vase(tmp_path))
    log, ended, looked = EventLog(tmp_path / EventLog.FILE), threading.Event(), threading.Event()
    service = Service(checked, log)

    def fails() -> None:
        looked.set()
        raise RuntimeError("nobody thought of this")

    service.changed = fails
    deciding = threading.Thread(target=service.run, args=(ended,), daemon=True)
    deciding.start()
    assert looked.wait(20)
    ended.set()
    deciding.join(20)
    assert not deciding.is_alive()
    told = [row for row in log.after(0) if row.code == "crash"]
    assert told[0].level == "error"
    assert "nobody thought of this" in told[0].text
    log.close()


def test_a_kept_grade_is_one_that_passes_or_was_accepted(tmp_path: Path) -> None:
    run = graded_run(tmp_path, FIRST, {"left": 0.09})
    assert [one.kept for one in runs.grades(tmp_path, 8.0)] == [False]
    (run / "accepted.json").write_text(json.dumps({}))
    assert [one.kept for one in runs.grades(tmp_path, 8.0)] == [True]


@pytest.mark.parametrize(("error", "letter", "kept"), [(0.039, "B", True), (0.041, "C", False)])
def test_without_a_setting_a_calibration_of_grade_c_is_not_used(
    tmp_path: Path, error: float, letter: str, kept: bool
) -> None:
    graded_run(tmp_path, FIRST, {"left": error})
    (found,) = runs.grades(tmp_path, CalibrationTable().worst_grade)
    assert (found.grade, found.kept) == (letter, kept)


def test_a_report_that_is_there_is_not_made_again_and_an_unknown_run_has_none(tmp_path: Path) -> None:
    stage = vase(tmp_path)
    run = graded_run(stage, FIRST, {"left": 0.01})
    photographs = stage / "runs" / "20260102-100000-compare"
    photographs.mkdir()
    figures = {"name": "marble", "title": "Marble", "calibration": FIRST, "photographed_unix_s": 1e9,
               "delta_e00_median": 1.0, "delta_e00_p95": 2.0, "rmse": 0.1, "sharpness_lambda": 0.5,
               "reachable_share": None, "window_px": 16}  # fmt: skip
    (photographs / "compared-marble.json").write_text(json.dumps(figures))
    checked = check_stage(stage)
    for folder in (run, photographs):
        (folder / "report.html").write_text("as it was")
        assert runs.report(stage, folder.name, checked).read_text() == "as it was"
    for name in ("20260103-100000-calibrate", "..", f"../runs/{FIRST}", 99 * "x"):
        with pytest.raises(UsageError) as caught:
            runs.report(stage, name, checked)
        assert (caught.value.code, caught.value.what.count("x")) == ("run-unknown", min(80, name.count("x")))
