"""What commands ask of a stage's folder where no kiosk runs, and the words in which they say it."""

from __future__ import annotations

import contextlib
import json
import os
import pwd
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from controller.core.errors import UsageError, VelaturaError
from controller.kiosk.api import offline_dispatch as direct
from controller.kiosk.api.control import plain
from controller.kiosk.api.offline_dispatch import (
    aiming_text,
    call,
    changed_schedule,
    schedule_text,
    status_of,
    status_text,
)
from controller.kiosk.state import DeviceRow, Job, JobStep, KioskState, LiveValue
from controller.kiosk.store.event_log import EventLog
from controller.kiosk.values import Aiming, ProjectorAim, Schedule
from controller.stage.sessions.run import stage_lock
from hal.notices import Level, Notice
from tests.controller.kiosk.vase import graded_run, vase

HOSTILE = "left\x1b[2J\x1b]0;pwned\x07\r\u202e"
NOW: dict[str, Any] = {
    "time_zone": "Europe/Vienna", "drift_check": "03:00",
    "rows": [{"day": "mon", "opens": "10:00", "closes": "18:00", "appearance": "marble"}],
}  # fmt: skip


def test_a_stage_that_nobody_serves_answers_from_its_folder(tmp_path: Path) -> None:
    stage = vase(tmp_path)
    run = graded_run(stage, "20260101-100000-calibrate", {"left": 0.0123})
    log = EventLog(stage / EventLog.FILE)
    log.add(Notice("first", "One."))
    log.add(Notice("second", "Two.", "Look.", Level.WARNING))
    log.close()
    assert [row["code"] for row in call(stage, "events", after=1)] == ["second"]
    assert call(stage, "runs") == [run.name]
    assert call(stage, "results", run=run.name)["figures"] == [["Error of left", "1.23 %"]]
    assert call(stage, "appearances") == []
    assert call(stage, "comparisons") == []
    assert call(stage, "lamp-history") == []
    assert 'name = "The vase"' in call(stage, "settings")
    status = status_of(stage)
    assert (status["stage"], status["serving"], status["appearances"]) == ("The vase", False, [])
    assert status_text(status) == "The vase: off (No kiosk runs on this stage.)"


@pytest.mark.parametrize("op", ["recalibrate", "play", "no such thing", "", "__class__"])
def test_what_only_a_running_kiosk_can_do_is_refused(tmp_path: Path, op: str) -> None:
    with pytest.raises(UsageError) as caught:
        call(vase(tmp_path), op)
    assert caught.value.code == "not-serving"


def test_a_schedule_is_checked_before_it_replaces_the_one_before(tmp_path: Path) -> None:
    stage = vase(tmp_path)
    # The bundle has no appearances yet.
    with pytest.raises(UsageError):
        call(stage, "set-schedule", **NOW)
    assert not (stage / "schedule.toml").exists()
    plain_hours = changed_schedule(call(stage, "schedule"), "Europe/Vienna", ["mon=10:00-18:00", "sun=closed"], "03:00")
    call(stage, "set-schedule", **plain_hours)
    assert call(stage, "schedule") == plain_hours
    text = schedule_text(call(stage, "schedule")).split("\n")
    assert [line.split() for line in text] == [
        ["Time", "zone", "Europe/Vienna"], ["mon", "10:00-18:00"], ["sun", "closed"], ["Drift", "check", "at", "03:00"],
    ]  # fmt: skip


def test_what_a_command_does_not_say_stays() -> None:
    assert changed_schedule(NOW, None, None, None) == NOW
    assert changed_schedule(NOW, "UTC", None, "") == NOW | {"time_zone": "UTC", "drift_check": ""}
    (row,) = changed_schedule(NOW, None, ["tue=22:00-02:00"], None)["rows"]
    assert row == {"day": "tue", "opens": "22:00", "closes": "02:00", "appearance": ""}
    assert changed_schedule(NOW, None, [], None)["rows"] == []
    assert "always open" in schedule_text(NOW | {"rows": []})


@pytest.mark.parametrize(
    "hours",
    ["mon", "mon=", "=10:00-18:00", "mon=10:00", "mon=10:00-", "mon=-18:00", "mon=Closed", "mon=10:00-18:00-20:00",
     "mon=10-18", "mon 10:00-18:00", "mon=24:00-25:00", "2026-W01-1=closed", "mon=10:00\u201318:00", "x" * 500],
)  # fmt: skip
def test_hours_that_are_none_are_refused_in_words(hours: str) -> None:
    with pytest.raises(UsageError) as caught:
        changed_schedule(NOW, None, [hours], None)
    assert caught.value.code == "schedule-wrong"
    assert len(caught.value.what) < 200


