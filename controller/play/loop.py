"""The player's one loop: whole sets of frames become visible at their deadlines."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, TypeAlias

from controller.bundle.reader import Bundle
from controller.bundle.signing import Trust
from controller.errors import BundleError, UsageError, VelaturaError
from controller.play.cache import DecodedAhead, check_fits
from controller.play.frames import FrameSet, OutputSize
from controller.play.mixing import mix_sets
from controller.play.notify import Notifier
from controller.play.outputs import Output
from controller.play.pacing import Grid, Intervals, sleep_until
from controller.play.playlist import Playlist

_IDLE_S: Final = 0.1
_DECODE_WAIT_S: Final = 0.02
_EARLY_S: Final = 0.0005


@dataclass(frozen=True, slots=True)
class Presented:
    """A set became visible: the player's count of sets, and the moment in monotonic seconds."""

    sequence: int
    at_s: float


Told: TypeAlias = Callable[[Presented | VelaturaError], None]
"""Called once with what became of a request: presented, or why not."""


@dataclass(slots=True)
class _Coming:
    """What is presented next, at a tick of the grid.

    ``frames`` None: the appearance is taken from the cache once it is decoded. ``fade_s``: it comes in over what is
    shown, in ``steps``, the first at ``begun_tick``; ``share`` of it is shown already.
    """

    showing: str
    appearance: str | None
    frames: FrameSet | None
    tick: int
    told: Told | None
    fade_s: float = 0.0
    begun_tick: int | None = None
    steps: int = 1
    share: float = 0.0

    def begin(self, steps: int) -> None:
        """The first step is presented at ``tick``."""
        self.begun_tick, self.steps = self.tick, steps

    @property
    def next_share(self) -> float:
        """How much of it is shown at ``tick``: by the clock, so a slow machine leaves out steps and not time."""
        return 1.0 if self.begun_tick is None else min(1.0, (self.tick - self.begun_tick + 1) / self.steps)


