"""Many lives, one after the other; the scenario of the first violation, shortened."""

from __future__ import annotations

import hashlib
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from controller.core.errors import WorkError
from controller.run.progress import Reporter
from hal.deadline import Cancelled
from hal.notices import Level
from lab.simulate.life import LIFE_DAYS, Life, Outcome
from lab.simulate.monitors.invariants import INVARIANTS
from lab.simulate.scenarios.scenario import Incident, to_json
from lab.simulate.scheduler import DAY_S

MOST_TRIES: Final = 60


def minimise(
    outcome: Outcome, *, within_s: float = 300.0, report: Callable[[str], object] = lambda text: None
) -> Outcome:
    """The shortest life found that violates the same invariant, by delta debugging: without the incidents after the
    violation, then without half of the rest, a quarter, and so on. ``within_s``: seconds of this computer for it.
    """
    ends_s = time.monotonic() + within_s
    best, tries = outcome, 0

    def violates(incidents: Sequence[Incident]) -> bool:
        nonlocal best, tries
        tries += 1
        found = Life(outcome.seed, min(outcome.days, best.at_s / DAY_S + 0.5), incidents, outcome.site).run()
        if found.violated == outcome.violated:
            best = found
            report(f"{len(incidents)} incidents, {found.at_s / DAY_S:.2f} days")
        return found.violated == outcome.violated

    incidents = [incident for incident in outcome.incidents if incident.at_s <= outcome.at_s]
    violates(incidents)
    parts = 2
    while len(incidents) > 1 and tries < MOST_TRIES and time.monotonic() < ends_s:
        size = -(-len(incidents) // parts)
        for begin in range(0, len(incidents), size):
            left = incidents[:begin] + incidents[begin + size :]
            if violates(left):
                incidents, parts = left, max(2, parts - 1)
                break
            if tries >= MOST_TRIES or time.monotonic() > ends_s:
                break
        else:
            if size == 1:
                break
            parts = min(2 * parts, len(incidents))
    return best


YEAR_DAYS: Final = 365.0


def lives(seed: int, years: float) -> Iterator[Outcome]:
    """The lives of a seed: as many as make up so many years."""
    left_days, number = years * YEAR_DAYS, 0
    while left_days > 1e-9:
        yield Life(f"{seed}-{number}", min(LIFE_DAYS, left_days)).run()
        left_days -= LIFE_DAYS
        number += 1


def simulate(
    *, seed: int, years: float, reporter: Reporter, cancel: threading.Event, keep: Path | None = None,
    minimise_s: float = 300.0,
) -> Mapping[str, Any]:  # fmt: skip
    """Live, and stop at the first violated invariant. ``keep``: the file for its shortened scenario.

    Raises WorkError("promise-broken"), and Cancelled after a life.
    """
    began_s, days, events, digest = time.process_time(), 0.0, 0, hashlib.sha256()
    for outcome in lives(seed, years):
        days += outcome.at_s / DAY_S
        events += outcome.events
        digest.update(outcome.digest.encode())
        if outcome.violated:
            _report(outcome, minimise_s, keep, reporter)
        if cancel.is_set():
            raise Cancelled
        reporter.say(f"{days / YEAR_DAYS:.2f} years, {events} events")
    took_s = max(1e-9, time.process_time() - began_s)
    return {
        "seed": seed, "years": round(days / YEAR_DAYS, 4), "events": events, "digest": digest.hexdigest(),
        "years_per_core_hour": round(days / YEAR_DAYS / took_s * 3600, 1),
    }  # fmt: skip


def _report(outcome: Outcome, minimise_s: float, keep: Path | None, reporter: Reporter) -> None:
    reporter.say(f"{outcome.violation} (seed {outcome.seed}, day {outcome.at_s / DAY_S:.3f})", Level.ERROR)
    short = minimise(outcome, within_s=minimise_s)
    for incident in short.incidents:
        reporter.say(incident.line)
    for line in short.last:
        reporter.say(line)
    if keep is not None:
        keep.write_text(to_json(short.site, short.incidents), "utf-8")
    raise WorkError(
        "promise-broken",
        what=f"An invariant was violated: {INVARIANTS[outcome.violated]} "
        f"(seed {short.seed}, day {short.at_s / DAY_S:.3f}: {short.violation})",
        remedy="Correct the kiosk's code, and keep the shortened scenario as a test.",
    )
