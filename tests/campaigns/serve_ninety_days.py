"""Ninety days of a kiosk in virtual time: opening hours, dead lamps, drifts, power cuts and clocks that somebody sets.

    python -m tests.campaigns.serve_ninety_days [DAYS] [SEED]

Two lives, one over the end of summer time and one over its beginning. Every minute is accounted for: the stage did what
its hours say, or an incident excuses it, of which the event log tells; and at every minute the log's last word on the
stage's state is true. The hours are worked out here a second time, from local dates alone.
"""

from __future__ import annotations

import contextlib
import random
import re
import sqlite3
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path
from zoneinfo import ZoneInfo

from controller.kiosk.values import Schedule, ScheduleRow
from controller.run.state_machine import State
from tests.controller.kiosk.model import NAMES, Kiosk

VIENNA = ZoneInfo("Europe/Vienna")
HOURS = {"tue": ("10:00", "18:00"), "wed": ("10:00", "18:00"), "thu": ("10:00", "21:00"), "fri": ("18:00", "01:30"),
         "sat": ("09:00", "18:00"), "sun": ("09:00", "17:00")}  # fmt: skip
CLOSED = "2026-10-27"
SCHEDULE = Schedule(
    "Europe/Vienna",
    (*(ScheduleRow(day, *span) for day, span in HOURS.items()), ScheduleRow(CLOSED, "", "")),
    "03:30",
)
SETTLING_S = 200.0
"""After a change of any kind a stage may be between what it did and what it has to do for so long."""
REPAIR_S = 1900.0
"""After an incident: the longest retry out of a fault, and the lamps' own times."""
TOLD = {
    "cable": {"model-trouble", "port-gone"}, "power cut": {"service-started"}, "clock ahead": {"clock-set"},
    "clock back": {"clock-set"}, "clock lost": {"clock-set"}, "repair": {"projector-back", "lamp-struck", "state"},
    "begin": {"service-started"},
}  # fmt: skip
"""Events of which at least one is in the log where an incident of that kind excuses a minute."""
OPEN = frozenset({State.PLAYING, State.DEGRADED})
DARK = frozenset({State.OFF})


def open_by_the_calendar(unix_s: float) -> bool:
    """The hours without the planner: local dates and times compared as text."""
    now = datetime.fromtimestamp(unix_s, VIENNA)
    for day in (now, now - timedelta(days=1)):
        span = HOURS.get(day.strftime("%a").lower())
        if span is None or day.date().isoformat() == CLOSED:
            continue
        clock, today = now.strftime("%H:%M"), day is now
        past_midnight = span[1] <= span[0]
        if today and clock >= span[0] and (past_midnight or clock < span[1]):
            return True
        if not today and past_midnight and clock < span[1]:
            return True
    return False


@dataclass
class Account:
    """Minutes by what they were."""

    minutes: Counter[str] = field(default_factory=Counter)
    unaccounted: list[str] = field(default_factory=list)
    checks: Counter[str] = field(default_factory=Counter)
    incidents: Counter[str] = field(default_factory=Counter)
    strikes: int = 0
    sins: list[str] = field(default_factory=list)


