"""What happens in a life, drawn from its seed.

As in swarm testing (Groce and others, 2012) each life has only some kinds of things, and those more often. What a few
kinds do together is hardly ever seen in lives that all have a little of everything.
"""

from __future__ import annotations

import json
import random
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

from lab.simulate.incidents.commands import CHANGES
from lab.simulate.incidents.places import ZONES, hours, setting
from lab.simulate.incidents.script import DIED, POWER_CUT, STOPPED, WRITTEN_LAST, Item
from lab.simulate.judge.calendar import Calendar
from lab.simulate.lamps import LINE_TROUBLES
from lab.simulate.player import TROUBLES
from lab.simulate.scheduler import DAY_S
from lab.simulate.stage import APPEARANCES, NAMES

HOUR_S: Final = 3600.0
WORK: Final = ("recalibrate", "compare", "test-shots")
CANCELLED: Final = 0.5

LEFT_OUT: Final = (0.3, 0.6, 0.8)
"""Share of the kinds of things, and of the ways in which each happens, that a life does not have."""
LEANINGS: Final = (1.0, 1.0, 4.0)
PACES_H: Final = (2.0, 4.0, 8.0, 16.0)
"""Most promises are judged some half an hour after the last trouble: in a life without a pause they never are."""
NEAR: Final = (0.0, 0.1, 0.2)
"""Share of what happens that happens around an opening or a closing, and how long before and after it."""
AROUND_S: Final = (-300.0, 120.0)
AT_MOMENTS: Final = (0.3, 0.5, 0.7)
"""Share of what happens that waits for a moment at which the kiosk does something, and how long it comes after it."""
SOON_S: Final[Mapping[str, tuple[float, float]]] = {"at once": (0.0, 1.0), "soon": (1.0, 15.0), "later": (15.0, 150.0)}
SEVERAL: Final = (0.3, 0.6, 0.9)
"""Share of what happens that does not come alone."""
ALIKE: Final = (0.0, 0.1, 0.4)
"""Share of what happens to one projector that has a cause that all of them share, such as their air or their mains."""
RESTLESS: Final = ("garbled", "flaky", *TROUBLES)
RESTLESS_S: Final = {"line": 900.0, "player": 450.0}
"""Trouble that comes and goes every second is not drawn for longer: it would take most of the time of a life."""
LONGEST_S: Final = 40_000.0
NOTICED_S: Final = 1800.0
"""It takes people so long at least to notice a damaged bundle or a cable that is out, and to do something about it."""
UNNOTICED: Final = "until somebody comes"

PAST: Final = "past a change"

_Weights = Mapping[str, float]
KINDS: Final[_Weights] = {
    "line": 2, "lamp fails": 1, "lamp reports": 1, "lamp switched by hand": 1, "player": 2, "camera gone": 1,
    "disk full": 2, "disk low": 0.5, "file damaged": 4, "bundle damaged": 2, "killed": 1, "bundles unreadable": 1.5,
    "killed while writing": 1, "power cut": 1, "restarted": 1, "clock set": 1, "network gone": 0.5, "drift": 0.5,
    "command": 6, "x server": 1, "cable out": 2, "published": 1,
    "settings edited": 1,
}  # fmt: skip
MOMENTS: Final[_Weights] = {
    "work-begins": 2, "task-due": 1, "asked": 1, "service-started": 2, "player-started": 1, "disk-full": 1,
    "lamp-struck": 1, "powering": 1, "playing": 1, "degraded": 1, "fault": 1, "cooling": 1, "off": 1,
}  # fmt: skip
"""Codes of the kiosk's events, and the states that a stage comes to."""
COMMANDS: Final[_Weights] = {
    "start": 6, "stop": 6, "play": 4, "rotate": 2, "next": 3, "black": 3, "pause": 3, "brightness": 3, "identify": 2,
    "recalibrate": 4, "cancel": 3, "compare": 2, "set-schedule": 3, "seen": 1, "save-settings": 3, "test-shots": 1,
}  # fmt: skip
FILES: Final[_Weights] = {
    "kiosk/events.sqlite": 9, "kiosk/events.sqlite-wal": 1, "kiosk/lamps.json": 1, "schedule.toml": 1, "stage.toml": 2,
    "bundles/starts.json": 1, "lamps.json": 3, "lamps-copy.json": 1, "kiosk/stage.toml.good": 1,
}  # fmt: skip
BEFORE: Final[Mapping[str, Sequence[str]]] = {
    "file damaged": ("", STOPPED, STOPPED, STOPPED),
    "bundle damaged": ("", POWER_CUT),
    "bundles unreadable": ("", DIED, DIED),
}
"""How the service or the player ended before something was damaged, or with it."""
HOW: Final[Mapping[str, _Weights | Sequence[str]]] = {
    "line": {**dict.fromkeys(LINE_TROUBLES, 1), "silent": 3, "gone": 3},
    "lamp fails": ("", "goes out"),
    "lamp reports": ("temperature", "cover", "lamp-failed", "fan"),
    "lamp switched by hand": ("off", "on"),
    "player": {"killed": 3, "hung": 2, **dict.fromkeys(("crashes", "crashes at a picture", *TROUBLES), 1)},
    "restarted": ("lamps stay lit", "lamps off"),
    "clock set": {"hours": 1, "days": 1, "lost": 2},
    "cable out": ("", UNNOTICED),
    "settings edited": CHANGES,
}
DAMAGES: Final[Mapping[str, _Weights]] = {
    "file damaged": {"cut": 1, "flipped": 1, "block": 3, "half": 3, "zeros": 2, "empty": 1, "removed": 1},
    "bundle damaged": {"": 2, "all": 1},
}
"""What is damaged, how and after what is drawn from all in each life: few would have the three at a time."""
LASTS_S: Final[Mapping[str, tuple[float, float]]] = {
    "seconds": (0.5, 30.0), "minutes": (30.0, 900.0), "hours": (900.0, LONGEST_S), PAST: (300.0, 7200.0),
}  # fmt: skip
"""``PAST`` is counted from the next opening or closing."""
AFTER: Final = ("at once", "at once", "while it lasts", "while it lasts", "as it ends")
"""When another thing happens after the first of several."""
MOST_TOGETHER: Final = 5
ENDLESS: Final = (
    "killed", "drift", "restarted", "killed while writing", "command", "lamp switched by hand", "published",
    "settings edited",
)  # fmt: skip
LAST: Final = 0.75
"""Share of the damage to the log that meets what was written last, as when the power is switched off soon after."""
MIND: Final = 0.7
"""Share of the commands "start" and "stop" that ask for what the hours do not."""


