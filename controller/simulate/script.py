"""What happens to a kiosk from outside in one life: drawn from the seed before it begins, so it can be shortened."""

from __future__ import annotations

import json
import random
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime, timedelta
from typing import Any, Final
from zoneinfo import ZoneInfo

from controller.simulate.calendar import Calendar
from controller.simulate.lamps import LINE_TROUBLES
from controller.simulate.player import TROUBLES
from controller.simulate.scheduler import DAY_S
from controller.simulate.stage import APPEARANCES, NAMES

HOUR_S: Final = 3600.0
RESTLESS: Final = ("garbled", "flaky")
RESTLESS_S: Final = 900.0
"""Trouble that comes and goes every second is not drawn for longer: it would take most of the time of a life."""
CHANGING: Final = ("Europe/Vienna", "America/New_York", "Australia/Lord_Howe")
"""Zones whose clocks change twice a year."""
ZONES: Final = (*CHANGING, "Asia/Kolkata", "UTC")
FILES: Final = (
    "kiosk/events.sqlite", "kiosk/events.sqlite-wal", "kiosk/lamps.json", "schedule.toml", "stage.toml",
    "bundles/starts.json", "lamps.json", "kiosk/stage.toml.good", "stage.toml",
)  # fmt: skip
PACES_H: Final = (1.5, 4.0, 8.0)
WORK: Final = ("recalibrate", "compare", "test-shots")
CANCELLED: Final = 0.5
NEAR: Final = (0.0, 0.2, 0.5)
"""Share of what happens that happens around an opening or a closing, and how long before and after it."""
AROUND_S: Final = (-300.0, 120.0)
LEANINGS: Final = (0.0, 1.0, 1.0, 4.0)
_Weights = tuple[tuple[str, float], ...]
DAYS: Final = ("mon", "tue", "wed", "thu", "fri", "sat", "sun")


@dataclass(frozen=True, slots=True)
class Item:
    """One thing that happens ``at_s``; ``for_s``: how long it lasts, 0: it has no end of its own.

    ``who``: a projector, a file, an operation; ``how``: which trouble; ``number``: its size; ``arguments``: of an
    operation.
    """

    at_s: float
    what: str
    who: str = ""
    how: str = ""
    for_s: float = 0.0
    number: float = 0.0
    arguments: str = ""

    @property
    def line(self) -> str:
        """It in words."""
        said = " ".join(word for word in (self.what, self.who, self.how, self.arguments) if word)
        lasts = f" for {self.for_s:.0f} s" if self.for_s else ""
        size = f" ({self.number:g})" if self.number else ""
        return f"{self.at_s / DAY_S:7.3f} d  {said}{size}{lasts}"


@dataclass(frozen=True, slots=True)
class Setting:
    """Where and when a life takes place: ``begins_unix_s``, time ``zone``, opening ``rows``, ``drift_check``."""

    begins_unix_s: float
    zone: str
    rows: list[dict[str, str]]
    drift_check: str


def to_json(place: Setting, items: Sequence[Item]) -> str:
    """A script with its setting as text, one item a line: it stays the same when settings are drawn in another way."""
    lines = ",\n".join(json.dumps(asdict(item)) for item in items)
    return f'{{"setting": {json.dumps(asdict(place))},\n"items": [\n{lines}\n]}}\n'


def from_json(text: str) -> tuple[Setting, list[Item]]:
    """As ``to_json``. Raises ValueError, TypeError and KeyError."""
    values = json.loads(text)
    return Setting(**values["setting"]), [Item(**item) for item in values["items"]]


def setting(seed: str) -> Setting:
    """As drawn from the seed. Where the clocks change soon, hours over midnight are usual: they meet the change."""
    chance = random.Random(f"{seed} life")
    soon = chance.random() < 0.5
    zone = chance.choice(CHANGING if soon else ZONES)
    rows = hours(chance, chance.choice((0.1, 0.9, 0.9) if soon else (0.0, 0.1, 0.9)))
    return Setting(begins(chance, zone, soon=soon).timestamp(), zone, rows, chance.choice(["03:30", "02:30", "23:00"]))


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


def draw(seed: str, days: float) -> list[Item]:
    """The script of a life. Many things happen alone, some several at once.

    Each life has a pace and a leaning of its own: some kinds of things never happen in it, others often. What several
    of one kind do together would hardly ever be seen otherwise. In some lives much happens when the stage opens or
    closes, which is when a kiosk does most.
    """
    chance = random.Random(f"{seed} script")
    kinds, commands, pace_s = _leaning(chance, _KINDS), _leaning(chance, _COMMANDS), chance.choice(PACES_H) * HOUR_S
    place, near = setting(seed), chance.choice(NEAR)
    calendar = Calendar(place.zone, place.rows)
    items: list[Item] = []
    at_s = chance.expovariate(1 / (5 * HOUR_S)) + 600.0
    while at_s < days * DAY_S:
        if chance.random() < near:
            edge_s = calendar.changes_s(place.begins_unix_s + at_s) - place.begins_unix_s
            at_s = min(max(at_s, edge_s + chance.uniform(*AROUND_S)), days * DAY_S)
        count = 1 if chance.random() < 0.75 else chance.randint(2, 5)
        for number in range(count):
            then_s = at_s + chance.expovariate(1 / 60.0) * (number > 0)
            items.append(_one(chance, then_s, _drawn(chance, kinds), commands))
            if items[-1].who in WORK and chance.random() < CANCELLED:
                # People think better of it.
                items.append(Item(round(then_s + chance.uniform(1.0, 120.0), 3), "command", "cancel"))
        at_s += chance.expovariate(1 / pace_s) + 30.0
    return sorted(items, key=lambda item: item.at_s)


