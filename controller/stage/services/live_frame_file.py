"""A live source: a shared frame file to which a render writes targets (docs/reference/player-protocol.md)."""

from __future__ import annotations

import time
from pathlib import Path

from controller.core.errors import UsageError
from controller.play.frames import FrameSet, OutputSize
from controller.play.live_stream import SILENT_S, LiveFile
from controller.stage.live.sources import LivePicture
from hal.codecs.player import MAGIC


def holds_frames(path: Path) -> bool:
    """Whether ``path`` is a frame file."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(len(MAGIC)) == MAGIC


class FileSource:
    """The newest picture that another process wrote there; see ``controller.stage.live.sources.LiveSource``."""

    def __init__(self, path: Path, size: OutputSize) -> None:
        """Raises UsageError("live-file-unfit"), naming both sizes."""
        self._path, self._file = path, LiveFile(path, [size])
        self._set = FrameSet.black([size])
        self._number = 0
        self._heard_s = time.monotonic()
        self._told_gone = False

    def next(self, at_s: float) -> LivePicture | None:
        """See ``LiveSource``. Raises UsageError("live-source-gone") once when the writer ended; it may come back."""
        if self._file.newest(self._set) is not None:
            self._heard_s, self._told_gone = time.monotonic(), False
            self._number += 1
            return LivePicture(self._set.pixels[0], self._number - 1, 0)
        if time.monotonic() - self._heard_s > SILENT_S:
            self._heard_s = time.monotonic()
            self._file = self._file.reopened() or self._file
            if not self._file.has_writer() and not self._told_gone:
                self._told_gone = True
                raise UsageError(
                    "live-source-gone",
                    what=f"The source of {self._path} has ended. The last picture stays.",
                    remedy="Restart the source; playback resumes.",
                )
        return None

    @property
    def ended(self) -> bool:
        """False: a writer may come back at any time."""
        return False

    def close(self) -> None:
        """Release the mapping."""
        self._file.close()
