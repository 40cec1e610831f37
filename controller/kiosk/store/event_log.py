"""The event log, the finished tasks and some values in SQLite. A full disk stops nothing."""

from __future__ import annotations

import contextlib
import json
import shutil
import sqlite3
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

from controller.kiosk.interface import EventLevel, EventRow

MOST_EVENTS: Final = 20_000
MOST_DONE: Final = 400
SHOWN: Final = 2_000
MOST_FAILURES: Final = 20
_TRIM_EVERY: Final = 200
_RETRY_S: Final = 30.0
_MEMORY: Final = Path("/dev/shm")  # noqa: S108 - the folder in it has a name of its own
_WHOLE: Final = 1
"""SQLite's ``user_version`` of a file that has all that is known."""
_LEVELS: Final[dict[str, EventLevel]] = {"info": "info", "warning": "warning", "error": "error"}
_SCHEMA: Final = """
CREATE TABLE IF NOT EXISTS events (
    number INTEGER PRIMARY KEY AUTOINCREMENT, unix_s REAL NOT NULL, level TEXT NOT NULL, code TEXT NOT NULL,
    text TEXT NOT NULL);
CREATE TABLE IF NOT EXISTS done (number INTEGER PRIMARY KEY AUTOINCREMENT, key TEXT UNIQUE NOT NULL, how TEXT NOT NULL);
CREATE TABLE IF NOT EXISTS kept (name TEXT PRIMARY KEY, value TEXT NOT NULL);
"""
_TRIM: Final = """
DELETE FROM {table} WHERE number <= (SELECT number FROM {table} ORDER BY number DESC LIMIT 1 OFFSET ?)
"""


@dataclass(frozen=True, slots=True)
class Decision:
    """An observation or decision of the kiosk. ``reason`` and ``remedy`` are sentences; the remedy may be empty."""

    code: str
    reason: str
    remedy: str = ""
    level: EventLevel = "info"

    @property
    def text(self) -> str:
        return f"{self.reason} {self.remedy}".strip()


