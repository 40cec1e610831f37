"""The player's one loop: whole sets of frames become visible at their deadlines; of a list, one appearance after the
other.
"""

from __future__ import annotations

import os
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final

from controller.bundle.live_maps import LiveMaps
from controller.bundle.reader import Bundle
from controller.bundle.signing import Trust, unsigned_warning
from controller.core.errors import BundleError, UsageError
from controller.play.cache import DecodedAhead, check_fits
from controller.play.control.notify import Notifier, log
from controller.play.display.outputs import Output, dimmed
from controller.play.frames import FrameSet, OutputSize
from controller.play.live_stream import LiveStream, open_live
from controller.play.playlist import Playlist, Timetable
from controller.play.presenting import Agreed, Grid, PendingPresentation, Presenter, ResultCallback, superseded
from hal.codecs import player as player_codec

_IDLE_S: Final = 0.1
_STATM: Final = Path("/proc/self/statm")
"""Created once: each Path interns its parts, and the table of interned strings grows after ten thousand of them."""
_DECODE_WAIT_S: Final = 0.02
_LIVE_WAIT_S: Final = 0.004
_REPORTS: Final = 4096
"""So many presentations of schedules are remembered for those who compare them with other players'."""
_REORDERED_S: Final = 10.0
"""A moment that is earlier than the last one by less is of a request that was overtaken on its way."""
_REPORTS_AT_ONCE: Final = 1000


