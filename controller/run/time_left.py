"""How long a run still takes: from what its steps took in the last runs, and from how fast this one is."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

KNOWN_SHARE: Final = 0.1
"""The share of a run's work after which its own speed tells how long the rest takes, where no run was measured."""
PRIOR_SHARE: Final = 0.3
"""With measured durations, the own speed counts for half once that share of the work is done."""
RISE: Final = 1.2
"""An estimate that rises by more than a fifth has to say why."""
SLACK_S: Final = 1.0


def expected(weights: Sequence[float], seconds: Sequence[float | None]) -> tuple[list[float], bool]:
    """What each step will take in seconds, and whether most of that was measured; else the weights as they are.

    A step that was never measured takes its weight at the pace of the others.
    """
    known = [(weight, took) for weight, took in zip(weights, seconds, strict=True) if took is not None]
    if not known or sum(weight for weight, _ in known) < sum(weights) / 2:
        return list(weights), False
    pace = sum(took for _, took in known) / sum(weight for weight, _ in known)
    return [weight * pace if took is None else took for weight, took in zip(weights, seconds, strict=True)], True


class TimeLeft:
    """The estimate, again and again. ``costs``: of all steps; ``in_seconds``: whether they are measured seconds."""

    def __init__(self, costs: Sequence[float], *, in_seconds: bool) -> None:
        self._total, self._in_seconds = sum(costs), in_seconds
        self._least = float("inf")
        self.reason = ""

    def now(self, *, worked: float, worked_s: float, left: float, title: str) -> float | None:
        """Seconds, or None until it can be estimated.

        ``worked``: the cost of what this run did in ``worked_s`` seconds; ``left``: the cost of the rest. ``reason``
        says why it is more than a fifth above the least that was shown, as long as it is.
        """
        found = self._found(worked, worked_s, left)
        if found is None:
            return None
        if found > RISE * self._least + SLACK_S:
            # The first step that made it rise stays the reason.
            than = "in the last runs" if self._in_seconds else "expected"
            self.reason = self.reason or f"{title} takes longer than {than}."
        else:
            self.reason = ""
        self._least = min(self._least, found)
        return found

    def _found(self, worked: float, worked_s: float, left: float) -> float | None:
        if self._in_seconds:
            prior = PRIOR_SHARE * self._total
            return left * (worked_s + prior) / (worked + prior)
        if worked <= 0 or worked < KNOWN_SHARE * (worked + left):
            return None
        return left * worked_s / worked