class NinetyDays:
    """One life. ``live`` runs it."""

    def __init__(self, folder: Path, start: datetime, days: float, seed: int) -> None:
        self.random = random.Random(seed)
        self.kiosk = Kiosk(folder, SCHEDULE)
        # The truth: world.time_s plus a constant. The kiosk's own clock may differ from it.
        self.truth_offset_s = start.replace(tzinfo=VIENNA).timestamp() - self.kiosk.world.time_s
        self.kiosk.wall_offset_s = self.truth_offset_s
        self.kiosk.log.close()
        (folder / "events.sqlite").unlink()
        self.kiosk.boot()
        self.ends_s = self.kiosk.world.time_s + days * 86_400
        self.account = Account()
        self.excused_until_s = self.kiosk.world.time_s + SETTLING_S
        self.why, self.excused_since_s = "begin", self.kiosk.world.time_s
        self.heard: dict[str, float] = {}
        self.read, self.told = 0, ""
        self.mends: list[tuple[float, Callable[[], None]]] = []
        self.changed_s, self.was_open = self.kiosk.world.time_s, False

    @property
    def now_s(self) -> float:
        return self.kiosk.world.time_s

    def live(self) -> Account:
        next_incident_s = self.now_s + self._pause()
        next_minute_s = self.now_s
        while self.now_s < self.ends_s:
            if self.now_s >= next_incident_s:
                self._incident()
                next_incident_s = self.now_s + self._pause()
                next_minute_s = max(next_minute_s, self.now_s)
            for at_s, repair in [one for one in self.mends if one[0] <= self.now_s]:
                self.mends.remove((at_s, repair))
                repair()
                self._excuse(REPAIR_S, "repair")
            settled = self.kiosk.state in OPEN | DARK
            self.kiosk.step(20.0 if settled else 2.0)
            while next_minute_s <= self.now_s:
                self._count(next_minute_s)
                next_minute_s += 60.0
        self.account.strikes = sum(lamp.strikes for lamp in self.kiosk.lamps.values())
        self.account.sins = self.kiosk.sins
        return self.account

    def _pause(self) -> float:
        return self.random.expovariate(1 / (14 * 3600.0)) + 600.0

    def _excuse(self, seconds: float, why: str) -> None:
        if self.now_s + seconds > self.excused_until_s:
            self.excused_until_s, self.why, self.excused_since_s = self.now_s + seconds, why, self.now_s

    def _incident(self) -> None:
        kind = self.random.choice(
            ["burst", "cable", "power cut", "clock ahead", "clock back", "clock lost", "drift", "player", "camera"]
        )
        self.account.incidents[kind] += 1
        lamp, hours = self.kiosk.lamps[self.random.choice(NAMES)], self.random.uniform(0.1, 30.0)
        if kind == "burst":
            lamp.burst()
            self.mends.append((self.now_s + hours * 3600, lambda: self._new_lamp(lamp)))
        elif kind == "cable":
            lamp.trouble = "silent"
            self.mends.append((self.now_s + hours * 3600, lambda: setattr(lamp, "trouble", "")))
            # A lamp whose cable is away when the stage closes burns until it is back.
            self._excuse(hours * 3600 + REPAIR_S, "cable")
        elif kind == "power cut":
            seconds = self.random.uniform(1.0, 8 * 3600)
            began_s = self.now_s
            self._listen()
            self.kiosk.power_cut(seconds)
            self._check_the_cut(began_s)
            self.account.minutes["without power"] += int((self.now_s - began_s) // 60)
            self._excuse(SETTLING_S, "power cut")
            self.excused_since_s = min(self.excused_since_s, began_s)
        elif kind.startswith("clock"):
            off_s = {"clock ahead": self.random.uniform(60, 7000), "clock back": -self.random.uniform(60, 7000)}
            wrong_s = off_s.get(kind, -self.truth_offset_s)
            self.kiosk.wall_offset_s = self.truth_offset_s + wrong_s
            lasts_s = self.random.uniform(60, 7200)
            self.mends.append((self.now_s + lasts_s, self._right_clock))
            # After a clock was ahead, the kiosk's time stands still until the truth has caught up.
            self._excuse(lasts_s + max(0.0, wrong_s) + REPAIR_S, kind)
        elif kind == "drift":
            self.kiosk.jobs.drifted = True
        elif kind == "player":
            self.kiosk.player.hung_at_s = self.now_s
        else:
            self.kiosk.jobs.camera = False
            self.mends.append((self.now_s + hours * 3600, lambda: setattr(self.kiosk.jobs, "camera", True)))

    def _new_lamp(self, lamp: object) -> None:
        setattr(lamp, "dud", False)  # noqa: B010 - the knob of a model
        for supervisor in self.kiosk.supervisors:
            supervisor.forgive()

    def _right_clock(self) -> None:
        self.kiosk.wall_offset_s = self.truth_offset_s

    def _listen(self) -> None:
        """Read what the log has to say since the last time."""
        for row in self.kiosk.log.after(self.read):
            self.read, self.heard[row.code] = row.number, self.now_s
            if row.code == "state":
                self.told = row.text.removeprefix("The stage is ").partition(":")[0].partition(".")[0]
            elif row.code == "service-started":
                self.told = State.OFF.value

    def _check_the_cut(self, began_s: float) -> None:
        """The service that begins says since when there was none, as far as the clock was right."""
        (row,) = [row for row in self.kiosk.log.after(self.read) if row.code == "service-started"]
        said = row.text.partition("after ")[2].partition(" UTC")[0]
        if not said:
            self.account.unaccounted.append(f"not told since when there was no power: {row.text}")
        elif self.kiosk.wall_offset_s == self.truth_offset_s and self.why != "clock ahead":
            at_s = datetime.strptime(said, "%Y-%m-%d %H:%M").replace(tzinfo=UTC).timestamp()
            if not -60.0 <= began_s + self.truth_offset_s - at_s <= 150.0:
                self.account.unaccounted.append(f"the power was cut at another time: {row.text}")

    def _explained(self, why: str) -> bool:
        return any(self.heard.get(code, -1e9) >= self.excused_since_s - 60.0 for code in TOLD[why])

    def _count(self, at_s: float) -> None:
        self._listen()
        if self.told != self.kiosk.state.value:
            self.account.unaccounted.append(f"{at_s:.0f} the log says {self.told}: {self.kiosk.state.value}")
        truly = open_by_the_calendar(at_s + self.truth_offset_s)
        if truly is not self.was_open:
            self.was_open, self.changed_s = truly, at_s
        state = self.kiosk.state
        local = datetime.fromtimestamp(at_s + self.truth_offset_s, VIENNA)
        if state in (OPEN if truly else DARK):
            self.account.minutes["open" if truly else "closed"] += 1
        elif at_s - self.changed_s <= SETTLING_S:
            self.account.minutes["opening or closing"] += 1
        elif not truly and self.kiosk.reconciler.plan.open is False and self._checking():
            self.account.minutes["nightly check"] += 1
        elif at_s <= self.excused_until_s:
            self.account.minutes[f"excused: {self.why}"] += 1
            if not self._explained(self.why):
                self.account.unaccounted.append(f"{local:%Y-%m-%d %H:%M} nothing in the log tells of {self.why}")
        elif all(lamp.dud for lamp in self.kiosk.lamps.values()):
            self.account.minutes["every lamp dead"] += 1
        else:
            self.account.unaccounted.append(
                f"{local:%Y-%m-%d %H:%M} {state.value} {self.kiosk.reconciler.machine.reason}"
            )

    def _checking(self) -> bool:
        """A check that finds a lamp dark is given up, and the lamps are cooled."""
        begun_s = self.heard.get("task-due", -1e9)
        return self.kiosk.reconciler.working or self.kiosk.state is State.COOLING or self.now_s - begun_s < SETTLING_S


def live(folder: Path, *, days: float, start: datetime, seed: int) -> Account:
    """A life of so many days from a local date on."""
    return NinetyDays(folder, start, days, seed).live()


def nights_misjudged(folder: Path, days: float, start: datetime) -> list[str]:
    """Nights whose check the log tells more than once as begun or left out, and those that were passed over."""
    with contextlib.closing(sqlite3.connect(folder / "events.sqlite")) as database:
        rows = database.execute("SELECT text FROM events WHERE code IN ('task-due', 'task-left-out')").fetchall()
        done = {key for (key,) in database.execute("SELECT key FROM done")}
    keys = Counter(key for (text,) in rows for key in re.findall(r"drift-check \d{4}-\d\d-\d\d", text))
    twice = [f"{key} twice" for key, count in keys.items() if count > 1]
    nights = [f"drift-check {start + timedelta(days=number):%Y-%m-%d}" for number in range(1, int(days) - 1)]
    return twice + [f"{night} never" for night in nights if night not in done]


STARTS = (datetime(2026, 9, 1), datetime(2027, 1, 10))
"""Ninety days from the first go over 25 October, from the second over 28 March."""


def report(days: float, start: datetime, seed: int) -> bool:
    """Live once, print what came of it, and say whether it holds."""
    began_s = time.monotonic()
    with tempfile.TemporaryDirectory() as name:
        account = live(Path(name), days=days, start=start, seed=seed)
        nights = nights_misjudged(Path(name), days, start)
    print(f"{days:g} days from {start:%Y-%m-%d} in {time.monotonic() - began_s:.0f} s, {account.strikes} strikes")
    print(dict(account.incidents))
    for what, minutes in account.minutes.most_common():
        print(f"{minutes / 60:9.1f} h  {what}")
    print(f"unaccounted minutes: {len(account.unaccounted)}, lamp rules broken: {len(account.sins)}, nights: {nights}")
    for line in [*account.unaccounted[:20], *account.sins[:20]]:
        print(line)
    return not (account.unaccounted or account.sins or nights)


def main() -> int:
    days = float(sys.argv[1]) if len(sys.argv) > 1 else 90.0
    seed = int(sys.argv[2]) if len(sys.argv) > 2 else 1
    held = [report(days, start, seed) for start in STARTS]
    return 0 if all(held) else 1


if __name__ == "__main__":
    sys.exit(main())
