"""The processes that a process has started."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path


def children(pid: int | None = None) -> list[int]:
    """Processes that a process (``None``: this one) has started, and those that these have; each may end meanwhile."""
    pid = os.getpid() if pid is None else pid
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError, ValueError, IndexError):
            if int((folder / "stat").read_text().rpartition(")")[2].split()[1]) == pid:
                found += [*children(int(folder.name)), int(folder.name)]
    return found


def command_of(pid: int) -> str:
    """The words of its command line, with spaces; empty where it has ended."""
    try:
        return Path(f"/proc/{pid}/cmdline").read_text().replace("\0", " ")
    except OSError:
        return ""
