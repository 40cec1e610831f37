from __future__ import annotations

from pathlib import Path

import pytest

from controller.config.models import ScheduleTable
from controller.core.errors import UsageError
from controller.kiosk.schedule import FILE, ScheduleFile, of_table
from controller.kiosk.values import Schedule, ScheduleRow

TABLE = ScheduleTable.model_validate(
    {"time_zone": "Europe/Vienna", "hours": [{"day": "fri", "opens": "18:00", "closes": "01:30"}]}
)
MORE = Schedule("UTC", (ScheduleRow("sat", "09:00", "17:00", "marble"), ScheduleRow("2026-12-24", "", "")), "03:30")


def test_without_a_file_the_settings_hours_hold(tmp_path: Path) -> None:
    assert ScheduleFile(tmp_path, TABLE).now == Schedule("Europe/Vienna", (ScheduleRow("fri", "18:00", "01:30"),))
    assert list(tmp_path.iterdir()) == []


def test_what_is_saved_holds_at_once_and_over_a_restart(tmp_path: Path) -> None:
    file = ScheduleFile(tmp_path, TABLE)
    file.replace(MORE, ["marble"])
    assert file.now == MORE
    assert ScheduleFile(tmp_path, TABLE).now == MORE


def test_a_wrong_schedule_changes_nothing(tmp_path: Path) -> None:
    file = ScheduleFile(tmp_path, TABLE)
    file.replace(MORE, ["marble"])
    before = (tmp_path / FILE).read_bytes()
    with pytest.raises(UsageError, match="appearance"):
        file.replace(MORE, ["glass"])
    assert file.now == MORE
    assert (tmp_path / FILE).read_bytes() == before


@pytest.mark.parametrize(
    "damage",
    [b"", b"\0" * 200, b"time_zone = ", b'time_zone = "Mars/Olympus"', b"hours = 7", b"\xff\xfe", b"x=" + 3000 * b"["],
)
def test_a_damaged_file_keeps_no_stage_dark(tmp_path: Path, damage: bytes) -> None:
    (tmp_path / FILE).write_bytes(damage)
    file = ScheduleFile(tmp_path, TABLE)
    if damage:
        assert file.problem is not None
        assert file.problem.remedy
        assert file.now.rows == (ScheduleRow("fri", "18:00", "01:30"),)
    file.replace(MORE, ["marble"])
    assert file.problem is None
    assert ScheduleFile(tmp_path, TABLE).problem is None


def test_what_holds_without_time_is_kept_by_the_panels_schedule(tmp_path: Path) -> None:
    table = ScheduleTable.model_validate({"without_time": "open"})
    file = ScheduleFile(tmp_path, table)
    file.replace(MORE, ["marble"])
    assert ScheduleFile(tmp_path, ScheduleTable.model_validate({})).open_without_time


def test_stage_toml_takes_the_same_words_for_days_as_the_panel() -> None:
    table = ScheduleTable.model_validate(
        {"hours": [{"day": "mon-wed", "opens": "10:00", "closes": "18:00"}, {"day": "2026-12-24 to 2026-12-25"}]}
    )
    assert [row.day for row in of_table(table).rows] == ["mon", "tue", "wed", "2026-12-24", "2026-12-25"]
    with pytest.raises(UsageError, match="someday"):
        of_table(ScheduleTable.model_validate({"hours": [{"day": "someday"}]}))
