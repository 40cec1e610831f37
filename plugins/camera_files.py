"""Pictures on this computer's disk: hashed during the transfer, durable before they are reported."""

from __future__ import annotations

import errno
import hashlib
import os
import tempfile
from collections.abc import Iterable
from pathlib import Path, PurePosixPath
from types import TracebackType
from typing import Final, Self

from hal.codecs.ptp.values import RAW_FORMATS, Format, broken
from hal.errors import DeviceError
from hal.values import CapturedFile, FileKind

_RAW_SUFFIXES: Final = frozenset({".dng", ".cr2", ".cr3", ".crw", ".nef", ".arw", ".raf", ".orf", ".rw2", ".pef"})
_JPEG_SUFFIXES: Final = frozenset({".jpg", ".jpeg"})
_RAW_SUFFIX_OF: Final = {Format.CANON_CR2: ".cr2", Format.CANON_CR3: ".cr3", Format.CANON_CRW: ".crw"}


def kind_of(format_code: int, filename: str) -> tuple[FileKind, str] | None:
    """Kind and suffix of a picture on the camera, or None for other objects (a folder, a film).

    The end of the name is more specific than the format: vendors share the codes of raw formats, or use none.
    """
    suffix = PurePosixPath(filename).suffix.lower()
    if format_code == Format.FOLDER:
        return None
    if suffix in _RAW_SUFFIXES:
        return FileKind.RAW, suffix
    if suffix in _JPEG_SUFFIXES or format_code == Format.JPEG:
        return FileKind.JPEG, ".jpg"
    if format_code in RAW_FORMATS:
        return FileKind.RAW, _RAW_SUFFIX_OF.get(Format(format_code), ".dng")
    return None


class PendingFile:
    """A picture being written to ``path``, under a temporary name until ``commit``.

    As a context manager it leaves no file unless it was committed.
    """

    def __init__(self, path: Path, kind: FileKind) -> None:
        self.path = path
        self.kind = kind
        self.size = 0
        self._hash = hashlib.sha256()
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            handle, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".part", dir=path.parent)
        except OSError as error:
            raise _disk(error, path) from error
        self._temporary = Path(name)
        self._file = os.fdopen(handle, "wb", buffering=0)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()
        self._temporary.unlink(missing_ok=True)

    def write(self, piece: memoryview) -> None:
        """Append bytes. Raises DeviceError("no-space") when the disk is full."""
        self._hash.update(piece)
        self.size += len(piece)
        try:
            while piece:
                piece = piece[self._file.write(piece) :]
        except OSError as error:
            raise _disk(error, self.path) from error

    def sync(self) -> None:
        """Make the bytes durable; nothing has its final name yet."""
        try:
            os.fsync(self._file.fileno())
            self._temporary.chmod(0o644)
        except OSError as error:
            raise _disk(error, self.path) from error

    def commit(self) -> CapturedFile:
        """Give it its name. The caller syncs the folder once for all files of a picture."""
        try:
            self._temporary.replace(self.path)
        except OSError as error:
            raise _disk(error, self.path) from error
        return CapturedFile(self.path, self.kind, self.size, self._hash.hexdigest())


def commit_all(pending: Iterable[PendingFile]) -> list[CapturedFile]:
    """Name all files of one picture, once every one of them is durable.

    Raises ProtocolError for an empty file, and DeviceError where the disk fails.
    """
    files = list(pending)
    for file in files:
        if file.size == 0:
            raise broken(f"an empty picture for {file.path.name}")
        file.sync()
    named = [file.commit() for file in files]
    for folder in {file.path.parent for file in files}:
        handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
    return named


def _disk(error: OSError, path: Path) -> DeviceError:
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return DeviceError(
            "no-space",
            what=f"The disk has no space for the picture {path.name}.",
            remedy=f"Free space on the disk of {path.parent}.",
        )
    return DeviceError(
        "cannot-write",
        what=f"The picture {path.name} could not be written: {error.strerror}.",
        remedy=f"Check the permissions of {path.parent} and that its disk is writable.",
    )
