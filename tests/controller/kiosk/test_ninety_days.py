from __future__ import annotations

from datetime import datetime
from pathlib import Path

from tests.campaigns.serve_ninety_days import live, nights_misjudged

START = datetime(2026, 10, 19)
"""Summer time ends on the sixth night."""


def test_every_minute_of_a_week_with_incidents_and_a_clock_change_is_accounted_for(tmp_path: Path) -> None:
    account = live(tmp_path, days=7.0, start=START, seed=7)
    assert account.unaccounted == []
    assert account.sins == []
    assert nights_misjudged(tmp_path, 7.0, START) == []
    assert sum(account.incidents.values()) >= 6
    assert account.minutes["open"] > 2000