class EventLog:
    """Thread-safe. ``problem``: why the log can't be written now, or None.

    ``durable``: events survive a power cut, too, not only the end of the process. Events that can't be written are kept
    in memory until there is space again. A damaged file is renamed and replaced by one with all that is known, at no
    moment of which a power cut loses it. ``connect``: as ``sqlite3.connect``; ``also``: gets every new event.
    """

    FILE: Final = "kiosk/events.sqlite"

    def __init__(
        self, path: Path, *, wall: Callable[[], float] = time.time, durable: bool = True,
        monotonic: Callable[[], float] = time.monotonic, connect: Callable[..., sqlite3.Connection] = sqlite3.connect,
        also: Callable[[EventRow], None] | None = None,
    ) -> None:  # fmt: skip
        self.path, self._wall, self._durable = path, wall, durable
        self._monotonic, self._connect, self._also = monotonic, connect, also
        self._lock = threading.RLock()
        self.problem: str | None = None
        self._retry_at_s = 0.0
        self._unavailable = self._torn = False
        self._database = self._opened()
        self._recent: deque[EventRow] = deque(self._load(), SHOWN)
        self._number = self._last_number()
        self._waiting: deque[EventRow] = deque(maxlen=SHOWN)
        self._done: dict[str, str] = dict(self._query("SELECT key, how FROM done ORDER BY number", str, str))
        self._kept: dict[str, str] = dict(self._query("SELECT name, value FROM kept", str, str))
        self._failures = self._read_failures()
        self._unwritten: dict[tuple[str, str], None] = {}
        if self._torn:
            self._put_aside()

    # -- events

    def add(self, decision: Decision) -> EventRow:
        """Add one line. A disk error is not raised."""
        with self._lock:
            self._number += 1
            row = EventRow(self._number, self._wall(), decision.level, decision.text, decision.code)
            self._recent.append(row)
            self._waiting.append(row)
            self._flush()
        if self._also is not None:
            self._also(row)
        return row

    def add_failure(self, decision: Decision) -> None:
        """Add one line, which stays in ``failures`` until it is confirmed."""
        with self._lock:
            self._failures = (*self._failures, self.add(decision))[-MOST_FAILURES:]
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
            self._unwritten[("done", key)] = None
            self._flush(now=True)

    def value(self, name: str) -> str | None:
        with self._lock:
            return self._kept.get(name)

    def keep(self, name: str, value: str) -> None:
        with self._lock:
            if self._kept.get(name) != value:
                self._kept[name] = value
                self._unwritten[("kept", name)] = None
                self._flush()

    def close(self) -> None:
        with self._lock:
            self._flush(now=True)
            self._database.close()

    # -- the disk

    def _flush(self, *, now: bool = False) -> None:
        if self.problem is not None and not now and self._monotonic() < self._retry_at_s:
            return
        try:
            if self._unavailable:
                self._end_replacing()
                if self._torn:
                    # It would take new events, and lose some of them.
                    self._replace()
                self._database, self._unavailable = self._connected(self.path), False
            with self._database as database:
                self._write(database, self._waiting, self._unwritten)
                if self._number % _TRIM_EVERY == 0:
                    self._trim(database)
        except (sqlite3.Error, OSError) as error:
            self.problem, self._retry_at_s = str(error), self._monotonic() + _RETRY_S
            # Still unavailable: it was full when the kiosk began, and now it can be opened no better.
            is_lost = _is_damage if self._unavailable else _is_corrupt
            if isinstance(error, sqlite3.Error) and is_lost(error):
                self._put_aside()
            return
        self._all_written()

    def _all_written(self) -> None:
        self._waiting.clear()
        self._unwritten.clear()
        self.problem = None

    def _write(
        self, database: sqlite3.Connection, events: Iterable[EventRow], values: Iterable[tuple[str, str]]
    ) -> None:
        for row in events:
            database.execute(
                "INSERT OR IGNORE INTO events VALUES (?, ?, ?, ?, ?)",
                (row.number, row.unix_s, row.level, row.code, row.text),
            )
        for kind, key in values:
            if kind == "done":
                database.execute("INSERT OR REPLACE INTO done (key, how) VALUES (?, ?)", (key, self._done[key]))
            else:
                database.execute("INSERT OR REPLACE INTO kept VALUES (?, ?)", (key, self._kept[key]))

    def _trim(self, database: sqlite3.Connection) -> None:
        # Rows are counted, because after a damaged log numbers continue far above those of the rows that were kept.
        for table, most in (("events", MOST_EVENTS), ("done", MOST_DONE)):
            database.execute(_TRIM.format(table=table), (most,))
        for key in list(self._done)[: max(0, len(self._done) - MOST_DONE)]:
            del self._done[key]

    def _opened(self) -> sqlite3.Connection:
        try:
            self._end_replacing()
            return self._connected(self.path)
        except (sqlite3.DatabaseError, OSError) as error:
            self.problem = str(error)
            if isinstance(error, sqlite3.Error) and _is_damage(error):
                # A damaged log must not keep the stage dark; the file is kept for analysis.
                with contextlib.suppress(OSError, sqlite3.Error):
                    self._rename_damaged()
                    database = self._connected(self.path)
                    self.problem = None
                    return database
            self._unavailable = True
            return self._copied()

    def _put_aside(self) -> None:
        """A file that can be read in part, but takes nothing any more: all that is known goes into a new one, if there
        is space, else into memory until there is.
        """
        with contextlib.suppress(sqlite3.Error):
            self._database.close()
        self._torn = True
        try:
            self._replace()
            self._database, self._unavailable = self._connected(self.path), False
        except (sqlite3.Error, OSError):
            self._database, self._unavailable = self._connected(Path(":memory:")), True
            self._waiting, self._unwritten = deque(self._recent, SHOWN), dict.fromkeys(self._known())
        else:
            self._all_written()

    def _known(self) -> list[tuple[str, str]]:
        return [("done", key) for key in self._done] + [("kept", key) for key in self._kept]

    def _replace(self) -> None:
        """Raises sqlite3.Error and OSError; then the old file is still in its place, or the new one is whole."""
        self._remove(self._new)
        with contextlib.closing(self._connected(self._new)) as database:
            with database:
                self._write(database, self._recent, self._known())
                database.execute(f"PRAGMA user_version={_WHOLE}")
            _without_write_ahead_log(database)
        self._take_new()
        self._torn = False

    def _end_replacing(self) -> None:
        """Of a file that was being replaced when the power failed: a new one that is whole takes its place."""
        if not self._new.exists():
            return
        try:
            with contextlib.closing(self._connect(self._new, timeout=2.0)) as database:
                (state,) = database.execute("PRAGMA user_version").fetchone()
                if state == _WHOLE:
                    _without_write_ahead_log(database)
        except sqlite3.Error as error:
            if not _is_damage(error):
                raise
            # Written in part; the log itself may be sound.
            state = 0
        if state == _WHOLE:
            self._take_new()
        else:
            self._remove(self._new)

    def _take_new(self) -> None:
        if self.path.exists():
            self._rename_damaged()
        self._new.replace(self.path)

    def _rename_damaged(self) -> None:
        # Another file's write-ahead log must not be read into the new one.
        for end in ("-wal", "-shm"):
            Path(f"{self.path}{end}").unlink(missing_ok=True)
        self.path.replace(self.path.with_suffix(f".damaged-{int(self._wall())}"))

    @property
    def _new(self) -> Path:
        return self.path.with_suffix(".new")

    @staticmethod
    def _remove(path: Path) -> None:
        for end in ("", "-wal", "-shm"):
            Path(f"{path}{end}").unlink(missing_ok=True)

    def _copied(self) -> sqlite3.Connection:
        """An in-memory copy of a log that can be read but not opened, as on a full disk; see ``_flush``."""
        database = self._connected(Path(":memory:"))
        folder = _MEMORY if _MEMORY.is_dir() else None
        # With its write-ahead log, which a kill leaves behind, and in which the newest events are. Both are read from
        # a folder in memory, because SQLite has to write beside them.
        with contextlib.suppress(sqlite3.Error, OSError), tempfile.TemporaryDirectory(dir=folder) as name:
            copy = Path(name) / self.path.name
            for end in ("", "-wal"):
                # A link to a device such as /dev/zero would be copied without an end.
                if Path(f"{self.path}{end}").is_file():
                    shutil.copyfile(f"{self.path}{end}", f"{copy}{end}")
            with contextlib.closing(sqlite3.connect(copy)) as source:
                source.backup(database)
        return database

    def _connected(self, path: Path) -> sqlite3.Connection:
        if str(path) != ":memory:":
            path.parent.mkdir(parents=True, exist_ok=True)
        database = self._connect(path, check_same_thread=False, timeout=2.0)
        database.text_factory = _text
        try:
            database.execute("PRAGMA journal_mode=WAL")
            # A finished task must not run again after a power cut.
            database.execute(f"PRAGMA synchronous={'FULL' if self._durable else 'OFF'}")
            database.executescript(_SCHEMA)
        except sqlite3.Error:
            database.close()
            raise
        return database

    def _load(self) -> list[EventRow]:
        newest = "SELECT number, unix_s, level, text, code FROM events ORDER BY number DESC"
        # Not a limit of the statement, which would count rows that can't be read.
        rows = self._query(newest, int, float, str, str, str, most=SHOWN)
        return [EventRow(n, s, _LEVELS.get(level, "info"), text, code) for n, s, level, text, code in reversed(rows)]

    def _last_number(self) -> int:
        rows = self._query("SELECT seq FROM sqlite_sequence WHERE name = 'events'", int)
        newest = self._recent[-1].number if self._recent else 0
        if rows and rows[0][0] >= newest:
            return int(rows[0][0])
        # After a damaged or unreadable log, numbers continue far above all that it can have had. Where a page is read
        # as zeros, only the number may be gone.
        lost = newest or self._unavailable or self._torn or list(self.path.parent.glob("*.damaged-*"))
        return max(newest, int(self._wall())) if lost else 0

    def _query(self, statement: str, *kinds: type, most: int | None = None) -> list[tuple]:  # type: ignore[type-arg]
        """Its rows with values of these kinds, at most ``most``; of a damaged file those before the damage: where the
        newest come first, these are the newest.
        """
        rows: list[tuple] = []  # type: ignore[type-arg]
        try:
            for row in self._database.execute(statement):
                if len(rows) == most:
                    break
                if all(map(isinstance, row, kinds)):
                    rows.append(row)
                else:
                    # A page that is gone is read as zeros: its rows have nothing in columns that must have something,
                    # and could not be written into a new file.
                    self._torn = True
        except sqlite3.Error as error:
            self.problem, self._torn = str(error), self._torn or _is_corrupt(error)
        return rows


