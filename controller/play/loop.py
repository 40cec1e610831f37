"""The player's one loop: whole sets of frames become visible at their deadlines; of a list, one appearance after the
other.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from itertools import islice
from pathlib import Path
from typing import Any, Final, Self

from controller.bundle.format import PlaylistEntry
from controller.bundle.live_maps import LiveMaps
from controller.bundle.reader import Bundle
from controller.bundle.signing import Trust, unsigned_warning
from controller.core.errors import BundleError, UsageError
from controller.play.cache import DecodedAhead, check_fits
from controller.play.control.notify import Notifier, log
from controller.play.display.outputs import Output, dimmed
from controller.play.frames import FrameSet, OutputSize
from controller.play.live_stream import LiveStream, open_live
from controller.play.presenting import Grid, PendingPresentation, Presenter, ResultCallback
from hal.codecs import player as player_codec


class Playlist:
    """Steps through (appearance, seconds, fade_s) items, ``repeat`` times, or without end if 0.

    ``first_fade_s``: how long the first item comes in at the very beginning, None: as it says.
    """

    def __init__(
        self, items: Sequence[tuple[str, float, float]], repeat: int, first_fade_s: float | None = None
    ) -> None:
        self._items = tuple(items)
        self._first_fade_s = first_fade_s
        self._rounds_left = repeat if repeat else None
        self._at = 0
        self.look_ahead = 2

    @classmethod
    def suggested(cls, hints: Sequence[PlaylistEntry], repeat: int) -> Self:
        """What a bundle suggests. Raises BundleError("bundle-no-schedule") if that is nothing."""
        if not hints:
            raise BundleError(
                "bundle-no-schedule",
                what="The bundle contains no playlist.",
                remedy="Name the appearances to play, or publish the bundle again with a playlist.",
            )
        return cls([(hint.appearance, hint.duration_ms / 1000, hint.fade_ms / 1000) for hint in hints], repeat)

    @property
    def names(self) -> frozenset[str]:
        return frozenset(name for name, _, _ in self._items)

    @property
    def appearance(self) -> str:
        """The item that is to be presented, or is."""
        return self._items[self._at][0]

    @property
    def seconds(self) -> float:
        """How long it stays, its cross-fade included."""
        return self._items[self._at][1]

    @property
    def fade_s(self) -> float:
        """Seconds for which it fades in over the previous one; 0: at once."""
        return self._items[self._at][2] if self._first_fade_s is None else self._first_fade_s

    @property
    def upcoming(self) -> list[str]:
        """This item's appearance and the different ones that follow it, at most ``look_ahead`` in all."""
        ordered = (self._items[(self._at + step) % len(self._items)][0] for step in range(len(self._items)))
        return list(islice(dict.fromkeys(ordered), self.look_ahead))

    def has_others(self, appearance: str | None) -> bool:
        return bool(self.names - {appearance})

    def advance(self) -> bool:
        """Go to the next item; False when there is none."""
        self._first_fade_s = None
        if self._at + 1 < len(self._items):
            self._at += 1
            return True
        if self._rounds_left is not None:
            self._rounds_left -= 1
            if self._rounds_left <= 0:
                return False
        self._at = 0
        return True


_IDLE_S: Final = 0.1
_STATM: Final = Path("/proc/self/statm")
"""Created once: each Path interns its parts, and the table of interned strings grows after ten thousand of them."""
_DECODE_WAIT_S: Final = 0.02
_LIVE_WAIT_S: Final = 0.004


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
        self._notifier = Notifier()
        self._presenter = Presenter(output, sizes, rate_hz)
        self._black = self._presenter.shown
        self._decoded: DecodedAhead | None = None
        self._coming: PendingPresentation | None = None
        self._playlist: Playlist | None = None
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

    def stop(self, on_result: ResultCallback | None, *, fade_s: float = 0.0) -> None:
        """Show black."""
        self.show(self._black, on_result, showing="black", fade_s=fade_s)

    def show(
        self, frames: FrameSet, on_result: ResultCallback | None, *, showing: str = "pattern", fade_s: float = 0.0
    ) -> None:
        """Show these frames; they must not change while they are the ``shown`` ones, or will be."""
        self.withdraw()
        self._coming = PendingPresentation(showing, None, frames, self._presenter.soon(), on_result, fade_s)

    def play(
        self, playlist: Playlist, on_result: ResultCallback, *, rate_hz: float | None = None, brightness: float = 1.0
    ) -> None:
        """Play appearances in turn; ``on_result`` is called for the first. ``rate_hz``: the grid meanwhile;
        ``brightness``: the share of their light, 0..1.

        Raises BundleError if the bundle is missing or it has not all of them; then nothing changes.
        """
        self._on_asked()
        decoded = self._loaded()
        for name in playlist.names:
            decoded.bundle.index.appearance(name)
        self.withdraw()
        self._presenter.begin_sequence(rate_hz or self.rate_hz)
        self._playlist, self._brightness = playlist, brightness
        playlist.look_ahead = decoded.look_ahead
        self._make_coming(self._presenter.soon(), on_result)

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
        live, self._live = self._live, None
        coming, self._coming, self._playlist = self._coming, None, None
        if live is not None:
            self._presenter.shown = live.end() or self.shown
        self._presenter.grid = Grid(self.rate_hz)
        if coming is not None:
            self._presenter.freeze(coming)
            self._hold_shown()
        if coming is not None and coming.on_result is not None:
            coming.on_result(
                UsageError(
                    "superseded",
                    what="Another request came before this one was presented.",
                    remedy="Wait for the answer before you request the next picture, and let only one program send "
                    "requests.",
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
            if self._busy_with_bundle():
                self.withdraw()
            self._decoded.close()
        self._decoded = DecodedAhead(bundle, self.sizes, self._wake)
        self._warning = unsigned_warning(bundle.signed_by, self._trust)
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
            "rss_bytes": pages * os.sysconf("SC_PAGESIZE"),
        }

    # --- presenting ---------------------------------------------------------------------------------------------

    def _patience_s(self) -> float:
        """How long the loop may wait for requests before it must look again."""
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
            self._go_on(coming.tick + self._presenter.grid.ticks(self._playlist.seconds))
        else:
            self._playlist = None

    def _present_if_due(self, *, wait: bool = False) -> None:
        coming = self._coming
        if not self._take_frames() or coming is None or coming.frames is None:
            return
        before = self._presenter.last
        whole = self._presenter.present(coming, coming.frames, wait=wait)
        if self._presenter.last is not before:
            self._showing, self._appearance = coming.showing, coming.appearance
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
            self._go_on(coming.first_tick + self._presenter.grid.ticks(self._playlist.seconds))
        if coming.on_result is not None:
            coming.on_result(self._presenter.last)

    def _hold_shown(self) -> None:
        if self._decoded is not None:
            self._decoded.hold(self.shown)

    def _go_on(self, tick: int) -> None:
        """Make the next item of the sequence coming, no sooner than ``tick``; end the sequence after its last."""
        playlist = self._playlist
        if playlist is None or not playlist.advance():
            self._playlist = None
            return
        self._make_coming(tick, None)

    def _make_coming(self, tick: int, on_result: ResultCallback | None) -> None:
        assert self._decoded is not None
        assert self._playlist is not None
        self._decoded.want(self._playlist.upcoming)
        name, fade_s = self._playlist.appearance, self._playlist.fade_s
        self._coming = PendingPresentation("appearance", name, None, tick, on_result, fade_s, paced=True)
