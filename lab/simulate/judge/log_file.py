"""What is in the file of an event log, also of a damaged one: read a second time, without the kiosk's code."""

from __future__ import annotations

import contextlib
import sqlite3
import tempfile
from pathlib import Path
from typing import Final

PAGE_BYTES: Final = 4096
_HEADER_BYTES: Final = 32
_FRAME_BYTES: Final = 24


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


def pages_of(write_ahead_log: Path) -> list[int]:
    """The numbers of the pages that it has: those that were written last."""
    content = write_ahead_log.read_bytes() if write_ahead_log.is_file() else b""
    frames = range(_HEADER_BYTES, len(content) - _FRAME_BYTES - PAGE_BYTES + 1, _FRAME_BYTES + PAGE_BYTES)
    return sorted({int.from_bytes(content[at : at + 4], "big") for at in frames})
