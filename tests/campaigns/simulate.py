"""Years of simulated kiosks, each life of another seed: ``python -m tests.campaigns.simulate [YEARS] [SEED]``."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable

from lab.simulate.life import Outcome
from lab.simulate.scheduler import DAY_S
from lab.simulate.simulation import YEAR_DAYS, lives, minimise


def report_violations(outcomes: Iterable[Outcome]) -> tuple[float, int]:
    """The days that were lived, and how many lives violated an invariant; their shortest scenarios are printed."""
    days, failed = 0.0, 0
    for outcome in outcomes:
        days += outcome.at_s / DAY_S
        if outcome.violated:
            failed += 1
            print(f"{outcome.violation} (seed {outcome.seed}, day {outcome.at_s / DAY_S:.3f})", flush=True)
            short = minimise(outcome)
            print("\n".join([*(incident.line for incident in short.incidents), *short.last]), flush=True)
    return days, failed


def main() -> int:
    years = float(sys.argv[1]) if len(sys.argv) > 1 else 1.0
    seed = int(sys.argv[2]) if len(sys.argv) > 2 else int(time.time())
    began_s = time.process_time()
    print(f"seed {seed}")
    days, failed = report_violations(lives(seed, years))
    hours = (time.process_time() - began_s) / 3600
    print(f"{days / YEAR_DAYS:.2f} years, {failed} broken invariants, {days / YEAR_DAYS / hours:.1f} years a core-hour")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
