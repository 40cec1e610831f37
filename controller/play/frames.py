"""Sets of frames, and the mapped file that passes them on (docs/reference/player-protocol.md, "Frame file").

The same layout serves the inbox (the controller writes, the player reads) and the memory output (the player writes,
the program that stands for the projectors reads).
"""

from __future__ import annotations

import contextlib
import fcntl
import mmap
import os
import re
import time
from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Self

import numpy as np
import numpy.typing as npt

from controller.core.errors import UsageError, WorkError
from controller.core.storage import stream_atomically
from hal.codecs.player import (
    LONGEST_HEAD_BYTES,
    LONGEST_NAME_BYTES,
    MOST_OUTPUTS,
    FrameLayout,
    MappedFrames,
    parse_layout,
)
from hal.errors import ProtocolError

_COPIED_ROWS = 256
"""At most so many rows are one part: several threads can share a picture of which nothing is known."""


@dataclass(frozen=True, slots=True, eq=False)
class Tiles:
    """The tiles of one picture: their size, and (rows, columns) uint64 numbers; equal numbers, equal pixels.

    0 stands for pixels of which nothing is known.
    """

    width_px: int
    height_px: int
    content: npt.NDArray[np.uint64]


def same_tiles(one: Tiles | None, other: Tiles | None) -> npt.NDArray[np.bool_] | None:
    """(rows, columns): which tiles two pictures have in common; None where that can not be said."""
    if one is None or other is None or (one.width_px, one.height_px) != (other.width_px, other.height_px):
        return None
    same: npt.NDArray[np.bool_] = (one.content == other.content) & (one.content != 0)
    return same


def differing(shape: tuple[int, ...], one: Tiles | None, other: Tiles | None) -> list[tuple[slice, slice]]:
    """Parts (rows, columns) of a picture of this shape that together hold all in which two pictures may differ."""
    same = same_tiles(one, other)
    if same is None or one is None:
        return [
            np.s_[top : min(top + _COPIED_ROWS, shape[0]), 0 : shape[1]] for top in range(0, shape[0], _COPIED_ROWS)
        ]
    found = []
    for row, line in enumerate(same):
        edges = np.flatnonzero(np.diff(line, prepend=True, append=True)).tolist()
        top = row * one.height_px
        for first, last in zip(edges[::2], edges[1::2], strict=True):
            columns = slice(first * one.width_px, min(last * one.width_px, shape[1]))
            found.append((slice(top, min(top + one.height_px, shape[0])), columns))
    return found


MAX_SIDE_PX: Final = 16384
_ALONE_BYTES: Final = 4 * 1024 * 1024
"""So little is copied sooner by one thread than other threads are woken."""
_OUTPUT: Final = re.compile(r"([^:,\s]{1,39}):([0-9]{1,5})x([0-9]{1,5})")


@dataclass(frozen=True, slots=True)
class OutputSize:
    """One output of the player: its name and its picture's size."""

    name: str
    width_px: int
    height_px: int

    @property
    def shape(self) -> tuple[int, int, int]:
        return (self.height_px, self.width_px, 3)


def parse_outputs(text: str) -> tuple[OutputSize, ...]:
    """Read ``P1:280x210,P2:280x210``. Raises UsageError("outputs-wrong")."""
    outputs = []
    for part in text.split(","):
        match = _OUTPUT.fullmatch(part)
        if match is None or len(match[1].encode()) > LONGEST_NAME_BYTES or not match[1].isprintable():
            raise _outputs_wrong(f"{part!r} is not NAME:WIDTHxHEIGHT")
        outputs.append(OutputSize(match[1], int(match[2]), int(match[3])))
    if len({output.name for output in outputs}) != len(outputs) or len(outputs) > MOST_OUTPUTS:
        raise _outputs_wrong(f"there are more than {MOST_OUTPUTS}, or two have the same name")
    if any(not 1 <= side <= MAX_SIDE_PX for output in outputs for side in output.shape[:2]):
        raise _outputs_wrong(f"a side is not 1 to {MAX_SIDE_PX} pixels")
    return tuple(outputs)


def parse_where(texts: Sequence[str], outputs: Sequence[OutputSize]) -> dict[str, str]:
    """Read ``P1=DP-1`` each: where to find the output of that name. Raises UsageError("outputs-wrong")."""
    found = dict(text.partition("=")[::2] for text in texts)
    unknown = found.keys() - {output.name for output in outputs}
    if unknown or not all(found.values()) or len(found) != len(texts):
        raise _outputs_wrong("--where is not NAME=OUTPUT with the name of an output, each once")
    return found


def _outputs_wrong(detail: str) -> UsageError:
    return UsageError(
        "outputs-wrong",
        what=f"The list of outputs is not valid: {detail}.",
        remedy="Write it as P1:1400x1050,P2:1400x1050 with each name once.",
    )


