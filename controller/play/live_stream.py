"""Live pictures: frames that another process writes to a shared file (docs/reference/player-protocol.md).

The file holds finished frames, one an output, or targets, of which the output's shaders make frames. The writer
holds an flock on it, so that its end is noticed however it ends; the last whole picture stays.
"""

from __future__ import annotations

import fcntl
import mmap
import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, BinaryIO, Final, Protocol, Self, runtime_checkable

import numpy as np
import numpy.typing as npt

from controller.bundle.live_maps import LiveMaps
from controller.core.errors import UsageError, WorkError
from controller.play.display.outputs import Output
from controller.play.frames import FrameSet, OutputSize, layout_of
from controller.play.presenting import Intervals, PendingPresentation, PresentedSet
from hal.codecs.player import LONGEST_HEAD_BYTES, FrameLayout, MappedFrames, parse_layout
from hal.errors import ProtocolError

TARGET: Final = "target"
SILENT_S: Final = 1.0
"""After this time without a picture, the stream checks whether its writer still exists."""


class LiveFile:
    """A frame file that another process writes, read as ``outputs``."""

    def __init__(self, path: Path, outputs: Sequence[OutputSize]) -> None:
        """Raises UsageError("live-file-unfit"), naming what the file has and what it should have."""
        self._path, self._outputs = path, tuple(outputs)
        layout = layout_of(outputs)
        try:
            self._file = path.open("rb")
        except OSError as error:
            raise _unfit(path, f"it can't be opened ({error.strerror})", outputs) from error
        try:
            self._inode = os.fstat(self._file.fileno())
            there = _layout_in(self._file, path, outputs)
            if there != layout or self._inode.st_size != layout.size:
                sizes = ", ".join(f"{slot.name} {slot.width_px}x{slot.height_px}" for slot in there.slots)
                raise _unfit(path, f"it holds {sizes}", outputs)
            self._mapped = MappedFrames(mmap.mmap(self._file.fileno(), layout.size, access=mmap.ACCESS_READ), layout)
        except BaseException:
            self._file.close()
            raise
        self._seen = 0

    def newest(self, into: FrameSet) -> float | None:
        """Copy the set out if it is another than before and whole; when it was written, None if there is none."""
        before = self._mapped.sequence
        if before % 2 or before == self._seen:
            return None
        written_at = self._mapped.presented_at_s
        for image, source in zip(into.pixels, self._mapped.pixels, strict=True):
            np.copyto(image, source)
        if self._mapped.sequence != before:
            return None
        self._seen = before
        return written_at

    def has_writer(self) -> bool:
        """Whether a process holds the file's lock."""
        try:
            fcntl.flock(self._file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
        fcntl.flock(self._file, fcntl.LOCK_UN)
        return False

    def reopened(self) -> Self | None:
        """The file of that name, if it is another one by now and fits; this one is closed then."""
        try:
            if os.path.samestat(self._path.stat(), self._inode):
                return None
            found = type(self)(self._path, self._outputs)
        except (OSError, UsageError):
            return None
        self.close()
        return found

    def close(self) -> None:
        """Release the mapping; the file stays."""
        self._mapped.close()
        self._file.close()


def _layout_in(file: BinaryIO, path: Path, outputs: Sequence[OutputSize]) -> FrameLayout:
    try:
        return parse_layout(file.read(LONGEST_HEAD_BYTES))
    except ProtocolError as error:
        raise _unfit(path, "it is not a frame file", outputs) from error


def _unfit(path: Path, why: str, wanted: Sequence[OutputSize]) -> UsageError:
    sizes = ", ".join(f"{one.name} {one.width_px}x{one.height_px}" for one in wanted)
    return UsageError(
        "live-file-unfit",
        what=f"{path} can't be shown live: {why}.",
        remedy=f"First let its writer make a frame file with {sizes}.",
    )


@runtime_checkable
class LiveOutput(Protocol):
    """An output that makes the frames of a live target itself."""

    def load_live(self, maps: LiveMaps) -> None:
        """Take a bundle's live section over. Raises WorkError("display-unfit") where the driver can not use it."""

    def prepare_live(self, target: npt.NDArray[np.uint8], brightness: float) -> None:
        """As ``Output.prepare``, with the frames for this target (height, width, 3) uint8 sRGB."""

    def live_frames(self) -> FrameSet:
        """The frames of the last target, read back."""


class LiveStream:
    """What a ``live`` request asked for, until something else is asked for."""

    by = "frames"

    def __init__(self, path: Path, sizes: Sequence[OutputSize]) -> None:
        """Raises UsageError("live-file-unfit")."""
        self._file = LiveFile(path, sizes)
        self._path = path
        # One may be on the outputs while the other is read into.
        self._sets = [FrameSet.black(sizes), FrameSet.black(sizes)]
        self._delays = Intervals()
        self._shown, self._written_at, self._presented_at = 0, 0.0, 0.0
        self._heard_s = self._looked_s = time.monotonic()
        self._gone = False

    def coming(self, tick: int) -> PendingPresentation | None:
        """The newest picture to be presented at a tick; None where there is no other than the last."""
        written_at = self._file.newest(self._sets[0])
        now_s = time.monotonic()
        if written_at is None:
            self._look(now_s)
            return None
        self._heard_s, self._gone, self._written_at = now_s, False, written_at
        self._sets.reverse()
        return self._made(self._sets[1], tick)

    def _made(self, frames: FrameSet, tick: int) -> PendingPresentation:
        return PendingPresentation("live", None, frames, tick, None, paced=True)

    def _look(self, now_s: float) -> None:
        """Long without a picture: is its writer there, or is there another file of that name?"""
        if now_s - max(self._heard_s, self._looked_s) < SILENT_S:
            return
        self._looked_s = now_s
        self._file = self._file.reopened() or self._file
        self._gone = not self._file.has_writer()

    def presented(self, last: PresentedSet) -> None:
        """What ``coming`` gave is on the outputs."""
        self._shown += 1
        self._presented_at = last.at_s
        if self._written_at > 0:
            self._delays.add(last.at_s - self._written_at)

    def status(self) -> dict[str, Any]:
        """The key ``live`` of the status (docs/reference/player-protocol.md)."""
        return {
            "file": str(self._path),
            "by": self.by,
            "shown": self._shown,
            "presented_at": self._presented_at if self._shown else None,
            "source": "gone" if self._gone else "there",
            "delay_p50_s": self._delays.percentile(50),
            "delay_p99_s": self._delays.percentile(99),
        }

    def end(self) -> FrameSet | None:
        """Let go of the file; the frames that are shown, where the presenter does not have them."""
        self._file.close()
        return None


class ShadedStream(LiveStream):
    """The same for targets, of which the output makes the frames."""

    by = "shaders"

    def __init__(self, path: Path, output: LiveOutput, maps: LiveMaps, white: float) -> None:
        """``white``: the radiance of a target's white. Raises also WorkError("display-unfit")."""
        super().__init__(path, [OutputSize(TARGET, *maps.target_px)])
        self._output, self._white = output, white
        try:
            output.load_live(maps)
        except WorkError:
            self._file.close()
            raise
        self._nothing = FrameSet(())

    def _made(self, frames: FrameSet, tick: int) -> PendingPresentation:
        def prepare() -> None:
            self._output.prepare_live(frames.pixels[0], self._white)

        return PendingPresentation("live", None, self._nothing, tick, None, paced=True, prepare=prepare)

    def end(self) -> FrameSet | None:
        """See ``LiveStream``."""
        super().end()
        return self._output.live_frames() if self._shown else None


def open_live(
    path: Path, output: Output, sizes: Sequence[OutputSize], maps: LiveMaps | None, white: float | None
) -> LiveStream:
    """Finished frames of ``sizes``, or with ``white`` targets for the bundle's ``maps``.

    Raises UsageError("live-file-unfit" or "live-no-shaders"), WorkError("display-unfit").
    """
    if white is None:
        return LiveStream(path, sizes)
    if not isinstance(output, LiveOutput) or maps is None:
        raise UsageError(
            "live-no-shaders",
            what="This player shows in memory, where no shaders make frames of targets.",
            remedy="Write finished frames instead; 'velatura live' does this automatically.",
        )
    return ShadedStream(path, output, maps, white)
