"""Where frames become visible. Every output shows whole sets: all projectors change in one flip, or none."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

from controller.play.frames import FrameFile, FrameSet, OutputSize


class Output(Protocol):
    """All projector outputs together. Calibration patterns and appearances pass through the same two calls."""

    def prepare(self, frames: FrameSet) -> None:
        """Make the next set ready, so that ``flip`` has as little to do as the medium allows."""

    def flip(self) -> float:
        """Make the prepared set visible on all outputs at once; return when it became so, in monotonic seconds.

        The set that ``prepare`` got is not needed any more after this.
        """

    def pump(self) -> None:
        """Serve the window system, if there is one; repair what it has damaged of the visible set."""

    def close(self) -> None:
        """Release everything. What is visible may stay visible."""


class MemoryOutput:
    """Outputs in a mapped file, for machines without projectors (docs/player-protocol.md, "Frame file")."""

    def __init__(self, path: Path, outputs: Sequence[OutputSize]) -> None:
        self._file = FrameFile(path, outputs)
        self._next: FrameSet | None = None

    def prepare(self, frames: FrameSet) -> None:
        self._next = frames

    def flip(self) -> float:
        assert self._next is not None
        self._file.write(self._next)
        self._next = None
        return self._file.presented_at

    def pump(self) -> None:
        """Nothing can damage a file that only we write."""

    def close(self) -> None:
        self._next = None
        self._file.close()
