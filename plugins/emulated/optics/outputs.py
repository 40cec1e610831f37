"""What the player shows: the memory output file, read as pixels, and a short history of what was visible when.

The file is read and not mapped: a player that shortens or replaces it while we look must not end the bench.
"""

from __future__ import annotations

import contextlib
import os
import threading
import time
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final, TypeAlias

import numpy as np
import numpy.typing as npt

from hal.codecs.player import LONGEST_HEAD_BYTES, FrameLayout, parse_layout, parse_set
from hal.errors import ProtocolError

ByteImage: TypeAlias = npt.NDArray[np.uint8]

MOST_BYTES: Final = 1 << 30
TRIES: Final = 20
KEPT: Final = 32
POLL_S: Final = 0.004
QUIET_POLL_S: Final = 0.02
"""Where nothing has changed for ``QUIET_S``: of several sets within this time, all but the last are missed then."""
QUIET_S: Final = 1.0


@dataclass(frozen=True, slots=True)
class VisibleFrameSet:
    """Frames (rows, columns, 3) uint8 by output name, presented together at ``presented_at_s`` (monotonic clock)."""

    sequence: int
    presented_at_s: float
    frames: Mapping[str, ByteImage]


class FrameReader:
    """Reads the newest whole frame set of a memory output file that another process writes."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._last: tuple[tuple[int, int], VisibleFrameSet] | None = None

    def latest(self) -> VisibleFrameSet | None:
        """The newest frame set, the same object while it is unchanged; None while there is no (valid) file.

        A set that is being written while we read is read again; when the writer never pauses, the last whole one stays.
        """
        try:
            with self._path.open("rb", buffering=0) as file:
                return self._read(file.fileno())
        except OSError:
            self._last = None
            return None

    def _read(self, handle: int) -> VisibleFrameSet | None:
        status = os.fstat(handle)
        identity = (status.st_dev, status.st_ino)
        previous = self._last[1] if self._last is not None and self._last[0] == identity else None
        for _ in range(TRIES):
            head = os.pread(handle, LONGEST_HEAD_BYTES, 0)
            try:
                layout = parse_layout(head)
            except ProtocolError:
                return None
            sequence, presented_at_s = parse_set(head)
            if previous is not None and previous.sequence == sequence:
                return previous
            if sequence % 2 == 0:
                frames = _frames(handle, layout, status.st_size)
                after = os.pread(handle, LONGEST_HEAD_BYTES, 0)
                if len(after) == len(head) and parse_set(after)[0] == sequence:
                    if frames is None:
                        return None
                    newest = VisibleFrameSet(sequence, presented_at_s, frames)
                    self._last = (identity, newest)
                    return newest
            time.sleep(0.0005)
        return previous


def _frames(handle: int, layout: FrameLayout, file_size: int) -> dict[str, ByteImage] | None:
    """Every output's pixels, or None where a slot points outside the file."""
    frames: dict[str, ByteImage] = {}
    for slot in layout.slots:
        if slot.nbytes > MOST_BYTES or slot.offset + slot.nbytes > file_size:
            return None
        pixels = np.empty(slot.shape, dtype=np.uint8)
        if os.preadv(handle, [pixels.reshape(-1).data], slot.offset) != slot.nbytes:
            return None
        frames[slot.name] = pixels
    return frames


class VisibleFrames:
    """Polls a memory output, and knows what the projectors showed when: each set is visible ``latency_s`` late."""

    def __init__(self, path: Path, latency_s: float) -> None:
        self._reader = FrameReader(path)
        self._latency_s = latency_s
        self._lock = threading.Lock()
        self._changed_s = time.monotonic()
        self._history: deque[tuple[float, VisibleFrameSet | None]] = deque([(0.0, None)], maxlen=KEPT)
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._poll, name="outputs", daemon=True)

    def __enter__(self) -> VisibleFrames:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stopped.set()
        with contextlib.suppress(RuntimeError):  # never started
            self._thread.join(timeout=1.0)

    def update(self) -> None:
        """Read the memory output now."""
        with self._lock:
            latest = self._reader.latest()
            _, newest = self._history[-1]
            if latest is not newest:
                self._changed_s = time.monotonic()
                at = self._changed_s if latest is None else latest.presented_at_s
                self._history.append((max(at + self._latency_s, self._history[-1][0]), latest))

    def during(self, start_s: float, end_s: float) -> list[tuple[float, VisibleFrameSet | None]]:
        """The sets that were visible between two times, with their shares of it (sum 1); None: without a picture."""
        self.update()
        with self._lock:
            history = list(self._history)
        if end_s <= start_s:
            end_s = start_s + 1e-9
        shares: list[tuple[float, VisibleFrameSet | None]] = []
        for index, (since, frames) in enumerate(history):
            # What was shown before the oldest set we know is forgotten; the oldest stands in for it.
            begin = start_s if index == 0 else max(since, start_s)
            until = history[index + 1][0] if index + 1 < len(history) else end_s
            share = (min(until, end_s) - begin) / (end_s - start_s)
            if share > 0.0:
                shares.append((share, frames))
        return shares

    def _poll(self) -> None:
        while not self._stopped.wait(self._pause_s()):
            self.update()

    def _pause_s(self) -> float:
        """Until the next look. A bench often stands by for hours, beside much other work."""
        return POLL_S if time.monotonic() < self._changed_s + QUIET_S else QUIET_POLL_S