class Leaning:
    """What one life has, and how often: drawn for each choice when it is first made, always the same for a seed."""

    def __init__(self, seed: str) -> None:
        self._seed = seed
        chance = random.Random(f"{seed} leaning")
        self._left_out = chance.choice(LEFT_OUT)
        self.pace_s = chance.choice(PACES_H) * HOUR_S
        self.near, self.several, self.alike = chance.choice(NEAR), chance.choice(SEVERAL), chance.choice(ALIKE)
        self.at_moments = chance.choice(AT_MOMENTS)
        self._weights: dict[str, dict[str, float]] = {}

    def drawn(self, chance: random.Random, what: str, usual: _Weights | Sequence[str]) -> str:
        """One of these, as often as this life has it."""
        if what not in self._weights:
            self._weights[what] = self._weigh(what, usual if isinstance(usual, Mapping) else dict.fromkeys(usual, 1.0))
        weights = self._weights[what]
        return chance.choices(list(weights), list(weights.values()))[0]

    def _weigh(self, what: str, usual: _Weights) -> dict[str, float]:
        chance = random.Random(f"{self._seed} leaning {what}")
        weights = {name: weight * chance.choice(LEANINGS) for name, weight in usual.items()}
        kept = {name: weight for name, weight in weights.items() if chance.random() >= self._left_out}
        return kept or dict([chance.choice(list(weights.items()))])


def draw(seed: str, days: float) -> list[Item]:
    """The script of a life. Each has a pace and a leaning of its own.

    Of several things that come together, some come at once, some while the first lasts, and some as it ends. Much of
    it happens when the stage opens or closes, or at a moment when the kiosk does something.
    """
    chance, leaning, place = random.Random(f"{seed} script"), Leaning(seed), setting(seed)
    calendar = Calendar(place.zone, place.rows)
    drawing = _Drawing(chance, leaning, calendar, place.begins_unix_s)
    items: list[Item] = []
    at_s = chance.expovariate(1 / min(leaning.pace_s, 5 * HOUR_S)) + 600.0
    while at_s < days * DAY_S:
        near = chance.random()
        if near < leaning.near:
            edge_s = calendar.changes_s(place.begins_unix_s + at_s) - place.begins_unix_s
            at_s = min(max(at_s, edge_s + chance.uniform(*AROUND_S)), days * DAY_S)
        together = drawing.together(at_s)
        if leaning.near < near < leaning.near + leaning.at_moments:
            together = _waiting(chance, leaning, together)
        items += together
        at_s += chance.expovariate(1 / leaning.pace_s) + 30.0
    return sorted((item for item in items if item.at_s < days * DAY_S), key=lambda item: item.at_s)


def _waiting(chance: random.Random, leaning: Leaning, together: Sequence[Item]) -> list[Item]:
    """The same at a moment at which the kiosk does something, with the same times between them."""
    begins_s = min(item.at_s for item in together)
    moment = leaning.drawn(chance, "moment", MOMENTS)
    soon_s = chance.uniform(*SOON_S[leaning.drawn(chance, "soon", list(SOON_S))])
    return [
        replace(item, at_s=begins_s, moment=moment, after_s=round(item.at_s - begins_s + soon_s, 3))
        for item in together
    ]


