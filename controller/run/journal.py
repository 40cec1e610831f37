"""The journal of a run in SQLite: finished steps, their inputs and their results.

It stays correct after a power cut, because an artefact is written first, atomically and with fsync, then its row. A row
whose artefact is missing or changed counts as not done.
"""

from __future__ import annotations

import contextlib
import json
import os
import sqlite3
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from controller.core.errors import WorkError
from controller.core.storage import make_folder, sha256_of, sync_folder
from controller.core.text import well_formed
from controller.run.state_machine import Change
from controller.run.step_id import ShotId, StepId
from hal.notices import Level

Inputs = Mapping[str, str]
"""Name of an input -> its hash (or the value itself, if it is short)."""


@dataclass(frozen=True, slots=True)
class Artefact:
    """A file written by a step or a shot. ``sha256`` is the hex digest of its bytes."""

    path: Path
    size: int
    sha256: str


@dataclass(frozen=True, slots=True)
class StepResult:
    """``repeated`` False: an earlier run had done the step, and its artefacts still match."""

    artefacts: tuple[Artefact, ...]
    repeated: bool


@dataclass(frozen=True, slots=True)
class JournalEvent:
    """One line of the log. ``at_s`` is wall-clock time (Unix seconds) and may jump with the computer's clock."""

    at_s: float
    level: str
    code: str
    text: str


