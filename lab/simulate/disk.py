"""The disk of a simulated kiosk: real files in memory, whose operations may be refused, or be the last before a kill.

Python reports every file that it opens, renames or removes (audit events), before it does; SQLite is asked through a
connection of our own. So the kiosk's code writes as always.
"""

from __future__ import annotations

import contextlib
import errno
import functools
import os
import sqlite3
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

from lab.simulate.scheduler import Killed, Scheduler

STAGE: Final = Path("stage")
"""Relative, because paths stand in events, which have to be the same wherever it runs."""
TOTAL_BYTES: Final = 64_000_000_000
_WRITES: Final = os.O_WRONLY | os.O_RDWR | os.O_CREAT
_CHANGES: Final = frozenset({"os.rename", "os.remove", "os.mkdir", "os.symlink", "os.truncate", "os.rmdir"})


class Disk:
    """``full``: nothing can be written; ``blind``: no bundle can be read; ``free_bytes``: what it tells;
    ``kill_after``: so many more operations happen before the program that does the next one is killed; ``refused_s``:
    when it had no room last.
    """

    def __init__(self, scheduler: Scheduler) -> None:
        self._scheduler = scheduler
        self.full = self.blind = False
        self.free_bytes = TOTAL_BYTES // 2
        self.kill_after: int | None = None
        self.refused_s = 0.0
        self._outside = 0

    @contextlib.contextmanager
    def untouched(self) -> Iterator[None]:
        """What happens inside is done by another program of the computer: kills do not meet it, a full disk does."""
        self._outside += 1
        try:
            yield
        finally:
            self._outside -= 1

    def alive(self) -> None:
        """Raises Killed in a task whose program is."""
        self._scheduler.check()

    def changes(self, *, takes_space: bool = True) -> None:
        """The present task is about to change a file. Raises OSError and Killed."""
        program = self._scheduler.present.program
        if self._outside and takes_space:
            self._refuse()
        if program is None or self._outside:
            return
        self._scheduler.check()
        if self.kill_after is not None:
            self.kill_after -= 1
            if self.kill_after < 0:
                self.kill_after = None
                self._scheduler.kill(program)
                raise Killed
        if takes_space:
            self._refuse()

    def _refuse(self) -> None:
        if self.full:
            self.refused_s = self._scheduler.now_s
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def reads(self, path: str) -> None:
        """Somebody is about to read this file. Raises OSError, but not for what is done from outside the computer."""
        inside = self._scheduler.present.program is not None or self._outside
        if self.blind and inside and path.endswith(".vel"):
            raise OSError(errno.EIO, os.strerror(errno.EIO))

    def connect(self, *arguments: Any, **settings: Any) -> sqlite3.Connection:
        """As ``sqlite3.connect``."""
        made: Any = sqlite3.Connection
        if str(arguments[0]) != ":memory:":
            made = functools.partial(Database, self)
        connection: sqlite3.Connection = sqlite3.connect(*arguments, factory=made, **settings)
        return connection


class Database(sqlite3.Connection):
    """A connection whose changes ask the disk."""

    def __init__(self, disk: Disk, *arguments: Any, **settings: Any) -> None:
        self._disk = disk
        super().__init__(*arguments, **settings)

    def execute(self, sql: str, *rest: Any) -> sqlite3.Cursor:
        if not sql.startswith("SELECT"):
            self._asked()
        return super().execute(sql, *rest)

    def executescript(self, script: str) -> sqlite3.Cursor:
        self._asked()
        return super().executescript(script)

    def close(self) -> None:
        # A killed program closes nothing, so what SQLite does then is not done either.
        self._disk.alive()
        super().close()

    def _asked(self) -> None:
        try:
            self._disk.changes()
        except OSError as error:
            full = sqlite3.OperationalError("database or disk is full")
            full.sqlite_errorcode = sqlite3.SQLITE_FULL
            raise full from error


_watched: list[tuple[Disk, tuple[str, str]]] = []
"""The disk of the life that runs, and how its paths begin; audit hooks can't be taken away again, so there is one."""
_hooked: list[bool] = []


@contextlib.contextmanager
def watched(disk: Disk) -> Iterator[None]:
    """The disk hears of the file operations of this process below the present folder."""
    if not _hooked:
        _hooked.append(True)
        sys.addaudithook(_heard)
    _watched.append((disk, (f"{STAGE}/", f"{STAGE.absolute()}/")))
    try:
        yield
    finally:
        _watched.pop()


def _heard(event: str, arguments: tuple[Any, ...]) -> None:
    if not _watched:
        return
    if event == "open":
        changes = bool(arguments[2] & _WRITES) if isinstance(arguments[2], int) else False
    else:
        changes = event in _CHANGES
    if (changes or event == "open") and isinstance(arguments[0], str | Path):
        disk, beginnings = _watched[-1]
        path = str(arguments[0])
        if path.startswith(beginnings):
            disk.changes(takes_space=_takes_space(event, arguments, path)) if changes else disk.reads(path)


def _takes_space(event: str, arguments: tuple[Any, ...], path: str) -> bool:
    """A lock that is there, and a folder that is, are opened and "made" again on a full disk, too."""
    if event == "open":
        return bool(arguments[2] & (os.O_TRUNC | os.O_APPEND | os.O_EXCL)) or not os.path.lexists(path)
    return event != "os.mkdir" or not os.path.isdir(path)  # noqa: PTH112 - text, and called for each change
