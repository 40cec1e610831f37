"""Lives of a kiosk in which one thing after the other happens to its event log: whatever it is, no promise is broken.

    python -m tests.campaigns.log_lives [COUNT] [SEED]

The usual lives damage the log now and then, among much else. Here it is damaged several times within minutes or hours,
while the disk is full and the program is killed. Ends with 1 and the shortest script of each life that broke a promise.
"""

from __future__ import annotations

import random
import sys
import time

from lab.simulate.incidents.script import Item
from lab.simulate.life import Life, Outcome
from lab.simulate.scheduler import DAY_S
from tests.campaigns.simulate import judged

LOG = "kiosk/events.sqlite"
DAMAGE = {"cut": 1, "flipped": 2, "block": 3, "half": 2, "zeros": 4, "empty": 1, "removed": 1}
TROUBLES = {"damaged": 2, "full": 2, "killed": 1, "killed while writing": 1, "restarted": 1, "used": 2}
FIRST_S = 20_000.0


def troubles(seed: str) -> list[Item]:
    """What happens to the log in the life of this seed."""
    chance, at_s, items = random.Random(seed), FIRST_S, list[Item]()
    for _ in range(chance.randint(5, 14)):
        at_s += chance.choice([chance.uniform(0, 3), chance.uniform(3, 120), chance.uniform(100, 3000)])
        items.append(_trouble(chance, at_s))
    # nothing may be missing at the end, after one more kill either
    return [*items, Item(at_s + 2000, "command", "next"), Item(at_s + 2100, "killed")]


def lived(seed: str) -> Outcome:
    """The life of this seed."""
    items = troubles(seed)
    return Life(seed, (items[-1].at_s + 200) / DAY_S, items).live()


def _trouble(chance: random.Random, at_s: float) -> Item:
    what = chance.choices(list(TROUBLES), list(TROUBLES.values()))[0]
    if what == "damaged":
        how = chance.choices(list(DAMAGE), list(DAMAGE.values()))[0]
        while_ = chance.choice(["stopped", "stopped", "", "power cut"])
        return Item(at_s, "file damaged", LOG, how, number=chance.uniform(0, 2), arguments=while_)
    if what == "full":
        return Item(at_s, "disk full", for_s=chance.choice([chance.uniform(1, 15), chance.uniform(15, 900)]))
    if what == "killed while writing":
        return Item(at_s, what, number=chance.randint(1, 40))
    if what == "restarted":
        return Item(at_s, what, how=chance.choice(["lamps off", "lamps stay lit"]))
    return Item(at_s, "killed") if what == "killed" else Item(at_s, "command", "next")


def main() -> int:
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 100
    name = sys.argv[2] if len(sys.argv) > 2 else str(int(time.time()))
    began_s = time.process_time()
    print(f"seed {name}")
    _, failed = judged(lived(f"{name}-{number}") for number in range(count))
    print(f"{count} lives, {failed} broken promises, {time.process_time() - began_s:.0f} s of a core")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
