"""Makes sets of frames visible at their deadlines, and knows how evenly that went.

In it: the grid of moments at which pictures change, precise waiting, and what is presented next (a set of frames, or an
appearance once it is decoded, at once or faded in).
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, TypeAlias

import numpy as np

from controller.core.errors import UsageError, VelaturaError
from controller.play.cache import DecodedAhead
from controller.play.display.outputs import Output, mix_sets
from controller.play.frames import FrameSet, OutputSize

_SHORTEST_S: Final = 1e-5
_CLASS: Final = 5e-4
"""Logarithm of the ratio between the intervals of neighbouring classes."""
_CLASSES: Final = 58_000


class Grid:
    """Moments k / rate, k whole, on a clock that is ``ahead_s`` ahead of the monotonic one: deadlines that never drift.

    Moments are monotonic seconds. Players with one clock have the same ticks.
    """

    def __init__(self, rate_hz: float, ahead_s: float = 0.0) -> None:
        self.rate_hz, self.ahead_s = rate_hz, ahead_s

    def after(self, moment_s: float) -> int:
        """The first tick that is not before ``moment_s``."""
        return math.ceil((moment_s + self.ahead_s) * self.rate_hz)

    def at_s(self, tick: int) -> float:
        return tick / self.rate_hz - self.ahead_s

    def ticks(self, seconds: float) -> int:
        """How many ticks last about ``seconds``; at least one."""
        return max(1, round(seconds * self.rate_hz))


def sleep_until(moment_s: float) -> None:
    """Sleep until a monotonic moment; return at once if it has passed."""
    left_s = moment_s - time.monotonic()
    if left_s > 0:
        time.sleep(left_s)


class Intervals:
    """The intervals between presentations of one sequence, counted in classes of 0.05 % from 10 us to a year.

    However many there are, they take no more memory than these classes.
    """

    def __init__(self) -> None:
        # Written to, so that all of it is there from the beginning and nothing seems to grow later.
        self._counts = np.full(_CLASSES, 0, np.uint32)
        self._passed = np.full(_CLASSES, 0, np.uint64)
        self._last_s: float | None = None
        # A client may ask for the status ten thousand times a second, and adding up all classes takes 50 us.
        self._found: dict[float, float | None] = {}

    def presented(self, moment_s: float) -> None:
        if self._last_s is not None:
            self.add(moment_s - self._last_s)
        self._last_s = moment_s

    def add(self, seconds: float) -> None:
        ratio = max(seconds, _SHORTEST_S) / _SHORTEST_S
        self._counts[min(_CLASSES - 1, int(math.log(ratio) / _CLASS))] += 1
        self._found.clear()

    def percentile(self, percent: float) -> float | None:
        """The interval that ``percent`` of all do not exceed (nearest rank), or None before the second picture."""
        if percent not in self._found:
            self._found[percent] = self._percentile(percent)
        return self._found[percent]

    def _percentile(self, percent: float) -> float | None:
        passed = np.cumsum(self._counts, dtype=np.uint64, out=self._passed)
        if not passed[-1]:
            return None
        rank = max(1, math.ceil(percent / 100 * int(passed[-1])))
        return _SHORTEST_S * math.exp(_CLASS * (int(np.searchsorted(passed, rank)) + 0.5))


@dataclass(frozen=True, slots=True)
class PresentedSet:
    """A set became visible: the player's count of sets, and the moment in monotonic seconds."""

    sequence: int
    at_s: float


Outcome: TypeAlias = PresentedSet | VelaturaError | Mapping[str, Any]
ResultCallback: TypeAlias = Callable[[Outcome], None]
"""Called once with the result of a request: presented, or the reason why not."""


@dataclass(slots=True)
class PendingPresentation:
    """What is presented next, at a tick of the grid.

    ``frames`` None: the appearance is taken from the cache once it is decoded. ``fade_s``: it comes in over what is
    shown, in ``steps``, the first at ``begun_tick``; ``share`` of it is shown already. ``paced``: it is one of a
    sequence, whose intervals are measured. ``prepare``: makes the output ready where that does not take ``frames``.
    ``due_tick``: when it is due by a schedule, even if it begins later; None: its begin may be delayed. ``number``: of
    the schedule's pictures, from 0.
    """

    showing: str
    appearance: str | None
    frames: FrameSet | None
    tick: int
    on_result: ResultCallback | None
    fade_s: float = 0.0
    paced: bool = False
    prepare: Callable[[], None] | None = None
    begun_tick: int | None = None
    steps: int = 1
    share: float = 0.0
    due_tick: int | None = None
    number: int = 0

    def begin(self, steps: int) -> None:
        """The first step is presented at ``tick``, or was due before."""
        self.begun_tick, self.steps = self.tick if self.due_tick is None else self.due_tick, steps

    def delay(self, tick: int) -> None:
        """It begins at ``tick`` after all; the fade of one that is due by a schedule has begun without it."""
        self.tick = tick
        if self.begun_tick is not None and self.due_tick is None:
            self.begun_tick = tick

    def step(self, next_tick: int) -> bool:
        """Its step of ``tick`` is shown. Whether that was the last; else the next is not before ``next_tick``."""
        self.share = self.next_share
        if self.share >= 1:
            return True
        self.tick = min(self.first_tick + self.steps - 1, max(self.tick + 1, next_tick))
        return False

    @property
    def first_tick(self) -> int:
        """When its first step is or was presented."""
        return self.tick if self.begun_tick is None else self.begun_tick

    @property
    def next_share(self) -> float:
        """How much of it is shown at ``tick``: by the clock, so a slow machine leaves out steps and not time."""
        return 1.0 if self.begun_tick is None else min(1.0, (self.tick - self.begun_tick + 1) / self.steps)