class Player:
    """Presents patterns and appearances on one ``Output``; patterns and appearances go the same way.

    ``serve`` waits at most so many seconds for requests and carries them out by calling the methods below, in the
    loop's own thread; ``wake`` ends its waiting and is called from the decoding thread. ``on_appearance`` is called
    once, when the first appearance is on the outputs; it must return at once. ``on_asked`` is called whenever
    appearances are asked for, before the bundle is read for them.
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
        on_asked: Callable[[], None] = lambda: None,
    ) -> None:
        self.sizes = tuple(sizes)
        self.rate_hz = rate_hz
        self._output, self._trust, self._wake = output, trust, wake
        self._on_appearance, self._on_asked = on_appearance, on_asked
        self.part = False
        """Whether bundles may have other outputs, too."""
        self._notifier = Notifier()
        self._presenter = Presenter(output, sizes, rate_hz)
        self._black = self._presenter.shown
        self._decoded: DecodedAhead | None = None
        self._coming: PendingPresentation | None = None
        self._playlist: Playlist | None = None
        self._timetable: Timetable | None = None
        self._agreed: Agreed | None = None
        self._agreed_at_s = 0.0
        self._ahead_s: float | None = None
        self._alone_at_s: float | None = None
        self._alone, self._alone_then = False, "on"
        self._reports: deque[list[Any]] = deque(maxlen=_REPORTS)
        self._live: LiveStream | None = None
        self._warning: BundleError | None = None
        self._skipped = 0
        self._showing = "black"
        self._appearance: str | None = None
        self._brightness = 1.0
        self._ending = False
        self._leaving = False

    def run(self, serve: Callable[[float], None], *, first: Callable[[], None] = lambda: None) -> None:
        """Show black, do what is to be done ``first``, serve until ``end`` is called, and leave black.

        After a player that left its picture, that picture stays until ``first`` has brought one.
        """
        if not self._output.continued:
            self.stop(None)
            self._present_if_due(wait=True)
        self._notifier.ready()
        first()
        while not self._ending:
            if self._output.continued and self._coming is None:
                self.stop(None)
            serve(self._patience_s())
            self._output.pump()
            self._take_live()
            if self._ahead_s is not None:
                self._keep_times()
            self._present_if_due()
            self._notifier.alive()
        self._notifier.stopping()
        if self._leaving:
            self._output.leave()
        else:
            self.stop(None)
            self._present_if_due(wait=True)
        if self._decoded is not None:
            self._decoded.close()

    # --- what may be asked for ----------------------------------------------------------------------------------

    def end(self, *, leaving: bool = False) -> None:
        """End soon, with black, or ``leaving`` the picture to the next player; a signal handler may call it."""
        self._ending, self._leaving = True, leaving

    def clock(self, ahead_s: float, keep_s: float | None, then: str) -> None:
        """The common clock is ``ahead_s`` ahead of the monotonic one. Without another call within ``keep_s`` this
        player is alone: ``then`` it continues ("on"), shows "black", or stays "still". None: it is never alone.
        """
        self._ahead_s = ahead_s
        self._alone_at_s = None if keep_s is None else time.monotonic() + keep_s
        self._alone, self._alone_then = False, then
        if self._timetable is not None:
            self._presenter.grid = Grid(self._presenter.grid.rate_hz, ahead_s)

    @property
    def ahead_s(self) -> float:
        """How far the common clock is ahead of the monotonic one. Raises UsageError("clock-unknown")."""
        if self._ahead_s is None:
            raise UsageError(
                "clock-unknown",
                what="A moment was given, but this player has not been given the common clock.",
                remedy="Send it with 'clock' first, as the agent of this computer does.",
            )
        return self._ahead_s

    def stop(self, on_result: ResultCallback | None, *, fade_s: float = 0.0, at_s: float | None = None) -> None:
        """Show black."""
        self.show(self._black, on_result, showing="black", fade_s=fade_s, at_s=at_s)

    def show(
        self,
        frames: FrameSet,
        on_result: ResultCallback | None,
        *,
        showing: str = "pattern",
        fade_s: float = 0.0,
        at_s: float | None = None,
    ) -> None:
        """Show these frames; they must not change while they are the ``shown`` ones, or will be. ``at_s``: when, on
        the common clock.
        """
        if at_s is not None:
            begin = partial(self._show, frames, on_result, showing, fade_s, at_s)
            self._agree(Agreed(at_s, begin, on_result))
            return
        self._show(frames, on_result, showing, fade_s)

    def _show(
        self,
        frames: FrameSet,
        on_result: ResultCallback | None,
        showing: str,
        fade_s: float,
        at_s: float | None = None,
    ) -> None:
        self.withdraw()
        self._coming = PendingPresentation(showing, None, frames, self._presenter.soon(), on_result, fade_s)
        if at_s is not None:
            grid = self._presenter.grid = Grid(self.rate_hz, self.ahead_s)
            self._coming.due_tick = grid.after(at_s - self.ahead_s)
            self._coming.tick = max(self._coming.due_tick, self._presenter.soon())

    def play(
        self,
        playlist: Playlist,
        on_result: ResultCallback,
        *,
        rate_hz: float | None = None,
        brightness: float = 1.0,
        at_s: float | None = None,
        bundle: Path | None = None,
    ) -> None:
        """Play appearances in turn; ``on_result`` is called for the first. ``rate_hz``: the grid meanwhile;
        ``brightness``: the share of their light, 0..1; ``at_s``: when the first is due on the common clock, all others
        follow by the same clock, and a player that comes later joins in; ``bundle``: which they are of, then.

        Raises BundleError if the bundle is missing or it has not all of them; then nothing changes.
        """
        self._on_asked()
        decoded = self._loaded() if bundle is None else self._opened(bundle)
        for name in playlist.names:
            decoded.bundle.index.appearance(name)
        playlist.look_ahead = decoded.look_ahead

        def begin() -> None:
            self.withdraw()
            if decoded is not self._decoded:
                self._use(decoded)
            self._presenter.begin_sequence(rate_hz or self.rate_hz, 0.0 if at_s is None else self.ahead_s)
            self._playlist, self._brightness = playlist, brightness
            if at_s is None:
                self._make_coming(self._presenter.soon(), on_result)
                return
            grid = self._presenter.grid
            self._timetable = playlist.starts(grid.after(at_s - self.ahead_s), grid.ticks)
            self._make_scheduled(self._timetable.number_at(self._now_tick), on_result)

        if at_s is None:
            begin()
            return
        if decoded is not self._decoded:
            decoded.want([playlist.appearance])
        self._agree(Agreed(at_s, begin, on_result, decoded, (playlist.appearance,)))

    def _agree(self, agreed: Agreed) -> None:
        _ = self.ahead_s
        if 0 < self._agreed_at_s - agreed.at_s < _REORDERED_S:
            raise superseded()
        self._agreed_at_s = agreed.at_s
        self._drop_agreed()
        self._agreed = agreed
        if self._playlist is not None and self._decoded is not None:
            self._decoded.want(self._wanted(self._playlist))

    def _drop_agreed(self) -> None:
        agreed, self._agreed = self._agreed, None
        if agreed is None:
            return
        if agreed.decoded is not None and agreed.decoded is not self._decoded:
            agreed.decoded.close()
        if agreed.on_result is not None:
            agreed.on_result(superseded())

    def live(self, path: Path, white: float | None) -> dict[str, Any]:
        """Show what is written to a frame file as it comes: finished frames, or with ``white`` targets.

        Returns what the request answers. Raises as ``open_live`` and ``LiveMaps.read``; then nothing changes.
        """
        maps = None if white is None else LiveMaps.read(self._loaded().bundle)
        stream = open_live(path, self._output, self.sizes, maps, white)
        self.withdraw()
        self._presenter.begin_sequence(self.rate_hz)
        self._live = stream
        return {"by": stream.by}

    def withdraw(self) -> None:
        """Present nothing more, keep the picture; pending requests get an error."""
        self._drop_agreed()
        live, self._live = self._live, None
        coming, self._coming, self._playlist, self._timetable = self._coming, None, None, None
        if live is not None:
            self._presenter.shown = live.end() or self.shown
        self._presenter.grid = Grid(self.rate_hz)
        if coming is not None:
            self._presenter.freeze(coming)
            self._hold_shown()
        if coming is not None and coming.on_result is not None:
            coming.on_result(superseded())

    def load_bundle(self, path: Path) -> None:
        """Use this bundle from now on; the picture stays until something is played. Raises BundleError."""
        self._use(self._opened(path))

    def _opened(self, path: Path) -> DecodedAhead:
        """The bundle of a file; of the loaded one, as it is. Raises BundleError."""
        bundle = Bundle.open_trusted(path, self._trust)
        try:
            check_fits(bundle, self.sizes, part=self.part)
        except BundleError:
            bundle.close()
            raise
        return DecodedAhead(bundle, self.sizes, self._wake)

    def _use(self, decoded: DecodedAhead) -> None:
        if self._decoded is not None:
            if self._busy_with_bundle():
                self.withdraw()
            self._decoded.close()
        self._decoded = decoded
        self._warning = unsigned_warning(decoded.bundle.signed_by, self._trust)
        if self._warning is not None:
            log(f"WARNING: {self._warning.what} {self._warning.remedy}")

    def _busy_with_bundle(self) -> bool:
        coming = self._coming is not None and self._coming.appearance is not None
        return coming or self._playlist is not None or self._live is not None

    def suggested(self, repeat: int) -> Playlist:
        """The playlist of the bundle. Raises BundleError("bundle-none" or "bundle-no-schedule")."""
        self._on_asked()
        return Playlist.suggested(self._loaded().bundle.index.schedule, repeat)

    def _loaded(self) -> DecodedAhead:
        if self._decoded is None:
            raise BundleError(
                "bundle-none",
                what="The player has no bundle to play.",
                remedy="Install one with 'velatura bundle install', or load one.",
            )
        return self._decoded

    @property
    def shown(self) -> FrameSet:
        """The set that is on the outputs, or is what the next picture fades from."""
        return self._presenter.shown

    @property
    def skipped(self) -> int:
        """Appearances that could not be decoded, since the start."""
        return self._skipped

    @property
    def bundle_identity(self) -> str | None:
        return None if self._decoded is None else self._decoded.bundle.identity

    def status(self) -> dict[str, Any]:
        """What the status request answers (docs/reference/player-protocol.md)."""
        presenter = self._presenter
        signed_by = None if self._decoded is None else self._decoded.bundle.signed_by
        pages = int(_STATM.read_text(encoding="ascii").split()[1])
        return {
            "sequence": presenter.last.sequence,
            "presented_at": presenter.last.at_s,
            "swaps": presenter.last.sequence,
            "showing": self._showing,
            "appearance": self._appearance,
            "brightness": self._brightness,
            "live": None if self._live is None else self._live.status(),
            "fading": self._coming is not None and self._coming.share > 0,
            "missing_outputs": list(self._output.missing()),
            "sequence_running": self._playlist is not None,
            "late": presenter.late,
            "skipped": self._skipped,
            "interval_p50_s": presenter.intervals.percentile(50),
            "interval_p99_s": presenter.intervals.percentile(99),
            "interval_longest_s": presenter.intervals.percentile(100),
            "bundle": self.bundle_identity,
            "signed_by": None if signed_by is None else signed_by.hex(),
            "warning": None if self._warning is None else player_codec.error_fields(self._warning),
            "reported": self._reports[-1][0] if self._reports else 0,
            "alone": self._alone,
            "rss_bytes": pages * os.sysconf("SC_PAGESIZE"),
        }

    # --- presenting ---------------------------------------------------------------------------------------------

    def device(self, host: str, call: Mapping[str, Any], on_result: ResultCallback) -> bool:
        """Whether it reaches that computer's devices: a player alone reaches none."""
        return False

    def reports(self, after: int) -> list[list[Any]]:
        """What was presented by schedules: [count, due_s, at_s, appearance] each, of the common clock, the first of
        which is above ``after``; at most a thousand.
        """
        return [report for report in self._reports if report[0] > after][:_REPORTS_AT_ONCE]

    @property
    def _now_tick(self) -> int:
        """The tick that was last, whether or not it was met."""
        return self._presenter.grid.after(time.monotonic()) - 1

    def _keep_times(self) -> None:
        """What a common clock wants: begin what was agreed on, leave out what is over, and notice being alone."""
        now_s = time.monotonic()
        if self._alone_at_s is not None and now_s > self._alone_at_s:
            self._alone, self._alone_at_s = True, None
            log(f"This player has had no news of the common clock for too long. Its rule: {self._alone_then}.")
            if self._alone_then == "black":
                self.stop(None)
            elif self._alone_then == "still":
                self.withdraw()
        coming, agreed, table = self._coming, self._agreed, self._timetable
        grid = self._presenter.grid
        if agreed is not None:
            due_s = agreed.at_s - self.ahead_s
            first = coming is not None and grid.at_s(coming.tick) < due_s
            if not first or now_s > due_s - 0.5 / grid.rate_hz:
                self._agreed = None
                agreed.begin()
        elif table is not None and coming is not None and coming.share == 0:
            number = table.number_at(self._now_tick)
            if number > coming.number:
                self._presenter.late += number - coming.number
                self._make_scheduled(number, coming.on_result)

    def _patience_s(self) -> float:
        """How long the loop may wait for requests before it must look again."""
        waited_s = self._patience_for_pictures_s()
        if self._agreed is not None:
            due_s = self._agreed.at_s - self.ahead_s - 0.5 / self._presenter.grid.rate_hz
            waited_s = min(waited_s, max(0.0, due_s - time.monotonic()))
        return waited_s

    def _patience_for_pictures_s(self) -> float:
        if self._coming is None:
            idle_s = _IDLE_S if self._live is None else _LIVE_WAIT_S
            return min(idle_s, self._notifier.interval_s or idle_s)
        if not self._take_frames():
            return _DECODE_WAIT_S if self._coming is not None else 0.0
        return min(_IDLE_S, self._presenter.patience_s(self._coming))

    def _take_live(self) -> None:
        """Make the newest live picture coming; one that is not yet presented goes first."""
        if self._live is not None and self._coming is None:
            self._coming = self._live.coming(self._presenter.soon())

    def _take_frames(self) -> bool:
        """Whether the coming set has its frames; takes them from the cache once they are there."""
        coming = self._coming
        if coming is None or coming.frames is not None:
            return coming is not None
        assert self._decoded is not None
        assert coming.appearance is not None
        try:
            taken = self._decoded.take(coming.appearance)
            # The cache keeps the whole picture: another brightness may be asked for at any time.
            coming.frames = taken if taken is None or self._brightness >= 1 else dimmed(taken, self._brightness)
        except BundleError as error:
            self._skip(coming, error)
            return False
        return coming.frames is not None

    def _skip(self, coming: PendingPresentation, error: BundleError) -> None:
        """An appearance can't be decoded: say so, keep the picture, and continue with the next of a sequence."""
        self._skipped += 1
        self._coming = None
        if coming.on_result is not None:
            coming.on_result(error)
        if self._playlist is not None and self._playlist.has_others(coming.appearance):
            self._go_on(coming.tick + self._presenter.grid.ticks(self._playlist.seconds), coming.number)
        else:
            self._playlist = self._timetable = None

    def _present_if_due(self, *, wait: bool = False) -> None:
        coming = self._coming
        if not self._take_frames() or coming is None or coming.frames is None:
            return
        before, begins = self._presenter.last, coming.share == 0
        whole = self._presenter.present(coming, coming.frames, wait=wait)
        if self._presenter.last is not before:
            self._showing, self._appearance = coming.showing, coming.appearance
            if begins and coming.due_tick is not None:
                grid, last = self._presenter.grid, self._presenter.last
                due_s = grid.at_s(coming.due_tick) + grid.ahead_s
                self._reports.append([last.sequence, due_s, last.at_s + grid.ahead_s, coming.appearance])
        if whole:
            self._presented(coming)

    def _presented(self, coming: PendingPresentation) -> None:
        self._coming = None
        self._hold_shown()
        if self._live is not None:
            self._live.presented(self._presenter.last)
        if coming.appearance is not None and self._on_appearance is not None:
            self._on_appearance()
            self._on_appearance = None
        if self._playlist is not None:
            self._go_on(coming.first_tick + self._presenter.grid.ticks(self._playlist.seconds), coming.number)
        if coming.on_result is not None:
            coming.on_result(self._presenter.last)

    def _hold_shown(self) -> None:
        if self._decoded is not None:
            self._decoded.hold(self.shown)

    def _go_on(self, tick: int, number: int) -> None:
        """Make the item after ``number`` coming, no sooner than ``tick``, or as it is scheduled; end the sequence after
        its last.
        """
        if self._timetable is not None and number < self._timetable.last:
            self._make_scheduled(max(number + 1, self._timetable.number_at(self._now_tick)), None)
        elif self._timetable is None and self._playlist is not None and self._playlist.advance():
            self._make_coming(tick, None)
        else:
            self._playlist = self._timetable = None

    def _make_scheduled(self, number: int, on_result: ResultCallback | None) -> None:
        """Make the item of this number coming, at its time, or at once if that has passed."""
        assert self._timetable is not None
        assert self._playlist is not None
        self._playlist.seek(number)
        tick = self._timetable.start(number)
        coming = self._make_coming(tick, on_result)
        coming.due_tick, coming.number = tick, number

    def _make_coming(self, tick: int, on_result: ResultCallback | None) -> PendingPresentation:
        assert self._decoded is not None
        assert self._playlist is not None
        self._decoded.want(self._wanted(self._playlist))
        name, fade_s = self._playlist.appearance, self._playlist.fade_s
        self._coming = PendingPresentation("appearance", name, None, tick, on_result, fade_s, paced=True)
        return self._coming

    def _wanted(self, playlist: Playlist) -> list[str]:
        """What is decoded ahead: the first picture of what was agreed on is among it, whatever comes before."""
        agreed = self._agreed
        if agreed is None or agreed.decoded is not self._decoded:
            return playlist.upcoming
        return [*playlist.upcoming[: max(1, playlist.look_ahead - 1)], *agreed.names]