@given(st.text(max_size=24), st.text(max_size=8), st.text(max_size=8))
@settings(max_examples=100, deadline=None)
def test_any_hours_are_a_schedule_or_refused(hours: str, zone: str, check: str) -> None:
    try:
        found = changed_schedule(NOW, zone, [hours], check)
    except VelaturaError:
        return
    assert re.fullmatch("[^=]+=(closed|[0-9:]{5}-[0-9:]{5})", hours)
    json.dumps(found)


def test_what_devices_say_reaches_no_terminal_as_it_came() -> None:
    row = DeviceRow(HOSTILE, "camera", HOSTILE, (LiveValue("Model", HOSTILE),), HOSTILE, HOSTILE)
    job = Job(1, HOSTILE, (JobStep(HOSTILE, 0.5),))
    state = KioskState(1, HOSTILE, "playing", HOSTILE, 0.0, (row,), job, playing=HOSTILE)
    aimed = Aiming((ProjectorAim(HOSTILE, 0.5, 0.5),), hints=(HOSTILE,), source="test shots", picture=Path(HOSTILE))
    schedule = plain(Schedule(HOSTILE, (), HOSTILE))
    for text in (status_text(plain(state)), aiming_text(plain(aimed)), schedule_text(schedule)):
        assert all(line.isprintable() for line in text.split("\n"))
        assert "left" in text
    assert status_text(plain(state)).split("\n")[-1].endswith(" 50%")


def test_where_nothing_was_measured_the_hints_say_why() -> None:
    text = aiming_text(plain(Aiming(hints=("The calibration can't be read.",))))
    assert text.split("\n")[1:] == ["The calibration can't be read."]
    assert "test shots" in text


def test_hours_are_not_changed_behind_the_back_of_a_kiosk_that_begins(tmp_path: Path) -> None:
    stage = vase(tmp_path)
    # It holds the stage, has read its schedule, and does not answer yet.
    with stage_lock(stage), pytest.raises(UsageError) as caught:
        call(stage, "set-schedule", time_zone="UTC", rows=[], drift_check="03:00")
    assert caught.value.code == "already-running"
    assert not (stage / "schedule.toml").exists()


def test_the_log_names_who_changes_something_while_no_kiosk_runs(tmp_path: Path) -> None:
    stage = vase(tmp_path)
    (stage / "kiosk/panel/accounts.json").unlink()
    call(stage, "schedule")
    assert call(stage, "events") == []
    call(stage, "set-schedule", time_zone="UTC", rows=[], drift_check="")
    call(stage, "add-account", name="otto", role="operator", password="a long enough one")
    with pytest.raises(UsageError):
        call(stage, "remove-account", name="nobody")
    user = pwd.getpwuid(os.getuid()).pw_name
    assert "Refused: " in next(row["text"] for row in call(stage, "events") if row["code"] == "refused")
    lines = [row["text"] for row in call(stage, "events") if row["code"] == "done-by"]
    assert [line.split(",")[0] for line in lines] == [f"User {user}"] * 2
    assert "otto" in lines[1]
    assert "a long enough one" not in str(lines)


def test_of_two_who_make_accounts_at_once_neither_loses_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stage, other = vase(tmp_path), ["otto"]
    (stage / "kiosk/panel/accounts.json").unlink()

    @contextlib.contextmanager
    def after_another(folder: Path) -> Iterator[None]:
        if other:
            call(stage, "add-account", name=other.pop(), role="viewer", password="a good long one")
        with stage_lock(folder):
            yield

    monkeypatch.setattr(direct, "stage_lock", after_another)
    call(stage, "add-account", name="vera", role="viewer", password="a good long one")
    assert [one["name"] for one in call(stage, "accounts")] == ["otto", "vera"]


def test_warnings_what_is_shown_in_turn_and_a_job_that_waits_are_told_in_words() -> None:
    state = KioskState(1, "The vase", "playing", "open", 0.0, playing="marble", in_turn=True, warnings=("Read this.",),
                       job=Job(1, "Full recalibration", waits="It starts soon."))  # fmt: skip
    lines = status_text(plain(state)).split("\n")
    assert lines[1:3] == ["Playing marble, one of all in turn.", "Warning: Read this."]
    assert lines[-1] == "Full recalibration: It starts soon."