def _leaning(chance: random.Random, usual: _Weights) -> _Weights:
    return tuple((kind, weight * chance.choice(LEANINGS)) for kind, weight in usual)


def _drawn(chance: random.Random, weights: _Weights) -> str:
    known = any(weight for _, weight in weights)
    return chance.choices([kind for kind, _ in weights], [weight if known else 1.0 for _, weight in weights])[0]


def _one(chance: random.Random, at_s: float, what: str, commands: _Weights) -> Item:  # noqa: PLR0911, PLR0912 - one for each kind
    at_s = round(at_s, 3)
    lasts_s = round(
        chance.choice([chance.uniform(0.5, 30.0), chance.uniform(30.0, 900.0), chance.uniform(900, 30_000)]), 1
    )
    name = chance.choice(NAMES)
    match what:
        case "line":
            how = chance.choice(LINE_TROUBLES)
            return Item(at_s, what, name, how, min(lasts_s, RESTLESS_S) if how in RESTLESS else lasts_s)
        case "lamp fails":
            return Item(at_s, what, name, chance.choice(["", "goes out"]), lasts_s)
        case "lamp reports":
            return Item(at_s, what, name, chance.choice(["temperature", "cover", "lamp-failed", "fan"]), lasts_s)
        case "lamp switched by hand":
            return Item(at_s, what, name, chance.choice(["off", "on"]))
        case "player":
            how = chance.choice(["killed", "hung", "crashes", "crashes at a picture", *TROUBLES])
            count = chance.randint(1, 4) * how.startswith("crashes")
            return Item(at_s, what, "", how, min(lasts_s, RESTLESS_S) if how in TROUBLES else 0.0, count)
        case "file damaged":
            return Item(at_s, what, chance.choice(FILES), chance.choice(["cut", "flipped", "empty", "removed"]),
                        number=round(chance.random(), 3))  # fmt: skip
        case "bundle damaged":
            return Item(at_s, what, "", chance.choice(["", "", "all"]), max(600.0, lasts_s))
        case "killed while writing":
            return Item(at_s, what, number=chance.randint(1, 12))
        case "power cut":
            return Item(at_s, what, for_s=lasts_s)
        case "clock set":
            number = chance.choice([chance.uniform(-7000, 7000), chance.uniform(-200_000, 200_000), -1.5e9])
            return Item(at_s, what, "", "", lasts_s, round(number, 1))
        case "restarted":
            return Item(at_s, what, "", chance.choice(["lamps stay lit", "lamps off"]))
        case "command":
            return _command(at_s, chance, _drawn(chance, commands))
        case _:
            return Item(at_s, what, for_s=0.0 if what in ("killed", "drift") else lasts_s)


def _command(at_s: float, chance: random.Random, who: str) -> Item:
    values: dict[str, Any] = {}
    match who:
        case "play":
            values = {"name": chance.choice(APPEARANCES), **({"fade_s": 2.0} if chance.random() < 0.5 else {})}
        case "black" | "pause" | "identify":
            values = {"on": chance.random() < 0.5}
        case "brightness":
            values = {"percent": chance.choice([0, 10, 50, 100])}
        case "recalibrate":
            values = {"kind": chance.choice(["quick", "full"])}
        case "set-schedule":
            values = {"time_zone": chance.choice(ZONES), "drift_check": chance.choice(["03:30", "02:30", ""]),
                      "rows": hours(chance, chance.choice((0.0, 0.1, 0.9)))}  # fmt: skip
        case "save-settings":
            values = {"text": chance.choice(["comment", "projector", "display"])}
    return Item(at_s, "command", who, arguments=json.dumps(values, sort_keys=True) if values else "")


_KINDS: Final = (
    ("line", 14), ("lamp fails", 4), ("lamp reports", 3), ("lamp switched by hand", 3), ("player", 8),
    ("camera gone", 3), ("disk full", 6), ("disk low", 1), ("file damaged", 4), ("bundle damaged", 3), ("killed", 5),
    ("bundles unreadable", 2), ("killed while writing", 6), ("power cut", 5), ("restarted", 4), ("clock set", 3),
    ("network gone", 3), ("drift", 4), ("command", 28),
)  # fmt: skip
_COMMANDS: Final = (
    ("start", 6), ("stop", 6), ("play", 4), ("rotate", 2), ("next", 3), ("black", 3), ("pause", 3), ("brightness", 3),
    ("identify", 2), ("recalibrate", 4), ("cancel", 3), ("compare", 2), ("set-schedule", 3), ("seen", 1),
    ("save-settings", 3), ("test-shots", 1),
)  # fmt: skip