@dataclass(frozen=True, slots=True, eq=False)
class Agreed:
    """What begins at a moment of the common clock; what is shown continues until then.

    ``decoded``: the bundle that it is of; ``names``: what has to be decoded before, of that.
    """

    at_s: float
    begin: Callable[[], None]
    on_result: ResultCallback | None
    decoded: DecodedAhead | None = None
    names: tuple[str, ...] = ()


def superseded() -> UsageError:
    return UsageError(
        "superseded",
        what="Another request came before this one was presented.",
        remedy="Wait for the answer before you request the next picture, and let only one program send requests.",
    )


_EARLY_S: Final = 0.0005
_FORGET: Final = 0.9
_FORGET_PACED: Final = 0.9995
"""Decay of a slow preparation's estimate after each picture: one slow picture in a hundred must not come late."""


class Presenter:
    """One ``Output`` on the grid of ``rate_hz``. It reads only the monotonic clock, which can't be set.

    ``shown`` is the set on the outputs (the previous one, while another fades in over it); ``last`` counts the sets.
    ``late`` counts what came more than a tick after its time, since ``begin_sequence``.
    """

    def __init__(self, output: Output, sizes: Sequence[OutputSize], rate_hz: float) -> None:
        self._output, self._sizes = output, tuple(sizes)
        self.shown = FrameSet.black(sizes)
        self.last = PresentedSet(0, 0.0)
        self.grid = Grid(rate_hz)
        self.intervals = Intervals()
        self.late = 0
        self._prepare_s = self._slowest_s = 0.0

    def begin_sequence(self, rate_hz: float, ahead_s: float = 0.0) -> None:
        """Pictures come on this grid from now on; the count restarts."""
        self.grid, self.intervals, self.late = Grid(rate_hz, ahead_s), Intervals(), 0

    def soon(self) -> int:
        """The first tick that can be met."""
        return self.grid.after(time.monotonic() + self._prepare_s)

    def patience_s(self, coming: PendingPresentation) -> float:
        """Seconds until the set must be prepared; negative if that has passed."""
        return self.grid.at_s(coming.tick) - self._slowest_s - _EARLY_S - time.monotonic()

    def present(self, coming: PendingPresentation, frames: FrameSet, *, wait: bool = False) -> bool:
        """Present the set, or the next step on its way in, if its time has come (or ``wait`` for it).

        Return whether the set itself is on the outputs now; it is ``shown`` then.
        """
        due_s, tick_s = self.grid.at_s(coming.tick), 1 / self.grid.rate_hz
        if not wait and time.monotonic() < due_s - self._slowest_s - 2 * _EARLY_S:
            return False
        began_s = time.monotonic()
        self._prepare(coming, frames)
        # Remember a slow preparation for a while, so that the next of its kind begins early enough. For what has a time
        # of its own that is a long while: to begin too early costs nothing, where a request waits it costs a tick.
        took_s = time.monotonic() - began_s
        self._prepare_s = min(max(took_s, _FORGET * self._prepare_s), tick_s)
        self._slowest_s = min(max(took_s, _FORGET_PACED * self._slowest_s), tick_s)
        sleep_until(due_s)
        if time.monotonic() > due_s + tick_s and coming.share == 0:
            # One that a request waits for is due when it comes; one that follows another has a time of its own.
            self.late += coming.paced and coming.on_result is None
            coming.delay(self.grid.after(time.monotonic()) - 1)
        self.last = PresentedSet(self.last.sequence + 1, self._output.flip())
        if coming.paced:
            self.intervals.presented(self.last.at_s)
        if not coming.step(self.grid.after(self.last.at_s + self._prepare_s)):
            return False
        self.shown = frames
        return True

    def _prepare(self, coming: PendingPresentation, frames: FrameSet) -> None:
        """Prepare the set itself, or the next step on its way in."""
        # Of a picture that another player has left nothing is known: a fade would begin with black.
        steps = 0 if self._output.continued else self.grid.ticks(coming.fade_s)
        if coming.begun_tick is None and steps > 1:
            self._output.load_fade(self.shown, frames)
            coming.begin(steps)
        if coming.prepare is not None:
            coming.prepare()
        elif coming.begun_tick is None:
            self._output.prepare(frames)
        else:
            self._output.mix(coming.next_share)

    def freeze(self, coming: PendingPresentation) -> None:
        """What is on the outputs of a set half faded in is what is ``shown`` from now on."""
        if coming.share > 0 and coming.frames is not None:
            mixture = FrameSet.black(self._sizes)
            mix_sets(self.shown, coming.frames, coming.share, mixture)
            self.shown = mixture
