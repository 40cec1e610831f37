"""Progress of a run: the values for a reporter, and the estimate of the time left. Draws nothing."""

from __future__ import annotations

import enum
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, Protocol

from hal.notices import Level


class Phase(enum.Enum):
    """State of a step."""

    RUNNING = "running"
    DONE = "done"
    SKIPPED = "skipped"


@dataclass(frozen=True, slots=True)
class Progress:
    """Progress of a run.

    ``step`` the step's title; ``index`` its number, from 0, of ``count``; ``fraction`` of the whole run by weight and
    ``step_fraction`` of this step, both 0..1; ``elapsed_s`` since the start; ``left_s`` None until it can be estimated;
    ``note`` the present work inside the step, or empty; ``why``: why ``left_s`` rose by more than a fifth, or empty
    """

    step: str
    index: int
    count: int
    phase: Phase
    fraction: float
    step_fraction: float
    elapsed_s: float
    left_s: float | None
    note: str = ""
    why: str = ""


class Reporter(Protocol):
    """Shows progress to a person or a program. May be called from any thread."""

    def progress(self, now: Progress) -> None: ...

    def say(self, text: str, level: Level = Level.INFO) -> None:
        """Show one sentence. ``text`` may contain a device's text: the reporter escapes it."""


class Silent:
    """A reporter that shows nothing."""

    def progress(self, now: Progress) -> None:
        """Shows nothing."""

    def say(self, text: str, level: Level = Level.INFO) -> None:
        """Shows nothing."""


class Tracker:
    """Computes ``Progress`` from finished steps; the rate is measured on steps that really ran.

    Parameters
    ----------
    weights : expected relative cost of each step, > 0 (seconds on the reference machine make the best weights)
    clock : seconds on a monotonic clock
    measured : seconds that each step took in the last runs, where that is known
    """

    def __init__(
        self,
        titles: Sequence[str],
        weights: Sequence[float],
        reporter: Reporter,
        clock: Callable[[], float] = time.monotonic,
        measured: Sequence[float | None] = (),
    ) -> None:
        if len(titles) != len(weights) or any(not weight > 0 for weight in weights):
            raise ValueError("every step needs a title and a weight above zero")
        costs, in_seconds = expected(weights, measured or [None] * len(weights))
        self._titles, self._weights = tuple(titles), tuple(costs)
        self._time_left = TimeLeft(costs, in_seconds=in_seconds)
        self._reporter, self._clock = reporter, clock
        self._began_s = clock()
        self._passed = 0.0
        self._worked, self._worked_s = 0.0, 0.0
        self._index, self._step_began_s, self._step_fraction = 0, self._began_s, 0.0

    def begin(self, index: int) -> None:
        """Step ``index`` starts."""
        self._index, self._step_began_s, self._step_fraction = index, self._clock(), 0.0
        self._report(Phase.RUNNING)

    def advance(self, step_fraction: float, note: str = "") -> None:
        """Progress of the present step (0..1); it never decreases."""
        self._step_fraction = min(1.0, max(step_fraction, self._step_fraction))
        self._report(Phase.RUNNING, note)

    def end(self) -> None:
        """The present step is done."""
        self._worked += self._weights[self._index]
        self._worked_s += self._clock() - self._step_began_s
        self._close(Phase.DONE)

    def done_beside(self, index: int) -> None:
        """Step ``index`` was done beside others, which took the time."""
        self._index = index
        self._worked += self._weights[index]
        self._close(Phase.DONE)

    def skip(self, index: int) -> None:
        """Step ``index`` was done by an earlier run; it does not count for the rate."""
        self._index = index
        self._close(Phase.SKIPPED)

    def _close(self, phase: Phase) -> None:
        self._passed += self._weights[self._index]
        self._step_fraction = 0.0
        self._report(phase)

    def _report(self, phase: Phase, note: str = "") -> None:
        now_s, total = self._clock(), sum(self._weights)
        running = self._weights[self._index] * self._step_fraction
        fraction = min(1.0, (self._passed + running) / total)
        worked_s = self._worked_s + (now_s - self._step_began_s if phase is Phase.RUNNING else 0.0)
        worked = self._worked + running
        left_s = self._time_left.now(
            worked=worked,
            worked_s=worked_s,
            left=max(0.0, total - self._passed - running),
            title=self._titles[self._index],
        )
        self._reporter.progress(
            Progress(
                step=self._titles[self._index],
                index=self._index,
                count=len(self._titles),
                phase=phase,
                fraction=fraction,
                step_fraction=self._step_fraction if phase is Phase.RUNNING else 1.0,
                elapsed_s=now_s - self._began_s,
                left_s=left_s,
                note=note,
                why=self._time_left.reason,
            )
        )


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
