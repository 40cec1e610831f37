"""Progress of a run: what a reporter is told, and how the time left is estimated. Nothing here draws anything."""

from __future__ import annotations

import enum
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol


class Phase(enum.Enum):
    """Where a step stands."""

    RUNNING = "running"
    DONE = "done"
    SKIPPED = "skipped"


class Level(enum.Enum):
    """How much a message matters."""

    INFO = "info"
    WARNING = "warning"
    ERROR = "error"


@dataclass(frozen=True, slots=True)
class Progress:
    """How far a run has come.

    ``step`` the step's title; ``index`` its place, from 0, among ``count``; ``fraction`` of the whole run by weight and
    ``step_fraction`` of this step, both 0..1; ``elapsed_s`` since the run began; ``left_s`` None until it can be told;
    ``note`` what is being done inside the step, or empty
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


class Reporter(Protocol):
    """Whoever shows progress to a person or a machine. May be called from any thread."""

    def progress(self, now: Progress) -> None: ...

    def say(self, text: str, level: Level = Level.INFO) -> None:
        """One sentence. ``text`` may hold what a device said: the reporter escapes it."""


class Silent:
    """A reporter that shows nothing."""

    def progress(self, now: Progress) -> None:
        """Shows nothing."""

    def say(self, text: str, level: Level = Level.INFO) -> None:
        """Shows nothing."""


class Tracker:
    """Turns steps done into ``Progress``; the rate is measured on the steps that really ran.

    Parameters
    ----------
    weights : expected relative cost of each step, > 0 (seconds on the reference machine make the best weights)
    clock : seconds on a clock that never runs backwards
    """

    def __init__(
        self,
        titles: Sequence[str],
        weights: Sequence[float],
        reporter: Reporter,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        if len(titles) != len(weights) or any(not weight > 0 for weight in weights):
            raise ValueError("every step needs a title and a weight above zero")
        self._titles, self._weights = tuple(titles), tuple(weights)
        self._reporter, self._clock = reporter, clock
        self._began_s = clock()
        self._passed = 0.0
        self._worked, self._worked_s = 0.0, 0.0
        self._index, self._step_began_s, self._step_fraction = 0, self._began_s, 0.0

    def begin(self, index: int) -> None:
        """Step ``index`` starts to run."""
        self._index, self._step_began_s, self._step_fraction = index, self._clock(), 0.0
        self._tell(Phase.RUNNING)

    def advance(self, step_fraction: float, note: str = "") -> None:
        """The present step has come this far (0..1); a fraction below the last one is held at the last."""
        self._step_fraction = min(1.0, max(step_fraction, self._step_fraction))
        self._tell(Phase.RUNNING, note)

    def end(self) -> None:
        """The present step is done."""
        self._worked += self._weights[self._index]
        self._worked_s += self._clock() - self._step_began_s
        self._close(Phase.DONE)

    def skip(self, index: int) -> None:
        """Step ``index`` was done by an earlier run; it costs nothing and says nothing about the rate."""
        self._index = index
        self._close(Phase.SKIPPED)

    def _close(self, phase: Phase) -> None:
        self._passed += self._weights[self._index]
        self._step_fraction = 0.0
        self._tell(phase)

    def _tell(self, phase: Phase, note: str = "") -> None:
        now_s, total = self._clock(), sum(self._weights)
        running = self._weights[self._index] * self._step_fraction
        fraction = min(1.0, (self._passed + running) / total)
        worked_s = self._worked_s + (now_s - self._step_began_s if phase is Phase.RUNNING else 0.0)
        worked = self._worked + running
        left_s = worked_s / worked * (total - self._passed - running) if worked > 0 else None
        self._reporter.progress(
            Progress(
                step=self._titles[self._index],
                index=self._index,
                count=len(self._titles),
                phase=phase,
                fraction=fraction,
                step_fraction=self._step_fraction if phase is Phase.RUNNING else 1.0,
                elapsed_s=now_s - self._began_s,
                left_s=None if left_s is None else max(0.0, left_s),
                note=note,
            )
        )
