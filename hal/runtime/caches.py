"""What Velatura keeps outside a stage's folder and its own installation: compiled kernels, sockets, crash reports.

``python -m hal.runtime.caches`` lists it, ``python -m hal.runtime.caches remove`` removes what no running
program uses. Imports nothing beyond the standard library, so that it also works without an environment.
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
"""How temporary folders begin."""
SHORTEST: Final = Path("/tmp")  # noqa: S108 - mkdtemp makes the private folder in it
"""Where a folder's path is short, because that of a unix socket must be."""
LOCK: Final = "lock"
"""In such a folder: held by its process."""


@dataclass(frozen=True, slots=True)
class Kept:
    """A folder outside the stage: what lies in it, its bytes, and whether a running program uses it."""

    path: Path
    what: str
    size_bytes: int
    in_use: bool


def cache_folder() -> Path:
    """Where compiled kernels are kept: ``VELATURA_CACHE``, else ``velatura`` in the user's cache folder.

    Raises RuntimeError for a user without a home folder.
    """
    named = os.environ.get("VELATURA_CACHE")
    if named:
        return Path(named)
    cache_home = os.environ.get("XDG_CACHE_HOME")
    return (Path(cache_home) if cache_home else Path.home() / ".cache") / "velatura"


def state_folder() -> Path:
    """Where crash reports go. Raises RuntimeError for a user without a home folder."""
    named = os.environ.get("XDG_STATE_HOME")
    return (Path(named) if named else Path.home() / ".local" / "state") / "velatura"


def temporary_folder() -> Path:
    """The system's folder for temporary files."""
    return Path(tempfile.gettempdir())


def runtime_base() -> Path:
    """Where folders of sockets are made."""
    return Path(os.environ.get("XDG_RUNTIME_DIR") or tempfile.gettempdir())


def prepare_libraries() -> None:
    """Let matplotlib, before it is imported, keep its settings and font list in our folder, not in the user's.

    Where that can't be written it makes a temporary one for itself, and need not say so.
    """
    with contextlib.suppress(RuntimeError):
        os.environ.setdefault("MPLCONFIGDIR", str(cache_folder() / "matplotlib"))
    logging.getLogger("matplotlib").setLevel(logging.ERROR)


@contextlib.contextmanager
def temporary(base: Path | None = None) -> Iterator[Path]:
    """A private folder that is removed on leaving; of a killed process, ``remove`` finds it. Raises ``OSError``.

    ``base``: where, ``SHORTEST`` for one that is to hold sockets; None: the system's folder for temporary files.
    """
    folder = Path(tempfile.mkdtemp(prefix=TEMPORARY, dir=base))
    try:
        with (folder / LOCK).open("wb") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def kept() -> list[Kept]:
    """Everything that is there now."""
    found = []
    for path, what in _places():
        with contextlib.suppress(OSError):
            if path.is_dir() and not path.is_symlink() and path.stat().st_uid == os.getuid():
                found.append(Kept(path, what, _size(path), _in_use(path)))
    return found


def remove() -> list[Kept]:
    """Remove what no running program uses; returns what was removed."""
    removed = [one for one in kept() if not one.in_use]
    for one in removed:
        shutil.rmtree(one.path, ignore_errors=True)
    return removed


def _places() -> Iterator[tuple[Path, str]]:
    for folder, what in ((cache_folder, "compiled kernels and settings of libraries"), (state_folder, "crash reports")):
        with contextlib.suppress(RuntimeError):
            yield folder(), what
    for base in sorted({runtime_base(), temporary_folder()}):
        yield from ((path, "sockets of a stage") for path in sorted(base.glob(RUNTIME.format(uid=os.getuid()))))
    for base in sorted({SHORTEST, temporary_folder()}):
        yield from ((path, "files of one process") for path in sorted(base.glob(f"{TEMPORARY}*")))


def _in_use(folder: Path) -> bool:
    """Whether a program listens at a socket in it, or holds its lock."""
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


def _size(folder: Path) -> int:
    return sum(path.lstat().st_size for path in folder.rglob("*") if path.is_file())


def summary(found: Sequence[Kept]) -> list[str]:
    """One sentence for each kind of folder, with its place where there is only one."""
    lines = []
    for what in dict.fromkeys(one.what for one in found):
        same = [one for one in found if one.what == what]
        where = str(same[0].path) if len(same) == 1 else f"{len(same)} folders like {same[0].path}"
        used = sum(one.in_use for one in same)
        lines.append(f"{where}: {what}, {sum(one.size_bytes for one in same) / 1e6:.1f} MB, {used} in use.")
    return lines


def main(arguments: Sequence[str]) -> int:
    """The program; see the module."""
    removing = list(arguments) == ["remove"]
    for line in summary(remove() if removing else kept()):
        sys.stdout.write(f"{'Removed ' if removing else ''}{line}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
