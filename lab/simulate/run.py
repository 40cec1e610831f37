"""Many lives, one after the other, and what came of them."""

from __future__ import annotations

import hashlib
import threading
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from controller.core.errors import WorkError
from controller.run.progress import Reporter
from hal.deadline import Cancelled
from hal.notices import Level
from lab.simulate.incidents.script import to_json
from lab.simulate.judge.promises import PROMISES
from lab.simulate.life import LIFE_DAYS, Life, Outcome
from lab.simulate.scheduler import DAY_S
from lab.simulate.shrink import shortened

YEAR_DAYS: Final = 365.0


def lives(seed: int, years: float) -> Iterator[Outcome]:
    """The lives of a seed: as many as make up so many years."""
    left_days, number = years * YEAR_DAYS, 0
    while left_days > 1e-9:
        yield Life(f"{seed}-{number}", min(LIFE_DAYS, left_days)).live()
        left_days -= LIFE_DAYS
        number += 1


def simulate(
    *, seed: int, years: float, reporter: Reporter, cancel: threading.Event, keep: Path | None = None,
    shrink_s: float = 300.0,
) -> Mapping[str, Any]:  # fmt: skip
    """Live, and stop at the first broken promise. ``keep``: the file for its shortened script.

    Raises WorkError("promise-broken"), and Cancelled after a life.
    """
    began_s, days, events, digest = time.process_time(), 0.0, 0, hashlib.sha256()
    for outcome in lives(seed, years):
        days += outcome.at_s / DAY_S
        events += outcome.events
        digest.update(outcome.digest.encode())
        if outcome.broken:
            _report(outcome, shrink_s, keep, reporter)
        if cancel.is_set():
            raise Cancelled
        reporter.say(f"{days / YEAR_DAYS:.2f} years, {events} events")
    took_s = max(1e-9, time.process_time() - began_s)
    return {
        "seed": seed, "years": round(days / YEAR_DAYS, 4), "events": events, "digest": digest.hexdigest(),
        "years_per_core_hour": round(days / YEAR_DAYS / took_s * 3600, 1),
    }  # fmt: skip


def _report(outcome: Outcome, shrink_s: float, keep: Path | None, reporter: Reporter) -> None:
    reporter.say(f"{outcome.how} (seed {outcome.seed}, day {outcome.at_s / DAY_S:.3f})", Level.ERROR)
    short = shortened(outcome, within_s=shrink_s)
    for item in short.items:
        reporter.say(item.line)
    for line in short.last:
        reporter.say(line)
    if keep is not None:
        keep.write_text(to_json(short.place, short.items), "utf-8")
    raise WorkError(
        "promise-broken",
        what=f"A promise was broken: {PROMISES[outcome.broken]} (seed {short.seed}, day {short.at_s / DAY_S:.3f}: "
        f"{short.how})",
        remedy="Correct the kiosk's code, and keep the shortened script as a test.",
    )
