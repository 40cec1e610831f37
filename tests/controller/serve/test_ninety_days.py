from __future__ import annotations

from datetime import datetime
from pathlib import Path

from tests.campaigns.serve_ninety_days import live, nights_judged_twice


def test_every_minute_of_four_days_with_incidents_and_a_clock_change_is_accounted_for(tmp_path: Path) -> None:
    account = live(tmp_path, days=4.0, start=datetime(2026, 10, 23), seed=7)
    assert account.unaccounted == []
    assert account.sins == []
    assert nights_judged_twice(tmp_path) == []
    assert sum(account.incidents.values()) >= 3
    assert account.minutes["open"] > 600
