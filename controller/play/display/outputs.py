"""Where frames become visible. Every output shows whole sets: all projectors change in one flip, or none."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Final, Protocol

from controller.play.display.mixing import mix_sets, mixture_of
from controller.play.frames import FrameFile, FrameSet, OutputSize

_THREADS: Final = 2


class Output(Protocol):
    """All projector outputs together. Calibration patterns and appearances pass through the same two calls."""

    def prepare(self, frames: FrameSet) -> None:
        """Make the next set ready, so that ``flip`` has as little to do as the medium allows."""

    def load_fade(self, before: FrameSet, after: FrameSet) -> None:
        """Make ready for mixtures of two sets; both stay as they are until the next ``load_fade`` or ``prepare``."""

    def mix(self, share: float) -> None:
        """Prepare the mixture of the sets of the last ``load_fade``: ``share`` of ``after``, 1: exactly it."""

    def flip(self) -> float:
        """Make what was prepared visible on all outputs at once; return when it became so, in monotonic seconds.

        The set that ``prepare`` got is not needed any more after this.
        """

    @property
    def continued(self) -> bool:
        """Whether the picture of the player before is still visible: it has left it, and nothing was flipped since."""

    def leave(self) -> None:
        """Leave what is visible to the next player: it stays visible after ``close``."""

    def missing(self) -> tuple[str, ...]:
        """Names of outputs that are not there now, or not as they were at the start."""

    def pump(self) -> None:
        """Serve the window system, if there is one; repair what it has damaged of the visible set."""

    def close(self) -> None:
        """Release everything. What is visible may stay visible."""


class MemoryOutput:
    """Outputs in a mapped file, for machines without projectors (docs/reference/player-protocol.md, "Frame file")."""

    def __init__(self, path: Path, outputs: Sequence[OutputSize]) -> None:
        self._file = FrameFile(path, outputs)
        self._outputs = tuple(outputs)
        self._next: FrameSet | None = None
        self._fade: tuple[FrameSet, FrameSet] | None = None
        self._mixture: FrameSet | None = None
        self._pool = ThreadPoolExecutor(_THREADS, thread_name_prefix="mix")

    def prepare(self, frames: FrameSet) -> None:
        self._next, self._fade, self._mixture = frames, None, None

    def load_fade(self, before: FrameSet, after: FrameSet) -> None:
        self._fade = before, after
        self._mixture = mixture_of(before, after, self._outputs)

    def mix(self, share: float) -> None:
        assert self._fade is not None
        assert self._mixture is not None
        before, after = self._fade
        if share >= 1:
            self.prepare(after)
            return
        mix_sets(before, after, share, self._mixture, self._pool)
        self._next = self._mixture

    def flip(self) -> float:
        assert self._next is not None
        self._file.write(self._next, self._pool)
        self._next = None
        return self._file.presented_at

    @property
    def continued(self) -> bool:
        return False

    def leave(self) -> None:
        """The file stays as it is."""

    def missing(self) -> tuple[str, ...]:
        return ()

    def pump(self) -> None:
        """Nothing can damage a file that only we write."""

    def close(self) -> None:
        self._next = None
        self._pool.shutdown()
        self._file.close()
