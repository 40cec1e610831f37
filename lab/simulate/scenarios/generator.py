"""Draws the site and the incidents of a life from its seed.

As in swarm testing (Groce and others, 2012), each life has only some kinds of incidents, and those more often. In lives
that have a little of everything, a few kinds are hardly ever seen together.
"""

from __future__ import annotations

import json
import random
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from typing import Any, Final
from zoneinfo import ZoneInfo

from lab.simulate.lamps import LINE_TROUBLES
from lab.simulate.monitors.expectation import Calendar
from lab.simulate.player import TROUBLES
from lab.simulate.scenarios.commands import CHANGES
from lab.simulate.scenarios.scenario import DIED, POWER_CUT, STOPPED, WRITTEN_LAST, Incident, Site
from lab.simulate.scheduler import DAY_S
from lab.simulate.stage import APPEARANCES, NAMES

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


def random_site(seed: str) -> Site:
    """Where the clocks change soon, hours over midnight are usual: they meet the change."""
    rng = random.Random(f"{seed} life")
    soon = rng.random() < 0.5
    zone = rng.choice(CHANGING if soon else ZONES)
    rows = hours(rng, rng.choice((0.1, 0.9, 0.9) if soon else (0.0, 0.1, 0.9)))
    drift_check = rng.choice(["03:30", "02:30", "23:00"])
    begins_s, bundles = _random_start(rng, zone, soon=soon).timestamp(), rng.choice((1, 2, 2))
    return Site(begins_s, zone, rows, drift_check, bundles, rng.choice(LOGGED),
                   rng.choice(LINGERS_S), rng.choice(DISPLAY_AFTER_S), rng.random() < SMALL,
                   rng.choice(NO_TIME_S))  # fmt: skip


def hours(rng: random.Random, late: float) -> list[dict[str, str]]:
    """Rows of opening hours, never two at a time; this share of them over midnight."""
    rows = []
    for day in DAYS:
        if rng.random() < 0.15:
            continue
        opens = rng.randrange(8 * 60, 18 * 60)
        # Not in the hour that summer time leaves out: what its times mean is not worked out a second time here.
        closes = min(opens + rng.randrange(60, 10 * 60), 25 * 60 + 55)
        if rng.random() < late:
            closes = rng.randrange(27 * 60 + 5, 31 * 60)
        rows.append({"day": day, "opens": _clock(opens), "closes": _clock(closes)})
    return rows or [{"day": "mon", "opens": "10:00", "closes": "18:00"}]


def _clock(minutes: int) -> str:
    return f"{minutes // 60 % 24:02}:{minutes % 60:02}"


def _random_start(rng: random.Random, zone: str, *, soon: bool) -> datetime:
    """When a life begins; with ``soon`` some two days before the clocks of the zone change."""
    day = datetime(2026, 1, 1, tzinfo=UTC) + timedelta(days=rng.randrange(0, 1000))
    if soon:
        later = [day + timedelta(days=number) for number in range(200)]
        offsets = [one.astimezone(ZoneInfo(zone)).utcoffset() for one in later]
        changes = [number for number in range(1, 200) if offsets[number] != offsets[number - 1]]
        day += timedelta(days=max(0, changes[0] - 3)) if changes else timedelta()
    return day + timedelta(minutes=rng.randrange(1440))


HOUR_S: Final = 3600.0
WORK: Final = ("recalibrate", "compare", "test-shots")
CANCELLED: Final = 0.5

