"""What the schedule wants now: a pure function of the clock, the schedule and the finished tasks.

Open or closed is a level, not an event, so no change can be missed. A task that runs once (the nightly check) has a key
with its date. The key is recorded when the task was done or skipped, so no task runs twice.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from datetime import date, timedelta
from functools import lru_cache
from operator import itemgetter
from typing import Final

from controller.kiosk.schedule import Opening, always_open, local_day, moment, openings, zone_of
from controller.kiosk.state import NextEvent
from controller.kiosk.values import Schedule

EARLIEST_S: Final = 1_735_689_600.0
"""2025-01-01: an earlier clock was never set."""
HOLD_S: Final = 2 * 3600.0
"""For a clock that was set back by at most this, the kiosk's time waits until the clock has caught up."""
DOUBT_S: Final = 36 * 3600.0
"""An unsynchronised clock that is further back than this was lost, not set."""
WINDOW_S: Final = 6 * 3600.0
"""A nightly check that could not start within this time is skipped."""
LOOK_BACK_DAYS: Final = 3


@dataclass(frozen=True, slots=True)
class Task:
    """A task that runs once: ``what`` is "drift check"; it may start from ``begins_s`` until ``ends_s``."""

    key: str
    what: str
    begins_s: float
    ends_s: float


@dataclass(frozen=True, slots=True)
class Plan:
    """``open`` None: the time is unknown. ``due`` tasks can start now; ``expired`` ones are too late and were not done.

    ``changes_s``: when ``open`` changes next (Unix seconds); None if no change is planned.
    """

    open: bool | None
    appearance: str = ""
    due: tuple[Task, ...] = ()
    expired: tuple[Task, ...] = ()
    next: NextEvent | None = None
    changes_s: float | None = None


def believed(now_s: float, latest_s: float | None, *, synchronised: bool) -> float | None:
    """The time to plan with, from the clock and the latest time that was trusted; None if it is unknown."""
    if now_s < EARLIEST_S:
        return None
    if latest_s is None or now_s >= latest_s:
        return now_s
    if latest_s - now_s <= HOLD_S:
        return latest_s
    return now_s if synchronised or latest_s - now_s <= DOUBT_S else None


def plan(now_s: float | None, schedule: Schedule, done: Collection[str], *, since_s: float) -> Plan:
    """What is wanted at ``now_s`` (as ``believed``). ``since_s``: when this stage first knew the time."""
    if always_open(schedule):
        due, expired = _tasks(now_s, schedule, done, since_s) if now_s is not None else ((), ())
        return Plan(True, due=due, expired=expired)
    if now_s is None:
        return Plan(None)
    known = openings(schedule, now_s)
    present = [opening for opening in known if opening.begins_s <= now_s < opening.ends_s]
    due, expired = _tasks(now_s, schedule, done, since_s)
    appearance, times = present[-1].appearance if present else "", merged(tuple(known))
    return Plan(bool(present), appearance, due, expired, _next(times, now_s, schedule), _changes_s(times, now_s))


@lru_cache(maxsize=8)
def merged(known: tuple[Opening, ...]) -> tuple[Opening, ...]:
    """Without overlaps: the times at which the stage really opens and closes."""
    result: list[Opening] = []
    for opening in known:
        if result and opening.begins_s <= result[-1].ends_s:
            result[-1] = Opening(result[-1].begins_s, max(result[-1].ends_s, opening.ends_s))
        else:
            result.append(opening)
    return tuple(result)


def _changes_s(times: Sequence[Opening], now_s: float) -> float | None:
    edges = (edge for opening in times for edge in (opening.begins_s, opening.ends_s))
    return min((edge for edge in edges if edge > now_s), default=None)


def _next(times: Sequence[Opening], now_s: float, schedule: Schedule) -> NextEvent | None:
    upcoming = [("opens", opening.begins_s) for opening in times]
    upcoming += [("closes", opening.ends_s) for opening in times]
    upcoming += [(task.what, task.begins_s) for task in _all_tasks(now_s, schedule)]
    soonest = min((one for one in upcoming if one[1] > now_s), key=itemgetter(1), default=None)
    return None if soonest is None else NextEvent(*soonest)


def _all_tasks(now_s: float, schedule: Schedule) -> tuple[Task, ...]:
    if not schedule.drift_check:
        return ()
    return _checks(schedule.drift_check, schedule.time_zone, local_day(now_s, zone_of(schedule.time_zone)))


@lru_cache(maxsize=8)
def _checks(clock: str, zone: str, today: date) -> tuple[Task, ...]:
    tasks = []
    for number in range(-LOOK_BACK_DAYS, 2):
        day = today + timedelta(days=number)
        begins_s = moment(day, clock, zone_of(zone))
        tasks.append(Task(f"drift-check {day.isoformat()}", "drift check", begins_s, begins_s + WINDOW_S))
    return tuple(tasks)


def _tasks(
    now_s: float, schedule: Schedule, done: Collection[str], since_s: float
) -> tuple[tuple[Task, ...], tuple[Task, ...]]:
    left = [task for task in _all_tasks(now_s, schedule) if task.key not in done and task.begins_s >= since_s]
    due = tuple(task for task in left if task.begins_s <= now_s < task.ends_s)
    return due, tuple(task for task in left if task.ends_s <= now_s)
