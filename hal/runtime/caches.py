"""Velatura's files outside stages and its installation: compiled kernels, sockets, crash reports.

``python -m hal.runtime.caches`` lists them, ``python -m hal.runtime.caches remove`` removes those that no running
program uses. Imports only the standard library, so that it also works without an environment.
"""

from __future__ import annotations

import contextlib
import fcntl
import logging
import os
import shutil
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

RUNTIME: Final = "velatura-{uid}-*"
"""Folders of sockets (``controller.core.storage.runtime_folder``)."""
TEMPORARY: Final = "velatura-tmp-"
"""Prefix of temporary folders."""
SHORTEST: Final = Path("/tmp")  # noqa: S108 - mkdtemp makes the private folder in it
"""A folder with a short path, because a unix socket's path must be short."""
LOCK: Final = "lock"
"""Lock file in such a folder, held by its process."""


@dataclass(frozen=True, slots=True)
class StoredFolder:
    """A folder outside the stage: its content, its bytes, and whether a running program uses it."""

    path: Path
    what: str
    size_bytes: int
    in_use: bool


def cache_folder() -> Path:
    """Folder of compiled kernels: ``VELATURA_CACHE``, else ``velatura`` in the user's cache folder.

    Raises RuntimeError for a user without a home folder.
    """
    named = os.environ.get("VELATURA_CACHE")
    if named:
        return Path(named)
    cache_home = os.environ.get("XDG_CACHE_HOME")
    return (Path(cache_home) if cache_home else Path.home() / ".cache") / "velatura"


def state_folder() -> Path:
    """Folder of crash reports. Raises RuntimeError for a user without a home folder."""
    named = os.environ.get("XDG_STATE_HOME")
    return (Path(named) if named else Path.home() / ".local" / "state") / "velatura"


def temporary_folder() -> Path:
    """The system's folder for temporary files."""
    return Path(tempfile.gettempdir())


def runtime_base() -> Path:
    """Parent of the folders of sockets."""
    return Path(os.environ.get("XDG_RUNTIME_DIR") or tempfile.gettempdir())


def prepare_libraries() -> None:
    """Set, before matplotlib is imported, our folder for its settings and font list, instead of the user's.

    If our folder can't be written, matplotlib uses a temporary one, and its warning is not needed.
    """
    with contextlib.suppress(RuntimeError):
        os.environ.setdefault("MPLCONFIGDIR", str(cache_folder() / "matplotlib"))
    logging.getLogger("matplotlib").setLevel(logging.ERROR)


@contextlib.contextmanager
def temporary(base: Path | None = None) -> Iterator[Path]:
    """A private folder that is removed on leaving; ``remove`` finds that of a killed process. Raises ``OSError``.

    ``base``: its parent, ``SHORTEST`` for sockets; None: the system's folder for temporary files.
    """
    folder = Path(tempfile.mkdtemp(prefix=TEMPORARY, dir=base))
    try:
        with (folder / LOCK).open("wb") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def kept() -> list[StoredFolder]:
    """All existing folders."""
    found = []
    for path, what in _places():
        with contextlib.suppress(OSError):
            if path.is_dir() and not path.is_symlink() and path.stat().st_uid == os.getuid():
                found.append(StoredFolder(path, what, _size(path), in_use(path)))
    return found


def remove() -> list[StoredFolder]:
    """Remove the folders that no running program uses; returns the removed ones."""
    removed = [folder for folder in kept() if not folder.in_use]
    for folder in removed:
        shutil.rmtree(folder.path, ignore_errors=True)
    return removed


def _places() -> Iterator[tuple[Path, str]]:
    cached = "compiled kernels, light of the bench and settings of libraries"
    for folder, what in ((cache_folder, cached), (state_folder, "crash reports")):
        with contextlib.suppress(RuntimeError):
            yield folder(), what
    for base in sorted({runtime_base(), temporary_folder()}):
        yield from ((path, "sockets of a stage") for path in sorted(base.glob(RUNTIME.format(uid=os.getuid()))))
    for base in sorted({SHORTEST, temporary_folder()}):
        yield from ((path, "files of one process") for path in sorted(base.glob(f"{TEMPORARY}*")))


def in_use(folder: Path) -> bool:
    """Whether a program listens at a socket in the folder, or holds its lock."""
    lock = folder / LOCK
    if lock.is_file():
        with lock.open("rb") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
            except BlockingIOError:
                return True
    return any(str(path) in _listening() for path in folder.iterdir() if path.is_socket())


def _listening() -> set[str]:
    """Paths of the unix sockets that are open on this machine."""
    try:
        lines = Path("/proc/net/unix").read_text(errors="replace").splitlines()[1:]
    except OSError:
        return set()
    return {words[7] for line in lines if len(words := line.split(maxsplit=7)) == 8}


def _size(folder: str | Path) -> int:
    """Bytes of the files in it. Links are not followed."""
    size = 0
    with contextlib.suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            if entry.is_dir(follow_symlinks=False):
                size += _size(entry.path)
            elif entry.is_file(follow_symlinks=False):
                with contextlib.suppress(FileNotFoundError):  # its program has just removed it
                    size += entry.stat(follow_symlinks=False).st_size
    return size


def summary(found: Sequence[StoredFolder]) -> list[str]:
    """One sentence for each kind of folder, with its path if there is only one."""
    lines = []
    for what in dict.fromkeys(folder.what for folder in found):
        same = [folder for folder in found if folder.what == what]
        where = str(same[0].path) if len(same) == 1 else f"{len(same)} folders like {same[0].path}"
        used = sum(folder.in_use for folder in same)
        lines.append(f"{where}: {what}, {sum(folder.size_bytes for folder in same) / 1e6:.1f} MB, {used} in use.")
    return lines


def main(arguments: Sequence[str]) -> int:
    """The program; see the module."""
    removing = list(arguments) == ["remove"]
    for line in summary(remove() if removing else kept()):
        sys.stdout.write(f"{'Removed ' if removing else ''}{line}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
