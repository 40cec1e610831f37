"""Links to pseudo terminals with a lock of their owner.

The system gives the number of a closed terminal to the next program. The link of a killed program then leads to
another program's terminal, into which nothing may be written. So the owner of a link holds a lock as long as it owns
the terminal.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
from pathlib import Path
from typing import BinaryIO, Final

TERMINALS: Final = "/dev/pts/"


class PtyLink:
    """The link ``port`` to the terminal at ``path``, and its lock; created at once, kept until ``remove``.

    Raises ``OSError`` if it can't be created.
    """

    def __init__(self, port: Path, path: str) -> None:
        self._port = port
        port.parent.mkdir(parents=True, exist_ok=True)
        self._owner = _locked(_owner_of(port))
        # Before the link, so that a program that follows the link finds its owner.
        self._owner.write(path.encode())
        self._owner.flush()
        temporary = port.with_name(f".{port.name}.new")
        temporary.unlink(missing_ok=True)
        temporary.symlink_to(path)
        temporary.replace(port)

    def remove(self) -> None:
        """Remove the link, then release the lock."""
        self._port.unlink(missing_ok=True)
        _owner_of(self._port).unlink(missing_ok=True)
        self._owner.close()


def leads_to_its_owner(port: Path) -> bool:
    """Whether ``port`` may be opened: not our link, or one with a running owner. A link without owner is removed."""
    try:
        target = os.readlink(port)  # noqa: PTH115 - the text of the link, however it is written
    except OSError:
        return True  # no link, or a name that no file can have: opening it says what is wrong
    if not target.startswith(TERMINALS):
        return True
    try:
        owner = _owner_of(port).open("rb")
    except OSError:
        return True  # made by another program, without a lock
    with owner:
        try:
            fcntl.flock(owner, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return owner.read().decode(errors="replace") == target
        # A read-only folder keeps its stale link, which is not followed either.
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
        file.close()  # it was removed between the two calls
