"""Files that survive a power cut: temporary name, fsync, rename, fsync of the folder; hashes, locks, sockets."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import hashlib
import os
import socket
import stat
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO, Final

from controller.core import kiosk_places
from controller.core.errors import UsageError, WorkError


def write_atomically(path: Path, data: bytes, *, mode: int = 0o644) -> None:
    """Replace ``path`` by ``data`` so that a reader, or a machine after a power cut, finds the old or the new bytes.

    Raises WorkError("no-space") when the disk is full; ``path`` is then unchanged.
    """
    stream_atomically(path, lambda file: file.write(data), mode=mode)


def stream_atomically(path: Path, write: Callable[[BinaryIO], object], *, mode: int = 0o644) -> None:
    """As ``write_atomically``, for content that ``write`` writes to an open binary file."""
    temporary: Path | None = None
    try:
        make_folder(path.parent)
        handle, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".part", dir=path.parent)
        temporary = Path(name)
        with os.fdopen(handle, "wb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        temporary.chmod(mode)
        temporary.replace(path)
    except OSError as error:
        raise _explained(error, path) from error
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)
    sync_folder(path.parent)


def clear_unfinished_writes(folder: Path) -> None:
    """Remove the temporary files of a killed process below ``folder``; no process may be writing there."""
    for temporary in folder.rglob(".*.part"):
        temporary.unlink(missing_ok=True)


def make_folder(folder: Path, mode: int = 0o777) -> None:
    """Make a folder, and those above it, where they are missing, so that none is lost in a power cut."""
    if not folder.is_dir():
        make_folder(folder.parent)
        folder.mkdir(mode, exist_ok=True)
        sync_folder(folder.parent)


def sync_folder(folder: Path) -> None:
    """Make the names in ``folder`` durable."""
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _explained(error: OSError, path: Path) -> WorkError:
    # EFBIG: a limit on the size of files, of the user's or the disk's format (FAT: 4 GiB).
    if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        return WorkError(
            "no-space",
            what=f"The disk has no space for {path.name}.",
            remedy=f"Free space on the disk of {path.parent} and start again.",
        )
    return WorkError(
        "cannot-write",
        what=f"{path} could not be written: {error.strerror}.",
        remedy="Check the folder's permissions and that its disk is writable.",
    )


def sha256_of(path: Path) -> str:
    """Hex SHA-256 of a file's bytes, read in blocks."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


@contextlib.contextmanager
def exclusive(path: Path, *, what_is_running: str) -> Iterator[None]:
    """Hold the lock file ``path`` for the duration, or raise UsageError("already-running").

    The lock ends with the process, so a power cut leaves none. On a read-only disk, a file that is not there is
    stood in for by its folder. Raises WorkError("no-space" or "cannot-write") if the file can't be created.
    """
    try:
        opened = _opened_lock(path)
    except OSError as error:
        raise _explained(error, path) from error
    with contextlib.ExitStack() as stack:
        stack.callback(os.close, opened)
        try:
            fcntl.flock(opened, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise UsageError(
                "already-running",
                what=f"{what_is_running} is already running on this stage.",
                remedy="Wait for it to end, or stop it first.",
            ) from error
        yield


def _opened_lock(path: Path) -> int:
    try:
        make_folder(path.parent)
        return os.open(path, os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC, 0o666)
    except OSError as error:
        if error.errno != errno.EROFS:
            raise
    # No other program can have made the file since; one that held it before still holds it.
    return os.open(path if path.exists() else path.parent, os.O_RDONLY | os.O_CLOEXEC)


def runtime_path(stage: Path) -> Path:
    """Where the sockets of this stage are, if a program serves it.

    Under ``$XDG_RUNTIME_DIR`` or the system's temporary folder; short, because a unix socket's path has at most 107
    bytes. The stage of an installed kiosk has the folder of its services, so that commands find them.

    Refused if another user owns it, or others may use it.
    """
    if kiosk_places.is_installed(stage):
        return kiosk_places.RUNTIME
    base = Path(os.environ.get("XDG_RUNTIME_DIR") or tempfile.gettempdir())
    digest = hashlib.sha256(os.fsencode(stage.resolve())).hexdigest()[:12]
    folder = base / f"velatura-{os.getuid()}-{digest}"
    with contextlib.suppress(FileNotFoundError):
        _refuse_unsafe(folder)
    return folder


def runtime_folder(stage: Path) -> Path:
    """``runtime_path``, created with mode 0700; ``stage.run.leave_runtime_folder`` removes it."""
    folder = runtime_path(stage)
    if not kiosk_places.is_installed(stage):
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        _refuse_unsafe(folder)
    return folder


def _refuse_unsafe(folder: Path) -> None:
    status = folder.lstat()
    if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.getuid() or status.st_mode & 0o077:
        raise UsageError(
            "runtime-folder-unsafe",
            what=f"{folder} belongs to another user or is open to others.",
            remedy="Remove it, or set XDG_RUNTIME_DIR to a private folder, and start again.",
        )


LONGEST_PATH_BYTES: Final = 106
"""The system's 107, less the dot of the name that it has before it takes connections."""


def listening(path: Path, backlog: int) -> socket.socket:
    """A stream socket at ``path``, for this user alone, in the place of what was there.

    It appears there when it takes connections: a client that sees it is not refused. Raises OSError.
    """
    before_it_listens = path.with_name(f".{path.name}")
    before_it_listens.unlink(missing_ok=True)
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    mask = os.umask(0o177)
    try:
        listener.bind(str(before_it_listens))
        listener.listen(backlog)
        before_it_listens.replace(path)
    except OSError:
        listener.close()
        raise
    finally:
        os.umask(mask)
    return listener