class Player:
    """Presents patterns and appearances on one ``Output``; patterns and appearances go the same way.

    ``serve`` waits at most so many seconds for requests and carries them out by calling the methods below, in the
    loop's own thread; ``wake`` ends its waiting and is called from the decoding thread. ``on_appearance`` is called
    once, when the first appearance is on the outputs; it must return at once.
    """

    def __init__(
        self,
        output: Output,
        sizes: Sequence[OutputSize],
        *,
        rate_hz: float,
        trust: Trust,
        wake: Callable[[], None],
        on_appearance: Callable[[], None] | None = None,
    ) -> None:
        self.sizes = tuple(sizes)
        self.rate_hz = rate_hz
        self._output, self._trust, self._wake = output, trust, wake
        self._on_appearance = on_appearance
        self._notifier = Notifier()
        self._grid = Grid(rate_hz)
        self._black = self.shown = FrameSet.black(sizes)
        self._decoded: DecodedAhead | None = None
        self._coming: _Coming | None = None
        self._playlist: Playlist | None = None
        self._intervals = Intervals()
        self._prepare_s = 0.0
        self._last = Presented(0, 0.0)
        self._late = self._skipped = 0
        self._showing = "black"
        self._appearance: str | None = None
        self._ending = False

    def run(self, serve: Callable[[float], None], *, first: Callable[[], None] = lambda: None) -> None:
        """Show black, do what is to be done ``first``, serve until ``end`` is called, and leave black."""
        self.stop(None)
        self._present_if_due(wait=True)
        self._notifier.ready()
        first()
        while not self._ending:
            serve(self._patience_s())
            self._output.pump()
            self._present_if_due()
            self._notifier.alive()
        self._notifier.stopping()
        self.stop(None)
        self._present_if_due(wait=True)
        if self._decoded is not None:
            self._decoded.close()

    # --- what may be asked for ----------------------------------------------------------------------------------

    def end(self) -> None:
        """Show black and end soon; a signal handler may call it."""
        self._ending = True

    def stop(self, told: Told | None, *, fade_s: float = 0.0) -> None:
        """Show black."""
        self.show(self._black, told, showing="black", fade_s=fade_s)

    def show(self, frames: FrameSet, told: Told | None, *, showing: str = "pattern", fade_s: float = 0.0) -> None:
        """Show these frames; they must not change while they are the ``shown`` ones, or will be."""
        self.withdraw()
        self._coming = _Coming(showing, None, frames, self._soon(), told, fade_s)

    def play(self, playlist: Playlist, told: Told, *, rate_hz: float | None = None) -> None:
        """Play appearances in turn; ``told`` hears of the first. ``rate_hz``: the grid meanwhile.

        Raises BundleError if there is no bundle or it has not all of them; then nothing changes.
        """
        if self._decoded is None:
            raise BundleError(
                "bundle-none",
                what="The player has no bundle to play.",
                remedy="Install one with 'velatura bundle install', or load one.",
            )
        for name in playlist.names:
            self._decoded.bundle.index.appearance(name)
        self.withdraw()
        self._grid = Grid(rate_hz or self.rate_hz)
        self._playlist, self._intervals, self._late = playlist, Intervals(), 0
        playlist.look_ahead = self._decoded.look_ahead
        self._decoded.want(playlist.upcoming)
        self._coming = _Coming("appearance", playlist.appearance, None, self._soon(), told, playlist.fade_s)

    def withdraw(self) -> None:
        """Present nothing more, keep the picture; whoever waits for a presentation is told."""
        coming, self._coming, self._playlist = self._coming, None, None
        self._grid = Grid(self.rate_hz)
        if coming is not None and coming.share > 0 and coming.frames is not None:
            mixture = FrameSet.black(self.sizes)
            mix_sets(self.shown, coming.frames, coming.share, mixture)
            self._is_shown(mixture)
        if coming is not None and coming.told is not None:
            coming.told(
                UsageError(
                    "superseded",
                    what="Another request came before this one was presented.",
                    remedy="Wait for the answer before asking for the next picture; let only one program ask.",
                )
            )

    def load_bundle(self, path: Path) -> None:
        """Use this bundle from now on; the picture stays until something is played. Raises BundleError."""
        bundle = Bundle.open_trusted(path, self._trust)
        try:
            check_fits(bundle, self.sizes)
        except BundleError:
            bundle.close()
            raise
        if self._decoded is not None:
            if self._playlist is not None or (self._coming is not None and self._coming.appearance is not None):
                self.withdraw()
            self._decoded.close()
        self._decoded = DecodedAhead(bundle, self.sizes, self._wake)

    @property
    def skipped(self) -> int:
        """Appearances that could not be decoded, since the start."""
        return self._skipped

    @property
    def bundle_identity(self) -> str | None:
        return None if self._decoded is None else self._decoded.bundle.identity

    def status(self) -> dict[str, Any]:
        """What the status request answers (docs/player-protocol.md)."""
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
        return {
            "sequence": self._last.sequence,
            "presented_at": self._last.at_s,
            "swaps": self._last.sequence,
            "showing": self._showing,
            "appearance": self._appearance,
            "fading": self._coming is not None and self._coming.share > 0,
            "missing_outputs": list(self._output.missing()),
            "sequence_running": self._playlist is not None,
            "late": self._late,
            "skipped": self._skipped,
            "interval_p50_s": self._intervals.percentile(50),
            "interval_p99_s": self._intervals.percentile(99),
            "bundle": self.bundle_identity,
            "rss_bytes": pages * os.sysconf("SC_PAGESIZE"),
        }

    # --- presenting ---------------------------------------------------------------------------------------------

    def _soon(self) -> int:
        return self._grid.after(time.monotonic() + self._prepare_s)

    def _patience_s(self) -> float:
        """How long the loop may wait for requests before it must look again."""
        if self._coming is None:
            return min(_IDLE_S, self._notifier.interval_s or _IDLE_S)
        if not self._take_frames():
            return _DECODE_WAIT_S if self._coming is not None else 0.0
        return min(_IDLE_S, self._grid.at_s(self._coming.tick) - self._prepare_s - _EARLY_S - time.monotonic())

    def _take_frames(self) -> bool:
        """Whether the coming set has its frames; takes them from the cache once they are there."""
        coming = self._coming
        if coming is None or coming.frames is not None:
            return coming is not None
        assert self._decoded is not None
        assert coming.appearance is not None
        try:
            coming.frames = self._decoded.take(coming.appearance)
        except BundleError as error:
            self._skip(coming, error)
            return False
        return coming.frames is not None

    def _skip(self, coming: _Coming, error: BundleError) -> None:
        """An appearance can't be decoded: say so, keep the picture, and go on with the next of a sequence."""
        self._skipped += 1
        self._coming = None
        if coming.told is not None:
            coming.told(error)
        if self._playlist is not None and self._playlist.has_others(coming.appearance):
            self._go_on(coming.tick + self._grid.ticks(self._playlist.seconds))
        else:
            self._playlist = None

    def _present_if_due(self, *, wait: bool = False) -> None:
        if not self._take_frames() or self._coming is None or self._coming.frames is None:
            return
        coming, frames, tick_s = self._coming, self._coming.frames, 1 / self._grid.rate_hz
        due_s = self._grid.at_s(coming.tick)
        if not wait and time.monotonic() < due_s - self._prepare_s - 2 * _EARLY_S:
            return
        began_s = time.monotonic()
        self._prepare(coming, frames)
        # Remember a slow preparation for a while, so that the next of its kind begins early enough.
        self._prepare_s = min(max(time.monotonic() - began_s, 0.9 * self._prepare_s), tick_s)
        sleep_until(due_s)
        if time.monotonic() > due_s + tick_s and coming.share == 0:
            self._late += self._playlist is not None and coming.told is None
            coming.tick = self._grid.after(time.monotonic()) - 1
            coming.begun_tick = None if coming.begun_tick is None else coming.tick
        self._presented(coming, frames, self._output.flip())

    def _prepare(self, coming: _Coming, frames: FrameSet) -> None:
        """Prepare the set itself, or the next step on its way in."""
        steps = self._grid.ticks(coming.fade_s)
        if coming.begun_tick is None and steps > 1:
            self._output.load_fade(self.shown, frames)
            coming.begin(steps)
        if coming.begun_tick is None:
            self._output.prepare(frames)
        else:
            self._output.mix(coming.next_share)

    def _presented(self, coming: _Coming, frames: FrameSet, at_s: float) -> None:
        self._last = Presented(self._last.sequence + 1, at_s)
        self._showing, self._appearance = coming.showing, coming.appearance
        if self._playlist is not None:
            self._intervals.presented(at_s)
        coming.share = coming.next_share
        if coming.share < 1:
            last = (coming.begun_tick or 0) + coming.steps - 1
            coming.tick = min(last, max(coming.tick + 1, self._grid.after(at_s + self._prepare_s)))
            return
        self._coming = None
        self._is_shown(frames)
        if coming.appearance is not None and self._on_appearance is not None:
            self._on_appearance()
            self._on_appearance = None
        if self._playlist is not None:
            began = coming.tick if coming.begun_tick is None else coming.begun_tick
            self._go_on(began + self._grid.ticks(self._playlist.seconds))
        if coming.told is not None:
            coming.told(self._last)

    def _is_shown(self, frames: FrameSet) -> None:
        self.shown = frames
        if self._decoded is not None:
            self._decoded.hold(frames)

    def _go_on(self, tick: int) -> None:
        """Make the next item of the sequence coming, no sooner than ``tick``; end the sequence after its last."""
        playlist = self._playlist
        if playlist is None or not playlist.advance():
            self._playlist = None
            return
        assert self._decoded is not None
        self._decoded.want(playlist.upcoming)
        self._coming = _Coming("appearance", playlist.appearance, None, tick, None, playlist.fade_s)
