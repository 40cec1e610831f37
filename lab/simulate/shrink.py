"""A script that breaks a promise, shortened as long as it breaks the same one."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Final

from lab.simulate.incidents.script import Item
from lab.simulate.life import Life, Outcome
from lab.simulate.scheduler import DAY_S

MOST_TRIES: Final = 60


def shortened(
    outcome: Outcome, *, within_s: float = 300.0, said: Callable[[str], object] = lambda text: None
) -> Outcome:
    """The shortest life found that breaks the same promise: what happened after it is left out, then half of the rest,
    a quarter, and so on (delta debugging). ``within_s``: seconds of this computer that it may take.
    """
    ends_s = time.monotonic() + within_s
    best, tries = outcome, 0

    def breaks(items: Sequence[Item]) -> bool:
        nonlocal best, tries
        tries += 1
        found = Life(outcome.seed, min(outcome.days, best.at_s / DAY_S + 0.5), items, outcome.place).live()
        if found.broken == outcome.broken:
            best = found
            said(f"{len(items)} things, {found.at_s / DAY_S:.2f} days")
        return found.broken == outcome.broken

    items = [item for item in outcome.items if item.at_s <= outcome.at_s]
    breaks(items)
    parts = 2
    while len(items) > 1 and tries < MOST_TRIES and time.monotonic() < ends_s:
        size = -(-len(items) // parts)
        for begin in range(0, len(items), size):
            left = items[:begin] + items[begin + size :]
            if breaks(left):
                items, parts = left, max(2, parts - 1)
                break
            if tries >= MOST_TRIES or time.monotonic() > ends_s:
                break
        else:
            if size == 1:
                break
            parts = min(2 * parts, len(items))
    return best