def _text(stored: bytes) -> str | None:
    """None for what is no text: such a row is torn, and SQLite's own error would hide all rows behind it."""
    try:
        return stored.decode()
    except UnicodeDecodeError:
        return None


def _without_write_ahead_log(database: sqlite3.Connection) -> None:
    """Let all be in the file itself, which then can be renamed. Raises sqlite3.Error."""
    (mode,) = database.execute("PRAGMA journal_mode=DELETE").fetchone()
    if mode != "delete":
        raise sqlite3.OperationalError(f"the log stays in mode {mode}")


def _is_damage(error: sqlite3.Error) -> bool:
    """Whether the file is damaged, and not the disk full or the file handles used up."""
    code = getattr(error, "sqlite_errorcode", sqlite3.SQLITE_ERROR)
    return code & 0xFF in _DAMAGE or code in _UNREADABLE


def _is_corrupt(error: sqlite3.Error) -> bool:
    return getattr(error, "sqlite_errorcode", 0) & 0xFF in (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB)


_DAMAGE: Final = (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB, sqlite3.SQLITE_FORMAT, sqlite3.SQLITE_ERROR)
_UNREADABLE: Final = (sqlite3.SQLITE_IOERR_READ, sqlite3.SQLITE_IOERR_SHORT_READ, sqlite3.SQLITE_IOERR_CORRUPTFS)
