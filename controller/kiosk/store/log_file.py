"""The SQLite file of the event log, and what becomes of it when it is damaged or the disk is full."""

from __future__ import annotations

import contextlib
import shutil
import sqlite3
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Final, NamedTuple

from controller.core.storage import make_folder
from controller.kiosk.state import EventLevel, EventRow

MOST_EVENTS: Final = 20_000
MOST_DONE: Final = 400
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


class Content(NamedTuple):
    """What a file gets: events, oldest first; how each task was ended, the newest last; values by name."""

    events: Sequence[EventRow]
    done: Mapping[str, str]
    kept: Mapping[str, str]


class LogFile:
    """Not for two threads at once. A damaged file is renamed and replaced, at no moment of which a power cut loses it.

    ``problem``: why it could not be opened, or not be read whole; None if it was
    ``available``: False while it can't be opened, as on a full disk: what is read is a copy in memory
    ``torn``: a part of it can't be read, so that it must take no new events
    """

    def __init__(
        self, path: Path, *, wall: Callable[[], float], durable: bool, connect: Callable[..., sqlite3.Connection]
    ) -> None:
        """``durable``: what is written survives a power cut, too. ``connect``: as ``sqlite3.connect``."""
        self.path, self._wall, self._durable, self._connect = path, wall, durable, connect
        self.problem: str | None = None
        self.available, self.torn = True, False
        self._database = self._opened()

    # -- reading, once

    def events(self, most: int) -> list[EventRow]:
        """The newest, oldest first."""
        newest = "SELECT number, unix_s, level, text, code FROM events ORDER BY number DESC"
        # Not a limit of the statement, which would count rows that can't be read.
        rows = self._query(newest, int, float, str, str, str, most=most)
        return [EventRow(n, s, _LEVELS.get(level, "info"), text, code) for n, s, level, text, code in reversed(rows)]

    def done(self) -> dict[str, str]:
        """How each task was ended, the newest last."""
        return dict(self._query("SELECT key, how FROM done ORDER BY number", str, str))

    def kept(self) -> dict[str, str]:
        """The values by name."""
        return dict(self._query("SELECT name, value FROM kept", str, str))

    def last_number(self, newest: int) -> int:
        """The largest number that an event has had; ``newest``: that of the newest event that could be read, or 0."""
        rows = self._query("SELECT seq FROM sqlite_sequence WHERE name = 'events'", int)
        if rows and rows[0][0] >= newest:
            return int(rows[0][0])
        # After a damaged or unreadable log, numbers continue far above all that it can have had. Where a page is read
        # as zeros, only the number may be gone.
        lost = newest or not self.available or self.torn or list(self.path.parent.glob("*.damaged-*"))
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
                    self.torn = True
        except sqlite3.Error as error:
            self.problem, self.torn = str(error), self.torn or _is_corrupt(error)
        return rows

    # -- writing

    def write(self, new: Content, *, trim: bool) -> None:
        """Add what is ``new``. ``trim``: what is older than is kept is removed. Raises sqlite3.Error and OSError."""
        with self._database as database:
            _write(database, new)
            if trim:
                # Rows are counted, because after a damaged log numbers continue far above those that were kept.
                for table, most in (("events", MOST_EVENTS), ("done", MOST_DONE)):
                    database.execute(_TRIM.format(table=table), (most,))

    def open_again(self, known: Content) -> None:
        """Open a file that was not available. Raises sqlite3.Error and OSError."""
        if self.torn:
            # It would take new events, and lose some of them. So would a new one from before: not all is in it.
            self._replace(known)
        else:
            self._end_replacing()
        self._database, self.available = self._connected(self.path), True

    def is_lost(self, error: Exception) -> bool:
        """Whether a write failed because the file is damaged, and not because the disk is full."""
        # Not available: it was full when the kiosk began, and now it can be opened no better.
        damaged = _is_corrupt if self.available else _is_damage
        return isinstance(error, sqlite3.Error) and damaged(error)

    def put_aside(self, known: Content) -> bool:
        """Of a file that can be read in part, but takes nothing any more: all that is ``known`` goes into a new one.

        False: there is no space for it; then it must be written again when there is.
        """
        with contextlib.suppress(sqlite3.Error):
            self._database.close()
        self.torn = True
        try:
            self._replace(known)
            self._database, self.available = self._connected(self.path), True
        except (sqlite3.Error, OSError):
            self._database, self.available = self._connected(Path(":memory:")), False
        return self.available

    def close(self) -> None:
        self._database.close()

    # -- opening

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
            self.available = False
            return self._copied()

    def _connected(self, path: Path) -> sqlite3.Connection:
        if str(path) != ":memory:":
            make_folder(path.parent)
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

    def _copied(self) -> sqlite3.Connection:
        """An in-memory copy of a log that can be read but not opened, as on a full disk."""
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

    # -- replacing

    def _replace(self, known: Content) -> None:
        """Raises sqlite3.Error and OSError; then the old file is still in its place, or the new one is whole."""
        self._remove(self._new)
        with contextlib.closing(self._connected(self._new)) as database:
            with database:
                _write(database, known)
                database.execute(f"PRAGMA user_version={_WHOLE}")
            _without_write_ahead_log(database)
        self._take_new()
        self.torn = False

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


def _write(database: sqlite3.Connection, new: Content) -> None:
    for row in new.events:
        database.execute(
            "INSERT OR IGNORE INTO events VALUES (?, ?, ?, ?, ?)",
            (row.number, row.unix_s, row.level, row.code, row.text),
        )
    for done in new.done.items():
        database.execute("INSERT OR REPLACE INTO done (key, how) VALUES (?, ?)", done)
    for kept in new.kept.items():
        database.execute("INSERT OR REPLACE INTO kept VALUES (?, ?)", kept)


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