LEFT_OUT: Final = (0.3, 0.6, 0.8)
"""Share of the kinds of incidents, and of their variants, that a life does not have."""
LEANINGS: Final = (1.0, 1.0, 4.0)
PACES_H: Final = (2.0, 4.0, 8.0, 16.0)
"""Most invariants are checked some half an hour after the last trouble: in a life without a pause they never are."""
NEAR: Final = (0.0, 0.1, 0.2)
"""Share of the incidents around an opening or a closing, and how long before and after it."""
AROUND_S: Final = (-300.0, 120.0)
AT_EVENTS: Final = (0.3, 0.5, 0.7)
"""Share of the incidents that wait for an event of the kiosk, and how long they come after it."""
SOON_S: Final[Mapping[str, tuple[float, float]]] = {"at once": (0.0, 1.0), "soon": (1.0, 15.0), "later": (15.0, 150.0)}
SEVERAL: Final = (0.3, 0.6, 0.9)
"""Share of the incidents that do not come alone."""
ALIKE: Final = (0.0, 0.1, 0.4)
"""Share of the incidents of a projector whose cause all projectors share, such as their air or their mains."""
RESTLESS: Final = ("garbled", "flaky", *TROUBLES)
RESTLESS_S: Final = {"line": 900.0, "player": 450.0}
"""Faults that come and go every second are not drawn for longer: they would take most of the time of a life."""
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
EVENTS: Final[_Weights] = {
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
VARIANTS: Final[Mapping[str, _Weights | Sequence[str]]] = {
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
"""Of damage, every life can have every variant: few lives would have file, variant and end at a time."""
LASTS_S: Final[Mapping[str, tuple[float, float]]] = {
    "seconds": (0.5, 30.0), "minutes": (30.0, 900.0), "hours": (900.0, LONGEST_S), PAST: (300.0, 7200.0),
}  # fmt: skip
"""``PAST`` is counted from the next opening or closing."""
AFTER: Final = ("at once", "at once", "while it lasts", "while it lasts", "as it ends")
"""When another incident begins after the first of several."""
MOST_TOGETHER: Final = 5
ENDLESS: Final = (
    "killed", "drift", "restarted", "killed while writing", "command", "lamp switched by hand", "published",
    "settings edited",
)  # fmt: skip
LAST: Final = 0.75
"""Share of the damage to the log that meets what was written last, as when the power is switched off soon after."""
MIND: Final = 0.7
"""Share of the commands "start" and "stop" that ask for what the hours do not."""


class SwarmWeights:
    """How often one life has each kind and variant. Drawn at the first choice; the same for a seed."""

    def __init__(self, seed: str) -> None:
        self._seed = seed
        rng = random.Random(f"{seed} leaning")
        self._left_out = rng.choice(LEFT_OUT)
        self.pace_s = rng.choice(PACES_H) * HOUR_S
        self.near, self.several, self.alike = rng.choice(NEAR), rng.choice(SEVERAL), rng.choice(ALIKE)
        self.at_events = rng.choice(AT_EVENTS)
        self._weights: dict[str, dict[str, float]] = {}

    def choose(self, rng: random.Random, what: str, usual: _Weights | Sequence[str]) -> str:
        """One of these, as often as this life has it."""
        if what not in self._weights:
            self._weights[what] = self._weights_of(
                what, usual if isinstance(usual, Mapping) else dict.fromkeys(usual, 1.0)
            )
        weights = self._weights[what]
        return rng.choices(list(weights), list(weights.values()))[0]

    def _weights_of(self, what: str, usual: _Weights) -> dict[str, float]:
        rng = random.Random(f"{self._seed} leaning {what}")
        weights = {name: weight * rng.choice(LEANINGS) for name, weight in usual.items()}
        kept = {name: weight for name, weight in weights.items() if rng.random() >= self._left_out}
        return kept or dict([rng.choice(list(weights.items()))])


def random_scenario(seed: str, days: float) -> list[Incident]:
    """The scenario of a life. Each life has its own pace and weights.

    Of several incidents that come together, some begin at once, some while the first lasts, and some as it ends. Many
    come when the stage opens or closes, or after an event of the kiosk.
    """
    rng, swarm, site = random.Random(f"{seed} script"), SwarmWeights(seed), random_site(seed)
    calendar = Calendar(site.zone, site.rows)
    generator = _IncidentGenerator(rng, swarm, calendar, site.begins_unix_s)
    incidents: list[Incident] = []
    at_s = rng.expovariate(1 / min(swarm.pace_s, 5 * HOUR_S)) + 600.0
    while at_s < days * DAY_S:
        near = rng.random()
        if near < swarm.near:
            edge_s = calendar.changes_s(site.begins_unix_s + at_s) - site.begins_unix_s
            at_s = min(max(at_s, edge_s + rng.uniform(*AROUND_S)), days * DAY_S)
        combined = generator.combined(at_s)
        if swarm.near < near < swarm.near + swarm.at_events:
            combined = _after_event(rng, swarm, combined)
        incidents += combined
        at_s += rng.expovariate(1 / swarm.pace_s) + 30.0
    return sorted(
        (incident for incident in incidents if incident.at_s < days * DAY_S), key=lambda incident: incident.at_s
    )


def _after_event(rng: random.Random, swarm: SwarmWeights, combined: Sequence[Incident]) -> list[Incident]:
    """The same after an event of the kiosk, with the same times between them."""
    begins_s = min(incident.at_s for incident in combined)
    moment = swarm.choose(rng, "moment", EVENTS)
    soon_s = rng.uniform(*SOON_S[swarm.choose(rng, "soon", list(SOON_S))])
    return [
        replace(incident, at_s=begins_s, after_event=moment, delay_s=round(incident.at_s - begins_s + soon_s, 3))
        for incident in combined
    ]


def _weighted_choice(rng: random.Random, weights: _Weights) -> str:
    """The same in each life."""
    return rng.choices(list(weights), list(weights.values()))[0]


def _another_at_s(rng: random.Random, first: Incident) -> float:
    match rng.choice(AFTER):
        case "while it lasts":
            return first.at_s + rng.uniform(0.0, first.duration_s or 600.0)
        case "as it ends":
            return first.at_s + first.duration_s + rng.uniform(0.0, 300.0)
        case _:
            return first.at_s + rng.expovariate(1 / 60.0)


class _IncidentGenerator:
    """Draws incidents. ``begins_s``: Unix seconds of the beginning."""

    def __init__(self, rng: random.Random, swarm: SwarmWeights, calendar: Calendar, begins_s: float) -> None:
        self._rng, self._swarm, self._calendar, self._begins_s = rng, swarm, calendar, begins_s

    def combined(self, at_s: float) -> list[Incident]:
        """One incident, and those that come together with it."""
        rng, first = self._rng, self._single(at_s)
        incidents = self._with_consequences(first)
        if rng.random() < self._swarm.several:
            for _ in range(rng.randint(1, MOST_TOGETHER)):
                incidents += self._with_consequences(self._single(_another_at_s(rng, first)))
        return incidents

    def _with_consequences(self, incident: Incident) -> list[Incident]:
        """It, and what has the same cause: the same at other projectors, or people who cancel their command."""
        rng = self._rng
        if incident.target in NAMES and rng.random() < self._swarm.alike:
            others = [
                replace(incident, target=name, at_s=round(incident.at_s + rng.expovariate(1 / 20.0), 3))
                for name in NAMES
            ]
            return [incident if other.target == incident.target else other for other in others]
        if incident.target in WORK and rng.random() < CANCELLED:
            return [incident, Incident(round(incident.at_s + rng.uniform(1.0, 120.0), 3), "command", "cancel")]
        return [incident]

    def _single(self, at_s: float) -> Incident:  # noqa: PLR0911 - one for each kind
        rng, swarm = self._rng, self._swarm
        at_s, kind = round(at_s, 3), swarm.choose(rng, "what", KINDS)
        variant = (
            swarm.choose(rng, kind, VARIANTS[kind])
            if kind in VARIANTS
            else _weighted_choice(rng, DAMAGES.get(kind, {"": 1}))
        )
        duration_s = self._duration_s(at_s)
        duration_s = (
            0.0 if kind in ENDLESS else min(duration_s, RESTLESS_S[kind]) if variant in RESTLESS else duration_s
        )
        name = rng.choice(NAMES)
        match kind:
            case "cable out":
                return Incident(at_s, kind, name, variant, max(NOTICED_S * (variant == UNNOTICED), duration_s))
            case "line" | "lamp fails" | "lamp reports" | "lamp switched by hand":
                return Incident(at_s, kind, name, variant, duration_s)
            case "player":
                times = rng.randint(1, 4) * variant.startswith("crashes")
                return Incident(at_s, kind, "", variant, duration_s if variant in TROUBLES else 0.0, times)
            case "file damaged":
                target, number = _weighted_choice(rng, FILES), round(rng.random(), 3)
                number += WRITTEN_LAST * (rng.random() < LAST)
                return Incident(at_s, kind, target, variant, magnitude=number, arguments=rng.choice(BEFORE[kind]))
            case "bundle damaged":
                return Incident(at_s, kind, "", variant, max(NOTICED_S, duration_s), arguments=rng.choice(BEFORE[kind]))
            case "bundles unreadable":
                return Incident(at_s, kind, "", variant, duration_s, arguments=rng.choice(BEFORE[kind]))
            case "killed while writing":
                return Incident(at_s, kind, magnitude=round(rng.uniform(1.0, 8.0) ** 2))
            case "clock set":
                reach_s = {"hours": 7000.0, "days": 200_000.0, "lost": 0.0}[variant]
                return Incident(at_s, kind, "", variant, duration_s, round(rng.uniform(-reach_s, reach_s), 1))
            case "command":
                return self._command(at_s, swarm.choose(rng, "command", COMMANDS))
            case _:
                return Incident(at_s, kind, "", variant, duration_s)

    def _duration_s(self, at_s: float) -> float:
        rng, how_long = self._rng, self._swarm.choose(self._rng, "lasts", list(LASTS_S))
        from_s = min(self._calendar.changes_s(self._begins_s + at_s) - self._begins_s - at_s, LONGEST_S)
        return round(rng.uniform(*LASTS_S[how_long]) + from_s * (how_long == PAST), 1)

    def _command(self, at_s: float, operation: str) -> Incident:
        rng = self._rng
        values: dict[str, Any] = {}
        match operation:
            case "start" | "stop":
                if rng.random() < MIND:
                    operation = "stop" if self._calendar.open(self._begins_s + at_s) else "start"
            case "play":
                values = {"name": rng.choice(APPEARANCES), **({"fade_s": 2.0} if rng.random() < 0.5 else {})}
            case "black" | "pause" | "identify":
                values = {"on": rng.random() < 0.5}
            case "brightness":
                values = {"percent": rng.choice([0, 10, 50, 100])}
            case "recalibrate":
                values = {"kind": rng.choice(["quick", "full"])}
            case "set-schedule":
                values = {"time_zone": rng.choice(ZONES), "drift_check": rng.choice(["03:30", "02:30", ""]),
                          "rows": hours(rng, rng.choice((0.0, 0.1, 0.9)))}  # fmt: skip
            case "save-settings":
                values = {"text": rng.choice(CHANGES)}
        return Incident(at_s, "command", operation, arguments=json.dumps(values, sort_keys=True) if values else "")
