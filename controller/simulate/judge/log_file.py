"""What is left in the file of an event log that was damaged: read a second time, without the kiosk's code."""

from __future__ import annotations

import contextlib
import sqlite3
import tempfile
from pathlib import Path


def readable(file: Path) -> dict[int, str]:
    """The texts of its events by their numbers: all, or the newest ones as far as the first that can't be read."""
    texts: dict[int, str] = {}
    with tempfile.TemporaryDirectory() as name:
        copy = Path(name) / file.name
        for end in ("", "-wal"):
            if (part := file.with_name(f"{file.name}{end}")).is_file():
                copy.with_name(f"{copy.name}{end}").write_bytes(part.read_bytes())
        with contextlib.suppress(sqlite3.Error, UnicodeDecodeError), contextlib.closing(sqlite3.connect(copy)) as rows:
            for number, text in rows.execute("SELECT number, text FROM events ORDER BY number DESC"):
                texts[number] = text
    return texts
