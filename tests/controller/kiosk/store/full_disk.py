"""A disk that has no space for a log, as SQLite finds it."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

FULL = "database or disk is full", sqlite3.SQLITE_FULL


def without_space(
    is_full: Sequence[bool], only: Path | None = None, says: tuple[str, int] = FULL
) -> Callable[..., sqlite3.Connection]:
    """As ``sqlite3.connect``, but files can't be opened while the disk ``is_full``; ``only``: this one can't."""

    def connect(database: Any, **options: Any) -> sqlite3.Connection:
        if is_full and (str(database) != ":memory:" if only is None else database == only):
            error = sqlite3.OperationalError(says[0])
            error.sqlite_errorcode = says[1]
            raise error
        found: sqlite3.Connection = sqlite3.connect(database, **options)
        return found

    return connect
