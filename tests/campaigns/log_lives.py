"""Lives of a kiosk whose event log has one incident after the other: none violates an invariant.

    python -m tests.campaigns.log_lives [COUNT] [SEED]

The usual lives damage the log now and then, among much else. Here it is damaged several times within minutes or hours,
while the disk is full and the program is killed. Ends with 1, and prints the shortest
scenario of each life that violated an invariant.
"""

from __future__ import annotations

import random
import sys
import time

from lab.simulate.life import Life, Outcome
from lab.simulate.scenarios.scenario import Incident
from lab.simulate.scheduler import DAY_S
from tests.campaigns.simulate import report_violations

LOG = "kiosk/events.sqlite"
DAMAGE = {"cut": 1, "flipped": 2, "block": 3, "half": 2, "zeros": 4, "empty": 1, "removed": 1}
TROUBLES = {"damaged": 2, "full": 2, "killed": 1, "killed while writing": 1, "restarted": 1, "used": 2}
FIRST_S = 20_000.0


def troubles(seed: str) -> list[Incident]:
    """The incidents of the log in the life of this seed."""
    rng, at_s, incidents = random.Random(seed), FIRST_S, list[Incident]()
    for _ in range(rng.randint(5, 14)):
        at_s += rng.choice([rng.uniform(0, 3), rng.uniform(3, 120), rng.uniform(100, 3000)])
        incidents.append(_trouble(rng, at_s))
    # nothing may be missing at the end, after one more kill either
    return [*incidents, Incident(at_s + 2000, "command", "next"), Incident(at_s + 2100, "killed")]


def log_life(seed: str) -> Outcome:
    """The life of this seed."""
    incidents = troubles(seed)
    return Life(seed, (incidents[-1].at_s + 200) / DAY_S, incidents).run()


def _trouble(rng: random.Random, at_s: float) -> Incident:
    what = rng.choices(list(TROUBLES), list(TROUBLES.values()))[0]
    if what == "damaged":
        how = rng.choices(list(DAMAGE), list(DAMAGE.values()))[0]
        while_ = rng.choice(["stopped", "stopped", "", "power cut"])
        return Incident(at_s, "file damaged", LOG, how, magnitude=rng.uniform(0, 2), arguments=while_)
    if what == "full":
        return Incident(at_s, "disk full", duration_s=rng.choice([rng.uniform(1, 15), rng.uniform(15, 900)]))
    if what == "killed while writing":
        return Incident(at_s, what, magnitude=rng.randint(1, 40))
    if what == "restarted":
        return Incident(at_s, what, variant=rng.choice(["lamps off", "lamps stay lit"]))
    return Incident(at_s, "killed") if what == "killed" else Incident(at_s, "command", "next")


def main() -> int:
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 100
    name = sys.argv[2] if len(sys.argv) > 2 else str(int(time.time()))
    began_s = time.process_time()
    print(f"seed {name}")
    _, failed = report_violations(log_life(f"{name}-{number}") for number in range(count))
    print(f"{count} lives, {failed} broken invariants, {time.process_time() - began_s:.0f} s of a core")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
