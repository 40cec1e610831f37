"""The zone of a stage's times, and of a report's."""

from __future__ import annotations

import re
from datetime import datetime, timedelta
from pathlib import Path
from zoneinfo import ZoneInfo

import pytest

from controller.stage.report.words import moment
from controller.stage.sessions.check import check_stage, time_zone
from tests.controller.kiosk.vase import TEXT, vase

RUN = "20260105-233000-calibrate"


@pytest.mark.parametrize(
    ("settings", "panel", "expected"),
    [
        ("", None, None),
        ('[schedule]\ntime_zone = "Asia/Tokyo"\n', None, "Asia/Tokyo"),
        ('[schedule]\ntime_zone = "Asia/Tokyo"\n', 'time_zone = "Europe/Vienna"\n', "Europe/Vienna"),
        ("", 'time_zone = "UTC"\n', "UTC"),
        ("", 'time_zone = "Europe/Atlantis"\n', None),
        ("", "time_zone = [", None),
    ],
)
def test_the_panels_hours_come_before_the_settings(
    tmp_path: Path, settings: str, panel: str | None, expected: str | None
) -> None:
    stage = vase(tmp_path / "stage")
    (stage / "stage.toml").write_text(f"{TEXT}\n{settings}")
    if panel is not None:
        (stage / "schedule.toml").write_text(panel)
    assert time_zone(check_stage(stage)) == (None if expected is None else ZoneInfo(expected))


@pytest.mark.parametrize("zone", ["Asia/Tokyo", "America/New_York", "UTC"])
def test_a_run_began_at_the_stages_time(zone: str) -> None:
    began = datetime(2026, 1, 5, 23, 30).astimezone()
    ahead = ZoneInfo(zone).utcoffset(datetime(2026, 1, 5)) - began.utcoffset()  # type: ignore[operator]
    there = datetime(2026, 1, 5, 23, 30) + ahead
    told = re.fullmatch(r"(\d+) Jan 2026, (\d\d):(\d\d)", moment(RUN, ZoneInfo(zone)))
    assert told is not None
    assert tuple(map(int, told.groups())) == (there.day, there.hour, there.minute)
    assert moment(RUN) == "5 Jan 2026, 23:30"
    assert moment("by hand", ZoneInfo(zone)) == "by hand"
    assert ahead % timedelta(hours=1) in (timedelta(0), timedelta(minutes=30))
