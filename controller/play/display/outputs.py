"""Where frames become visible. Every output shows whole sets: all projectors change in one flip, or none.

Cross-fades and dimming mix sets of device values in (nearly) linear light.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from pathlib import Path
from typing import Final, Protocol

import numpy as np
import numpy.typing as npt

from controller.play.frames import FrameFile, FrameSet, OutputSize, Tiles, differing, same_tiles

_BLOCK_BYTES: Final = 96 * 1024
"""Small enough that the working copies stay in the processor's cache."""


def mixture_of(before: FrameSet, after: FrameSet, outputs: Sequence[OutputSize]) -> FrameSet:
    """A set for the mixtures of two: what both have in common is in it already, and stays as it is."""
    mixture = FrameSet.black(outputs)
    if before.tiles is None or after.tiles is None:
        return mixture
    tiles = []
    for old, new, source, target in zip(before.tiles, after.tiles, before.pixels, mixture.pixels, strict=True):
        same = same_tiles(old, new)
        if same is None:
            return FrameSet(mixture.pixels)
        kept = Tiles(old.width_px, old.height_px, np.where(same, old.content, np.uint64(0)))
        nothing = Tiles(old.width_px, old.height_px, np.where(same, np.uint64(0), np.uint64(1)))
        for part in differing(source.shape, nothing, nothing):
            target[part] = source[part]
        tiles.append(kept)
    return FrameSet(mixture.pixels, tuple(tiles))


def mix_sets(before: FrameSet, after: FrameSet, share: float, into: FrameSet, pool: Executor | None = None) -> None:
    """Write ``sqrt((1 - share) before^2 + share after^2)``, rounded, into ``into``; ``share`` is in [0, 1].

    The square stands for every projector's response (docs/decisions/0022). Both ends are
    exact. All sets have the same shapes; ``into`` is neither of the others: a black set, or of ``mixture_of``. On the
    threads of ``pool`` if given.
    """
    jobs = []
    for number, (old, new, out) in enumerate(zip(before.pixels, after.pixels, into.pixels, strict=True)):
        tiles = None if into.tiles is None else into.tiles[number]
        jobs += [(old[part], new[part], out[part], share) for part in differing(out.shape, tiles, tiles)]
    if pool is None:
        for job in jobs:
            _mix(*job)
    else:
        for future in [pool.submit(_mix, *job) for job in jobs]:
            future.result()


def dimmed(frames: FrameSet, share: float) -> FrameSet:
    """A new set with ``share`` (0..1) of the light of ``frames``: its mixture with black, as ``mix_sets`` makes it."""
    table = (np.sqrt(np.float64(share)) * np.arange(256) + 0.5).astype(np.uint8)
    return FrameSet(tuple(table[image] for image in frames.pixels))


def _mix(old: npt.NDArray[np.uint8], new: npt.NDArray[np.uint8], out: npt.NDArray[np.uint8], share: float) -> None:
    rows = max(1, _BLOCK_BYTES // (3 * out.shape[1]))
    light, other = (np.empty((min(rows, len(out)), *out.shape[1:]), np.float32) for _ in range(2))
    # Scaled before squaring: one multiplication for both.
    scales = np.sqrt(np.float32(1 - share)), np.sqrt(np.float32(share))
    for start in range(0, len(out), rows):
        part = out[start : start + rows]
        first, second = light[: len(part)], other[: len(part)]
        np.multiply(old[start : start + rows], scales[0], out=first)
        np.multiply(first, first, out=first)
        np.multiply(new[start : start + rows], scales[1], out=second)
        np.multiply(second, second, out=second)
        np.add(first, second, out=first)
        np.sqrt(first, out=first)
        np.add(first, np.float32(0.5), out=first)
        np.copyto(part, first, casting="unsafe")


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
