"""The journal's SQLite file: its tables, opening it, and its errors."""

from __future__ import annotations

import contextlib
import sqlite3
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from controller.core.errors import WorkError
from controller.core.storage import sync_folder
from controller.run.journal_migration import from_format_1

VERSION: Final = 2
"""Format 1 is converted when it is opened (``journal_migration``)."""
APPLICATION: Final = 0x56454C41
"""SQLite's ``application_id``: "VELA"."""
BUSY_S: Final = 2.0

_RUNS_AND_EVENTS: Final = """
CREATE TABLE runs (
    id INTEGER PRIMARY KEY, name TEXT NOT NULL, pid INTEGER NOT NULL,
    began_at_s REAL NOT NULL, ended_at_s REAL, outcome TEXT
) STRICT;
CREATE TABLE events (
    id INTEGER PRIMARY KEY, run INTEGER REFERENCES runs, at_s REAL NOT NULL,
    level TEXT NOT NULL, code TEXT NOT NULL, text TEXT NOT NULL
) STRICT;
"""
_STEPS_AND_SHOTS: Final = """
CREATE TABLE steps (
    id INTEGER PRIMARY KEY AUTOINCREMENT, kind TEXT NOT NULL, projector TEXT, item TEXT,
    run INTEGER REFERENCES runs, inputs TEXT NOT NULL, began_at_s REAL NOT NULL, ended_at_s REAL NOT NULL
) STRICT;
CREATE UNIQUE INDEX step_identity ON steps (kind, ifnull(projector, ''), ifnull(item, ''));
CREATE TABLE artefacts (
    id INTEGER PRIMARY KEY, step INTEGER NOT NULL REFERENCES steps ON DELETE CASCADE,
    path TEXT NOT NULL, size INTEGER NOT NULL, sha256 TEXT NOT NULL
) STRICT;
CREATE INDEX artefacts_of_step ON artefacts (step);
CREATE TABLE shots (
    id INTEGER PRIMARY KEY, kind TEXT NOT NULL, projector TEXT, name TEXT NOT NULL,
    run INTEGER REFERENCES runs, settings TEXT NOT NULL,
    path TEXT NOT NULL, size INTEGER NOT NULL, sha256 TEXT NOT NULL, taken_at_s REAL NOT NULL
) STRICT;
CREATE UNIQUE INDEX shot_identity ON shots (kind, ifnull(projector, ''), name);
"""


class JournalError(WorkError):
    """The journal is damaged or can't be used."""


def opened(path: Path) -> sqlite3.Connection:
    """A connection to the journal at ``path``, which is created if it is missing."""
    with explained(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        database = sqlite3.connect(path, timeout=BUSY_S, check_same_thread=False)
        try:
            _prepare(database, path)
        except BaseException:
            database.close()
            raise
        return database


def _prepare(database: sqlite3.Connection, path: Path) -> None:
    database.execute("PRAGMA foreign_keys = ON")
    # Lock before reading the version: two processes that open a new journal must not both create its tables.
    database.execute("BEGIN IMMEDIATE")
    application = database.execute("PRAGMA application_id").fetchone()[0]
    version = database.execute("PRAGMA user_version").fetchone()[0]
    tables = database.execute("SELECT count(*) FROM sqlite_master").fetchone()[0]
    if tables == 0:
        for statement in (*_statements(_RUNS_AND_EVENTS), *_statements(_STEPS_AND_SHOTS)):
            database.execute(statement)
        database.execute(f"PRAGMA application_id = {APPLICATION}")
        database.execute(f"PRAGMA user_version = {VERSION}")
    else:
        _check(database, path, application, version)
        if version == 1:
            from_format_1(database, _statements(_STEPS_AND_SHOTS))
            database.execute(f"PRAGMA user_version = {VERSION}")
    database.commit()
    database.execute("PRAGMA journal_mode = WAL")
    database.execute("PRAGMA synchronous = FULL")
    sync_folder(path.parent)


def _statements(text: str) -> list[str]:
    return [statement for part in text.split(";\n") if (statement := part.strip())]


def _check(database: sqlite3.Connection, path: Path, application: int, version: int) -> None:
    if application != APPLICATION:
        raise JournalError(
            "journal-not-ours",
            what=f"{path} is a database of another program.",
            remedy="Move it out of the run's folder and start again.",
        )
    if version not in (1, VERSION):
        raise JournalError(
            "journal-version",
            what=f"{path} has format {version}, from another version of Velatura; this version reads {VERSION}.",
            remedy="Use the version that started this run, or start a new run.",
        )
    if (verdict := database.execute("PRAGMA quick_check(1)").fetchone()[0]) != "ok":
        raise _damaged(path, str(verdict))


@contextlib.contextmanager
def explained(path: Path) -> Iterator[None]:
    """Convert SQLite's errors to errors with a code and a remedy."""
    try:
        yield
    except sqlite3.Error as error:
        raise _typed(path, error) from error
    except OSError as error:
        raise _unusable(path, error.strerror or str(error)) from error


def _typed(path: Path, error: sqlite3.Error) -> WorkError:
    primary = getattr(error, "sqlite_errorcode", 0) & 0xFF
    if primary in (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED):
        return JournalError(
            "journal-locked",
            what=f"Another process is writing to {path}.",
            remedy="Wait for the other run on this stage to end, or stop it, then start again.",
        )
    if primary == sqlite3.SQLITE_FULL:
        return WorkError(
            "no-space",
            what=f"The disk has no space for {path.name}.",
            remedy=f"Free space on the disk of {path.parent} and start again. Finished steps are kept.",
        )
    if primary in (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB):
        return _damaged(path, str(error))
    return _unusable(path, str(error))


def _unusable(path: Path, detail: str) -> JournalError:
    return JournalError(
        "journal-unusable",
        what=f"{path} could not be used ({detail}).",
        remedy="Check the folder's permissions and that its disk is writable, then start again.",
    )


def _damaged(path: Path, detail: str) -> JournalError:
    return JournalError(
        "journal-damaged",
        what=f"The journal {path} is damaged ({detail}).",
        remedy="Move it out of the run's folder and start again. All steps are repeated.",
    )