def _any_of(chance: random.Random, weights: _Weights) -> str:
    """The same in each life."""
    return chance.choices(list(weights), list(weights.values()))[0]


def _after_s(chance: random.Random, first: Item) -> float:
    match chance.choice(AFTER):
        case "while it lasts":
            return first.at_s + chance.uniform(0.0, first.for_s or 600.0)
        case "as it ends":
            return first.at_s + first.for_s + chance.uniform(0.0, 300.0)
        case _:
            return first.at_s + chance.expovariate(1 / 60.0)


class _Drawing:
    """Draws things. ``begins_s``: Unix seconds of the beginning."""

    def __init__(self, chance: random.Random, leaning: Leaning, calendar: Calendar, begins_s: float) -> None:
        self._chance, self._leaning, self._calendar, self._begins_s = chance, leaning, calendar, begins_s

    def together(self, at_s: float) -> list[Item]:
        """One thing, and what comes together with it."""
        chance, first = self._chance, self._one(at_s)
        items = self._with_others(first)
        if chance.random() < self._leaning.several:
            for _ in range(chance.randint(1, MOST_TOGETHER)):
                items += self._with_others(self._one(_after_s(chance, first)))
        return items

    def _with_others(self, item: Item) -> list[Item]:
        """It, and what comes of the same cause: the other projectors', or that people think better of it."""
        chance = self._chance
        if item.who in NAMES and chance.random() < self._leaning.alike:
            others = [
                replace(item, who=name, at_s=round(item.at_s + chance.expovariate(1 / 20.0), 3)) for name in NAMES
            ]
            return [item if other.who == item.who else other for other in others]
        if item.who in WORK and chance.random() < CANCELLED:
            return [item, Item(round(item.at_s + chance.uniform(1.0, 120.0), 3), "command", "cancel")]
        return [item]

    def _one(self, at_s: float) -> Item:  # noqa: PLR0911 - one for each kind
        chance, leaning = self._chance, self._leaning
        at_s, what = round(at_s, 3), leaning.drawn(chance, "what", KINDS)
        how = leaning.drawn(chance, what, HOW[what]) if what in HOW else _any_of(chance, DAMAGES.get(what, {"": 1}))
        lasts_s = self._lasts_s(at_s)
        lasts_s = 0.0 if what in ENDLESS else min(lasts_s, RESTLESS_S[what]) if how in RESTLESS else lasts_s
        name = chance.choice(NAMES)
        match what:
            case "cable out":
                return Item(at_s, what, name, how, max(NOTICED_S * (how == UNNOTICED), lasts_s))
            case "line" | "lamp fails" | "lamp reports" | "lamp switched by hand":
                return Item(at_s, what, name, how, lasts_s)
            case "player":
                times = chance.randint(1, 4) * how.startswith("crashes")
                return Item(at_s, what, "", how, lasts_s if how in TROUBLES else 0.0, times)
            case "file damaged":
                who, number = _any_of(chance, FILES), round(chance.random(), 3)
                number += WRITTEN_LAST * (chance.random() < LAST)
                return Item(at_s, what, who, how, number=number, arguments=chance.choice(BEFORE[what]))
            case "bundle damaged":
                return Item(at_s, what, "", how, max(NOTICED_S, lasts_s), arguments=chance.choice(BEFORE[what]))
            case "bundles unreadable":
                return Item(at_s, what, "", how, lasts_s, arguments=chance.choice(BEFORE[what]))
            case "killed while writing":
                return Item(at_s, what, number=round(chance.uniform(1.0, 8.0) ** 2))
            case "clock set":
                reach_s = {"hours": 7000.0, "days": 200_000.0, "lost": 0.0}[how]
                return Item(at_s, what, "", how, lasts_s, round(chance.uniform(-reach_s, reach_s), 1))
            case "command":
                return self._command(at_s, leaning.drawn(chance, "command", COMMANDS))
            case _:
                return Item(at_s, what, "", how, lasts_s)

    def _lasts_s(self, at_s: float) -> float:
        chance, how_long = self._chance, self._leaning.drawn(self._chance, "lasts", list(LASTS_S))
        from_s = min(self._calendar.changes_s(self._begins_s + at_s) - self._begins_s - at_s, LONGEST_S)
        return round(chance.uniform(*LASTS_S[how_long]) + from_s * (how_long == PAST), 1)

    def _command(self, at_s: float, who: str) -> Item:
        chance = self._chance
        values: dict[str, Any] = {}
        match who:
            case "start" | "stop":
                if chance.random() < MIND:
                    who = "stop" if self._calendar.open(self._begins_s + at_s) else "start"
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
                values = {"text": chance.choice(CHANGES)}
        return Item(at_s, "command", who, arguments=json.dumps(values, sort_keys=True) if values else "")
