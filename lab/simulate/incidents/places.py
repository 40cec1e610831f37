"""Where a life takes place: its hours, its time zone, its projectors and its computer, drawn from its seed."""

from __future__ import annotations

import random
from datetime import UTC, datetime, timedelta
from typing import Final
from zoneinfo import ZoneInfo

from lab.simulate.incidents.script import Setting

CHANGING: Final = ("Europe/Vienna", "America/New_York", "Australia/Lord_Howe")
"""Zones whose clocks change twice a year."""
ZONES: Final = (*CHANGING, "Asia/Kolkata", "UTC")
DAYS: Final = ("mon", "tue", "wed", "thu", "fri", "sat", "sun")
LOGGED: Final = (0, 1000, 1000)
"""Events of the months before. In the log of a few days there is hardly a middle that could be damaged."""
LINGERS_S: Final = (0.0, 0.0, 20.0, 90.0)
"""Many projectors take one connection at a time, and notice late that a program was killed."""
DISPLAY_AFTER_S: Final = (0.0, 15.0, 60.0)
"""A computer starts its display and the service at the same time."""
NO_TIME_S: Final = (0.0, 0.0, 120.0, 1800.0)
"""Small computers have no clock with a battery, and in others it is empty: the time comes with the network."""
SMALL: Final = 0.5
"""Share of the computers on which the player answers late while they work."""


def setting(seed: str) -> Setting:
    """As drawn from the seed. Where the clocks change soon, hours over midnight are usual: they meet the change."""
    chance = random.Random(f"{seed} life")
    soon = chance.random() < 0.5
    zone = chance.choice(CHANGING if soon else ZONES)
    rows = hours(chance, chance.choice((0.1, 0.9, 0.9) if soon else (0.0, 0.1, 0.9)))
    drift_check = chance.choice(["03:30", "02:30", "23:00"])
    begins_s, bundles = begins(chance, zone, soon=soon).timestamp(), chance.choice((1, 2, 2))
    return Setting(begins_s, zone, rows, drift_check, bundles, chance.choice(LOGGED),
                   chance.choice(LINGERS_S), chance.choice(DISPLAY_AFTER_S), chance.random() < SMALL,
                   chance.choice(NO_TIME_S))  # fmt: skip


def hours(chance: random.Random, late: float) -> list[dict[str, str]]:
    """Rows of opening hours, never two at a time; this share of them over midnight."""
    rows = []
    for day in DAYS:
        if chance.random() < 0.15:
            continue
        opens = chance.randrange(8 * 60, 18 * 60)
        # Not in the hour that summer time leaves out: what its times mean is not worked out a second time here.
        closes = min(opens + chance.randrange(60, 10 * 60), 25 * 60 + 55)
        if chance.random() < late:
            closes = chance.randrange(27 * 60 + 5, 31 * 60)
        rows.append({"day": day, "opens": _clock(opens), "closes": _clock(closes)})
    return rows or [{"day": "mon", "opens": "10:00", "closes": "18:00"}]


def _clock(minutes: int) -> str:
    return f"{minutes // 60 % 24:02}:{minutes % 60:02}"


def begins(chance: random.Random, zone: str, *, soon: bool) -> datetime:
    """When a life begins; with ``soon`` some two days before the clocks of the zone change."""
    day = datetime(2026, 1, 1, tzinfo=UTC) + timedelta(days=chance.randrange(0, 1000))
    if soon:
        later = [day + timedelta(days=number) for number in range(200)]
        offsets = [one.astimezone(ZoneInfo(zone)).utcoffset() for one in later]
        changes = [number for number in range(1, 200) if offsets[number] != offsets[number - 1]]
        day += timedelta(days=max(0, changes[0] - 3)) if changes else timedelta()
    return day + timedelta(minutes=chance.randrange(1440))
