"""Links to pseudo terminals that know their owner.

The system gives the number of a closed terminal to the next program that asks for one. A link that a killed program
left then leads to a stranger's terminal, into which nothing may be written. So whoever makes such a link holds a lock
beside it for as long as the terminal is its own.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
from pathlib import Path
from typing import BinaryIO, Final

TERMINALS: Final = "/dev/pts/"


class PtyLink:
    """The link ``port`` to the terminal at ``path``, and its lock; made at once, and there until ``remove``.

    Raises ``OSError`` where it can't be made.
    """

    def __init__(self, port: Path, path: str) -> None:
        self._port = port
        port.parent.mkdir(parents=True, exist_ok=True)
        self._owner = _locked(_owner_of(port))
        # Before the link, so that whoever follows the link finds its owner.
        self._owner.write(path.encode())
        self._owner.flush()
        temporary = port.with_name(f".{port.name}.new")
        temporary.unlink(missing_ok=True)
        temporary.symlink_to(path)
        temporary.replace(port)

    def remove(self) -> None:
        """Remove the link, then let go of the lock."""
        self._port.unlink(missing_ok=True)
        _owner_of(self._port).unlink(missing_ok=True)
        self._owner.close()


def leads_to_its_owner(port: Path) -> bool:
    """Whether ``port`` may be opened: no link of ours, or one whose owner lives. One without its owner is removed."""
    if not port.is_symlink():
        return True
    target = os.readlink(port)  # noqa: PTH115 - the text of the link, however it is written
    if not target.startswith(TERMINALS):
        return True
    try:
        owner = _owner_of(port).open("rb")
    except OSError:
        return True  # made by another program, which says nothing of itself
    with owner:
        try:
            fcntl.flock(owner, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return owner.read().decode(errors="replace") == target
        # A folder that can't be written to keeps its stale link, which is not followed all the same.
        with contextlib.suppress(OSError):
            port.unlink(missing_ok=True)
            _owner_of(port).unlink(missing_ok=True)
    return False


def _owner_of(port: Path) -> Path:
    return port.with_name(f".{port.name}.owner")


def _locked(path: Path) -> BinaryIO:
    """The file, new or emptied, with its lock held."""
    while True:
        file = path.open("ab")
        fcntl.flock(file, fcntl.LOCK_EX)
        with contextlib.suppress(FileNotFoundError):
            if path.stat().st_ino == os.fstat(file.fileno()).st_ino:
                file.truncate(0)
                return file
        file.close()  # somebody removed it between the two