class Journal:
    """The journal beside a run's artefacts; safe to use from several threads, written by one process at a time.

    Paths are relative to the journal's folder, so a stage may be moved. Timestamps are wall-clock Unix seconds, only
    for people: no decision depends on them.
    """

    FILE: Final = "journal.sqlite"

    def __init__(self, folder: Path) -> None:
        """Open or create the journal of the run in ``folder``.

        Raises JournalError with code "journal-damaged", "journal-locked", "journal-version" or "journal-not-ours", and
        WorkError("no-space").
        """
        self.folder = folder.resolve()
        self.path = self.folder / self.FILE
        self._lock = threading.RLock()
        self._database = _opened(self.path)
        self._run: int | None = None

    def __enter__(self) -> Journal:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file. May be called twice."""
        with self._lock:
            self._database.close()

    # -- runs: every start of the program on this folder

    @contextlib.contextmanager
    def run(self, name: str) -> Iterator[int]:
        """Record a start and its outcome: "done", or the error's code (a killed run keeps none). Yields its number."""
        self._run = self._write("INSERT INTO runs (name, pid, began_at_s) VALUES (?, ?, ?)", name, os.getpid(), _now())
        try:
            yield self._run
        except BaseException as error:
            try:
                self._end(getattr(error, "code", None) or type(error).__name__)
            except WorkError as second:  # must not hide the first error
                error.add_note(f"The error could not be written to the journal: {second}")
            raise
        self._end("done")

    def outcomes(self) -> list[tuple[str, str | None]]:
        """Name and outcome of every start, oldest first; outcome None for one that was killed or is running."""
        return [(row[0], row[1]) for row in self._read("SELECT name, outcome FROM runs ORDER BY id")]

    # -- steps

    def step(self, step: StepId, inputs: Inputs, run: Callable[[], Sequence[Path]]) -> StepResult:
        """Do a step once: skip it if it was done with the same inputs and its artefacts still match, else run it.

        ``run`` writes the artefacts and returns their paths; it may be called again after a kill at any moment.
        """
        done = self.done(step, inputs)
        if done is not None:
            return StepResult(done, repeated=False)
        began_at_s = _now()
        paths = run()
        return StepResult(self.complete(step, inputs, paths, began_at_s=began_at_s), repeated=True)

    def done(self, step: StepId, inputs: Inputs) -> tuple[Artefact, ...] | None:
        """The artefacts of a step that was done with these inputs and whose files still match; else None."""
        rows = self._read(_STEP, *_step(step))
        return self.latest(step) if rows and rows[0][1] == _canonical(inputs) else None

    def latest(self, step: StepId) -> tuple[Artefact, ...] | None:
        """The artefacts of a step with any inputs; None if it was not done or its files do not match."""
        rows = self._read(_STEP, *_step(step))
        if not rows:
            return None
        kept = self._read("SELECT path, size, sha256 FROM artefacts WHERE step = ? ORDER BY id", rows[0][0])
        artefacts = tuple(Artefact(self._absolute(path), size, digest) for path, size, digest in kept)
        return artefacts if all(map(_still_matches, artefacts)) else None

    def complete(
        self, step: StepId, inputs: Inputs, paths: Sequence[Path], *, began_at_s: float
    ) -> tuple[Artefact, ...]:
        """Make the artefacts durable, then write their row. Raises JournalError("artefact-missing")."""
        artefacts = tuple(_durable(path.absolute()) for path in paths)
        with self._transaction() as database:
            database.execute(_DELETE_STEP, _step(step))
            row = database.execute(
                "INSERT INTO steps (kind, projector, item, run, inputs, began_at_s, ended_at_s)"
                " VALUES (?, ?, ?, ?, ?, ?, ?)",
                (*_step(step), self._run, _canonical(inputs), began_at_s, _now()),
            ).lastrowid
            database.executemany(
                "INSERT INTO artefacts (step, path, size, sha256) VALUES (?, ?, ?, ?)",
                [(row, self._relative(item.path), item.size, item.sha256) for item in artefacts],
            )
        return artefacts

    def steps(self) -> dict[StepId, float]:
        """Seconds that each recorded step took, in the order in which they ended."""
        rows = self._read("SELECT kind, projector, item, ended_at_s - began_at_s FROM steps ORDER BY id")
        return {StepId(kind, projector, item): max(0.0, float(seconds)) for kind, projector, item, seconds in rows}

    # -- shots: photographs take minutes, so each has its own journal entry

    def shot(self, shot: ShotId, settings: Inputs) -> Artefact | None:
        """The photograph if it was taken with these settings and its file still matches; else None."""
        rows = self._read(_SHOT, *_shot(shot))
        if not rows or rows[0][0] != _canonical(settings):
            return None
        artefact = Artefact(self._absolute(rows[0][1]), rows[0][2], rows[0][3])
        return artefact if _still_matches(artefact) else None

    def record_shot(self, shot: ShotId, settings: Inputs, path: Path) -> Artefact:
        """Make a photograph durable, then write its row. Raises JournalError("artefact-missing")."""
        artefact = _durable(path.absolute())
        self._write(
            "INSERT OR REPLACE INTO shots (kind, projector, name, run, settings, path, size, sha256, taken_at_s)"
            " VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)",
            *(*_shot(shot), self._run, _canonical(settings)),
            *(self._relative(artefact.path), artefact.size, artefact.sha256, _now()),
        )
        return artefact

    def shot_count(self) -> int:
        """Number of photographs in the journal."""
        return int(self._read("SELECT COUNT(*) FROM shots")[0][0])

    def shot_counts(self) -> dict[tuple[str, str], int]:
        """Number of photographs by kind and projector ("" where they are of none alone)."""
        rows = self._read("SELECT kind, projector, COUNT(*) FROM shots GROUP BY kind, projector")
        return {(str(kind), str(projector or "")): int(count) for kind, projector, count in rows}

    # -- events

    def record(self, code: str, text: str, level: Level = Level.INFO) -> None:
        """Write one event: a device error, a retry, a decision. ``text`` may contain a device's text."""
        self._write(
            "INSERT INTO events (run, at_s, level, code, text) VALUES (?, ?, ?, ?, ?)",
            *(self._run, _now(), level.value, code, well_formed(text)),
        )

    def record_change(self, change: Change) -> None:
        """A listener for ``Machine``."""
        reason = f": {change.reason}" if change.reason else ""
        self.record("state", f"{change.before.value} -> {change.after.value} ({change.event.value}){reason}")

    def events(self) -> list[JournalEvent]:
        """Every event, oldest first."""
        return [JournalEvent(*row) for row in self._read("SELECT at_s, level, code, text FROM events ORDER BY id")]

    # -- inside

    def _end(self, outcome: str) -> None:
        run, self._run = self._run, None
        self._write("UPDATE runs SET ended_at_s = ?, outcome = ? WHERE id = ?", _now(), outcome, run)

    def _relative(self, path: Path) -> str:
        return os.path.relpath(path, self.folder)

    def _absolute(self, path: str) -> Path:
        return Path(os.path.normpath(self.folder / path))

    def _read(self, statement: str, *values: object) -> list[Any]:
        with self._transaction() as database:
            return database.execute(statement, values).fetchall()

    def _write(self, statement: str, *values: object) -> int:
        with self._transaction() as database:
            return database.execute(statement, values).lastrowid or 0

    @contextlib.contextmanager
    def _transaction(self) -> Iterator[sqlite3.Connection]:
        with self._lock, _explained(self.path), self._database:
            yield self._database


