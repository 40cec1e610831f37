"""The event log, the finished tasks and some values in SQLite. A full disk stops nothing."""

from __future__ import annotations

import json
import sqlite3
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Final

from controller.core.text import well_formed
from controller.kiosk.state import EventRow
from controller.kiosk.store.log_file import MOST_DONE, Content, LogFile
from hal.notices import Notice

SHOWN: Final = 2_000
MOST_FAILURES: Final = 20
_TRIM_EVERY: Final = 200
_RETRY_S: Final = 30.0


class EventLog:
    """Thread-safe. ``problem``: why the log can't be written now, or None.

    ``durable``: events survive a power cut, too, not only the end of the process. Events that can't be written are kept
    in memory until there is space again. A damaged file is replaced by one with all that is known (``log_file``).
    ``connect``: as ``sqlite3.connect``; ``also``: gets every new event.
    """

    FILE: Final = "kiosk/events.sqlite"

    def __init__(
        self, path: Path, *, wall: Callable[[], float] = time.time, durable: bool = True,
        monotonic: Callable[[], float] = time.monotonic, connect: Callable[..., sqlite3.Connection] = sqlite3.connect,
        also: Callable[[EventRow], None] | None = None,
    ) -> None:  # fmt: skip
        self.path, self._wall, self._monotonic, self._also = path, wall, monotonic, also
        self._lock = threading.RLock()
        self._file = LogFile(path, wall=wall, durable=durable, connect=connect)
        self._recent: deque[EventRow] = deque(self._file.events(SHOWN), SHOWN)
        self._number = self._file.last_number(self._recent[-1].number if self._recent else 0)
        self._done, self._kept = self._file.done(), self._file.kept()
        self._failures = self._read_failures()
        self._waiting: deque[EventRow] = deque(maxlen=SHOWN)
        self._unwritten_done: dict[str, None] = {}
        self._unwritten_kept: dict[str, None] = {}
        self.problem, self._retry_at_s = self._file.problem, 0.0
        if self._file.torn:
            self._put_aside()

    # -- events

    def add(self, notice: Notice) -> EventRow:
        """Add one line. A disk error is not raised."""
        with self._lock:
            self._number += 1
            row = EventRow(self._number, self._wall(), notice.level.value, well_formed(notice.text), notice.code)
            self._recent.append(row)
            self._waiting.append(row)
            self._flush()
        if self._also is not None:
            self._also(row)
        return row

    def add_failure(self, notice: Notice) -> None:
        """Add one line, which stays in ``failures`` until it is confirmed."""
        with self._lock:
            self._failures = (*self._failures, self.add(notice))[-MOST_FAILURES:]
            self._keep_failures()

    @property
    def failures(self) -> tuple[EventRow, ...]:
        """The unconfirmed failures, oldest first, at most ``MOST_FAILURES``."""
        return self._failures

    def seen(self, number: int) -> None:
        """Confirm the failures up to this number."""
        with self._lock:
            self._failures = tuple(row for row in self._failures if row.number > number)
            self._keep_failures()

    def _keep_failures(self) -> None:
        self.keep("failures", json.dumps([asdict(row) for row in self._failures]))

    def _read_failures(self) -> tuple[EventRow, ...]:
        try:
            return tuple(EventRow(**row) for row in json.loads(self._kept.get("failures", "[]")))
        except (ValueError, TypeError):
            return ()

    def after(self, number: int) -> Sequence[EventRow]:
        """Events with a larger number, oldest first, at most the newest ``SHOWN``."""
        with self._lock:
            return [row for row in self._recent if row.number > number]

    @property
    def number(self) -> int:
        return self._number

    # -- finished tasks, and values

    def done(self) -> frozenset[str]:
        with self._lock:
            return frozenset(self._done)

    def mark_done(self, key: str, how: str) -> None:
        """Record that ``key`` was done or skipped: in memory at once, on disk as soon as possible."""
        with self._lock:
            self._done.pop(key, None)  # the newest is last, as on disk
            self._done[key] = how
            self._unwritten_done[key] = None
            self._flush(now=True)

    def value(self, name: str) -> str | None:
        with self._lock:
            return self._kept.get(name)

    def keep(self, name: str, value: str) -> None:
        with self._lock:
            if self._kept.get(name) != value:
                self._kept[name] = value
                self._unwritten_kept[name] = None
                self._flush()

    def close(self) -> None:
        with self._lock:
            self._flush(now=True)
            self._file.close()

    # -- the disk

    def _flush(self, *, now: bool = False) -> None:
        if self.problem is not None and not now and self._monotonic() < self._retry_at_s:
            return
        trim = self._number % _TRIM_EVERY == 0
        try:
            if not self._file.available:
                self._file.open_again(self._known())
            self._file.write(self._unwritten(), trim=trim)
        except (sqlite3.Error, OSError) as error:
            self.problem, self._retry_at_s = str(error), self._monotonic() + _RETRY_S
            if self._file.is_lost(error):
                self._put_aside()
            return
        self._all_written()
        if trim:
            for key in list(self._done)[: max(0, len(self._done) - MOST_DONE)]:
                del self._done[key]

    def _put_aside(self) -> None:
        """Let a new file take the place of one that takes nothing any more; without space, when there is some."""
        if self._file.put_aside(self._known()):
            self._all_written()
        else:
            self._waiting = deque(self._recent, SHOWN)
            self._unwritten_done, self._unwritten_kept = dict.fromkeys(self._done), dict.fromkeys(self._kept)

    def _all_written(self) -> None:
        self._waiting.clear()
        self._unwritten_done.clear()
        self._unwritten_kept.clear()
        self.problem = None

    def _known(self) -> Content:
        return Content(self._recent, self._done, self._kept)

    def _unwritten(self) -> Content:
        done = {key: self._done[key] for key in self._unwritten_done}
        return Content(self._waiting, done, {name: self._kept[name] for name in self._unwritten_kept})