@dataclass(frozen=True, slots=True, eq=False)
class FrameSet:
    """One picture for every output: ``pixels`` are (rows, columns, 3) uint8 device values, in the outputs' order.

    ``tiles``: what the tiles of each are, where that is known; it says what another set has as well.
    """

    pixels: tuple[npt.NDArray[np.uint8], ...]
    tiles: tuple[Tiles, ...] | None = None

    @classmethod
    def black(cls, outputs: Sequence[OutputSize]) -> Self:
        return cls(tuple(np.zeros(output.shape, np.uint8) for output in outputs))

    @property
    def nbytes(self) -> int:
        return sum(image.nbytes for image in self.pixels)


def layout_of(outputs: Sequence[OutputSize]) -> FrameLayout:
    """The layout of a frame file for these outputs."""
    return FrameLayout.of((output.name, output.width_px, output.height_px) for output in outputs)


class FrameFile:
    """A mapped frame file of known outputs; one process writes, any number read.

    The sequence number at byte 16 is a seqlock: odd while frames are being written, two more for each set.
    """

    def __init__(self, path: Path, outputs: Sequence[OutputSize]) -> None:
        """Map ``path``, making it (mode 0600) unless it is there with these outputs already.

        The sequence of an existing file continues, so that readers who have it mapped see each new set.

        Raises WorkError("no-space" or "cannot-write"), UsageError("frames-in-use") if another process writes to it.
        """
        self.path = path
        layout = layout_of(outputs)
        if not _has_layout(path, layout):
            _refuse_in_use(path)
            stream_atomically(path, lambda file: _fill(file.fileno(), layout), mode=0o600)
        self._file = path.open("r+b")
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            self._mapped = MappedFrames(mmap.mmap(self._file.fileno(), layout.size), layout)
        except BlockingIOError as error:
            self._file.close()
            raise _in_use(path) from error
        self._written: tuple[Tiles, ...] | None = None

    @property
    def sequence(self) -> int:
        return self._mapped.sequence

    @property
    def presented_at(self) -> float:
        return self._mapped.presented_at_s

    def write(self, frames: FrameSet, pool: Executor | None = None) -> None:
        """Replace the set in the file, and say the monotonic time at which it was whole.

        On the threads of ``pool`` if given. Tiles that the set of the last call had as well are left alone.
        """
        self._mapped.begin()
        written, self._written = self._written, None
        parts = []
        for number, (target, image) in enumerate(zip(self._mapped.pixels, frames.pixels, strict=True)):
            for part in differing(image.shape, _tiles_of(frames.tiles, number), _tiles_of(written, number)):
                parts.append((target[part], image[part]))
        if pool is None or sum(image.nbytes for _, image in parts) < _ALONE_BYTES:
            for target, image in parts:
                np.copyto(target, image)
        else:
            list(pool.map(lambda pair: np.copyto(*pair), parts))
        self._written = frames.tiles
        self._mapped.finish(time.monotonic())

    def read(self, into: FrameSet) -> int:
        """Copy the set out and return its sequence number.

        Raises WorkError("frames-changing") if a set was written at the same time.
        """
        before = self.sequence
        for image, source in zip(into.pixels, self._mapped.pixels, strict=True):
            np.copyto(image, source)
        if before % 2 or self.sequence != before:
            raise WorkError(
                "frames-changing",
                what="The frames changed while they were being read.",
                remedy="Write all frames first, make the sequence number even, and then request them.",
            )
        return before

    def close(self) -> None:
        """Release the mapping; the file stays."""
        self._mapped.close()
        self._file.close()


def _tiles_of(tiles: tuple[Tiles, ...] | None, number: int) -> Tiles | None:
    return None if tiles is None else tiles[number]


def _in_use(path: Path) -> UsageError:
    return UsageError(
        "frames-in-use",
        what=f"Another player writes to {path}.",
        remedy="Stop it first, or give this player another file.",
    )


def _refuse_in_use(path: Path) -> None:
    """Raise UsageError("frames-in-use") rather than put another file in the place of one that a process writes to."""
    with contextlib.suppress(FileNotFoundError), path.open("rb") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise _in_use(path) from error


def _has_layout(path: Path, layout: FrameLayout) -> bool:
    try:
        with path.open("rb") as file:
            return (
                parse_layout(file.read(LONGEST_HEAD_BYTES)) == layout and os.fstat(file.fileno()).st_size == layout.size
            )
    except (FileNotFoundError, ProtocolError):
        return False


def _fill(handle: int, layout: FrameLayout) -> None:
    # Blocks are reserved now: a full disk must stop us here and not kill the process at a store into the mapping.
    os.posix_fallocate(handle, 0, layout.size)
    os.pwrite(handle, layout.head(), 0)