_STEP: Final = "SELECT id, inputs FROM steps WHERE kind = ? AND projector IS ? AND item IS ?"
_DELETE_STEP: Final = "DELETE FROM steps WHERE kind = ? AND projector IS ? AND item IS ?"
_SHOT: Final = "SELECT settings, path, size, sha256 FROM shots WHERE kind = ? AND projector IS ? AND name = ?"


def _step(step: StepId) -> tuple[str, str | None, str | None]:
    return str(step.kind), step.projector, step.item


def _shot(shot: ShotId) -> tuple[str, str | None, str]:
    return str(shot.kind), shot.projector, shot.name


def _now() -> float:
    return time.time()


def _canonical(inputs: Inputs) -> str:
    return json.dumps(dict(inputs), sort_keys=True, ensure_ascii=False)


def _still_matches(artefact: Artefact) -> bool:
    try:
        return artefact.path.stat().st_size == artefact.size and sha256_of(artefact.path) == artefact.sha256
    except OSError:
        return False


def _durable(path: Path) -> Artefact:
    """Fsync a file and its folder, and hash it."""
    try:
        with path.open("rb") as file:
            os.fsync(file.fileno())
        sync_folder(path.parent)
        return Artefact(path, path.stat().st_size, sha256_of(path))
    except OSError as error:
        raise JournalError(
            "artefact-missing",
            what=f"The file {path.name}, written by a step, can't be read ({error.strerror}).",
            remedy="Check the disk and start again. The step is repeated.",
        ) from error


_VERSION: Final = 2
"""SQLite's ``user_version``."""
_APPLICATION: Final = 0x56454C41
"""SQLite's ``application_id``: "VELA"."""
BUSY_S: Final = 2.0

_TABLES: Final = """
CREATE TABLE runs (
    id INTEGER PRIMARY KEY, name TEXT NOT NULL, pid INTEGER NOT NULL,
    began_at_s REAL NOT NULL, ended_at_s REAL, outcome TEXT
) STRICT;
CREATE TABLE events (
    id INTEGER PRIMARY KEY, run INTEGER REFERENCES runs, at_s REAL NOT NULL,
    level TEXT NOT NULL, code TEXT NOT NULL, text TEXT NOT NULL
) STRICT;
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
CREATE UNIQUE INDEX shot_identity ON shots (kind, ifnull(projector, ''), name)
"""


class JournalError(WorkError):
    """The journal is damaged or can't be used."""


def _opened(path: Path) -> sqlite3.Connection:
    """A connection to the journal at ``path``, which is created if it is missing."""
    with _explained(path):
        make_folder(path.parent)
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
        for statement in _TABLES.strip().split(";\n"):
            database.execute(statement)
        database.execute(f"PRAGMA application_id = {_APPLICATION}")
        database.execute(f"PRAGMA user_version = {_VERSION}")
    else:
        _check(database, path, application, version)
    database.commit()
    database.execute("PRAGMA journal_mode = WAL")
    database.execute("PRAGMA synchronous = FULL")
    sync_folder(path.parent)


def _check(database: sqlite3.Connection, path: Path, application: int, version: int) -> None:
    if application != _APPLICATION:
        raise JournalError(
            "journal-not-ours",
            what=f"{path} is a database of another program.",
            remedy="Move it out of the run's folder and start again.",
        )
    if version != _VERSION:
        raise JournalError(
            "journal-version",
            what=f"{path} has format {version}, from another version of Velatura; this version reads {_VERSION}.",
            remedy="Use the version that started this run, or start a new run.",
        )
    if (verdict := database.execute("PRAGMA quick_check(1)").fetchone()[0]) != "ok":
        raise _damaged(path, str(verdict))


@contextlib.contextmanager
def _explained(path: Path) -> Iterator[None]:
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
