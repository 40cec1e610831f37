"""How each lamp has burnt is kept day by day, whatever the disk does."""

from __future__ import annotations

from datetime import date
from pathlib import Path

from controller.kiosk.state import Lamp
from controller.kiosk.supervisors.light_records import EVERY_S, FILE, MOST_DAYS, LampHistory
from controller.kiosk.values import LampDay

MONDAY, TUESDAY = date(2026, 1, 5), date(2026, 1, 6)


def lamp(hours: float, strikes: int = 3, name: str = "left") -> Lamp:
    return Lamp(name, hours, strikes, True)


def test_the_last_figures_of_each_day_survive_a_restart(tmp_path: Path) -> None:
    history = LampHistory(tmp_path)
    history.note([lamp(10.0), lamp(2.0, 1, "right")], MONDAY, now=True)
    history.note([lamp(12.5), lamp(2.0, 1, "right")], MONDAY, now=True)
    history.note([lamp(13.0, 4), lamp(2.0, 1, "right")], TUESDAY, now=True)
    assert list(LampHistory(tmp_path).days()) == [
        LampDay("right", "2026-01-05", 2.0, 1), LampDay("left", "2026-01-05", 12.5, 3),
        LampDay("left", "2026-01-06", 13.0, 4),
    ]  # fmt: skip


def test_it_is_written_every_ten_minutes_and_no_day_is_kept_for_ever(tmp_path: Path) -> None:
    now_s = 0.0
    history = LampHistory(tmp_path, monotonic=lambda: now_s)
    for number in range(MOST_DAYS + 5):
        history.note([lamp(float(number + 1))], date.fromordinal(MONDAY.toordinal() + number))
        history.note([lamp(float(number + 2))], date.fromordinal(MONDAY.toordinal() + number))
        now_s += EVERY_S
    days = history.days()
    assert len(days) == MOST_DAYS
    assert days[-1].hours == MOST_DAYS + 5, "what came within ten minutes waits"


def test_a_damaged_file_and_a_disk_that_takes_nothing_stop_nobody(tmp_path: Path) -> None:
    (tmp_path / "kiosk").mkdir()
    (tmp_path / FILE).write_text('[["left", 3]]')
    history = LampHistory(tmp_path)
    assert not history.days()
    (tmp_path / FILE).unlink()
    (tmp_path / FILE).mkdir()
    history.note([lamp(1.0)], MONDAY, now=True)
    assert len(history.days()) == 1
