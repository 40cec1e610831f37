"""Makes sets of frames visible at their deadlines, and knows how evenly that went."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Final

from controller.play.display.mixing import mix_sets
from controller.play.display.outputs import Output
from controller.play.frames import FrameSet, OutputSize
from controller.play.pacing import Grid, Intervals, sleep_until
from controller.play.pending_presentation import PendingPresentation, PresentedSet

_EARLY_S: Final = 0.0005
_FORGET: Final = 0.9
_FORGET_PACED: Final = 0.9995
"""Decay of a slow preparation's estimate after each picture: one slow picture in a hundred must not come late."""


class Presenter:
    """One ``Output`` on the grid of ``rate_hz``. It reads only the monotonic clock, which can't be set.

    ``shown`` is the set on the outputs (the one before, while another fades in over it); ``last`` counts the sets.
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

    def begin_sequence(self, rate_hz: float) -> None:
        """Pictures come on this grid from now on; the count restarts."""
        self.grid, self.intervals, self.late = Grid(rate_hz), Intervals(), 0

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
        # of its own that is a long while: to begin too early costs nothing, where somebody waits it costs a tick.
        took_s = time.monotonic() - began_s
        self._prepare_s = min(max(took_s, _FORGET * self._prepare_s), tick_s)
        self._slowest_s = min(max(took_s, _FORGET_PACED * self._slowest_s), tick_s)
        sleep_until(due_s)
        if time.monotonic() > due_s + tick_s and coming.share == 0:
            # One that somebody waits for is due when it comes; one that follows another has a time of its own.
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
