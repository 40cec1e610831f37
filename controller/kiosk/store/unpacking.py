"""Unpacks a backup that may be damaged or hostile: nothing leaves its folder, and nothing fills memory or disk."""

from __future__ import annotations

import gzip
import os
import shutil
import tarfile
import zlib
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import IO, Any, Final, cast

from controller.core.errors import UsageError, WorkError
from controller.core.files import require_regular
from controller.core.text import printable

MOST_FILES: Final = 100_000
ROOM_SHARE: Final = 0.9
"""The share of the free space that an unpacked backup may fill; the event log needs some, too."""
_AT_ONCE: Final = 1 << 20
DAMAGED: Final = (tarfile.TarError, zlib.error, OSError, EOFError, ValueError, OverflowError)
"""What reading a file raises that is damaged or is not a backup."""
_FILES: Final = (tarfile.REGTYPE, tarfile.AREGTYPE)


def not_ours(why: str = "") -> UsageError:
    """The error for such a file; ``why``: what is wrong with it, the rest of a sentence."""
    return UsageError(
        "not-a-backup",
        what=f"This file is not a backup of a Velatura stage, or it is damaged{': ' if why else ''}{printable(why)}.",
        remedy="Use a file that was made by `velatura kiosk backup` or the panel.",
    )


def unpack(file: Path, folder: Path, *, first: str) -> None:
    """Unpack a backup whose first member is ``first`` into the empty ``folder``, and sync every file.

    It is read to its end and checked before anything is written. Raises UsageError("not-a-backup") and
    WorkError("no-space").
    """
    try:
        _require_room(folder, sum(member.size for member, _ in _members(file, first)))
        for member, content in _members(file, first):
            _unpack_one(member, content, folder / member.name)
    except DAMAGED as error:
        raise not_ours() from error


class _Forward:
    """A file for tarfile, which is read once from its beginning to its end, and never much at once: no header can make
    it read for ever, or fill the memory.
    """

    def __init__(self, stream: gzip.GzipFile) -> None:
        self._stream, self._at = stream, 0

    def tell(self) -> int:
        return self._at

    def read(self, size: int = -1) -> bytes:
        if not 0 <= size <= _AT_ONCE:
            raise tarfile.ReadError("a header that is too long")
        data = self._stream.read(size)
        self._at += len(data)
        return data

    def seek(self, to: int) -> None:
        if to < self._at:
            raise tarfile.ReadError("a header that leads back")
        while self._at < to and self.read(min(to - self._at, _AT_ONCE)):
            pass


def read_first(file: Path) -> tuple[str, bytes]:
    """Name and content (at most 1 MiB) of the first member. Raises UsageError("not-a-backup")."""
    try:
        for member, content in _opened(file):
            return member.name, b"" if content is None else content.read(_AT_ONCE)
    except DAMAGED as error:
        raise not_ours() from error
    raise not_ours("it is empty")


def _opened(file: Path) -> Iterator[tuple[tarfile.TarInfo, IO[bytes] | None]]:
    """Each member with its content, to its end with its checksum.

    tarfile itself stops at the first header that is not one, so that it takes a damaged header for the end.
    """
    require_regular(file)
    with gzip.open(file, "rb") as stream:
        with tarfile.open(fileobj=cast(Any, _Forward(stream)), mode="r:") as archive:
            for member in archive:
                yield member, archive.extractfile(member) if member.type in _FILES else None
        while stream.read(_AT_ONCE):
            pass


def _members(file: Path, first: str) -> Iterator[tuple[tarfile.TarInfo, IO[bytes] | None]]:
    """As ``_opened``; raises UsageError("not-a-backup") for what a backup does not have."""
    kinds: dict[PurePosixPath, str] = {}
    for member, content in _opened(file):
        name = PurePosixPath(member.name)
        if (not kinds and member.name != first) or len(kinds) >= MOST_FILES:
            raise not_ours()
        if why := _refused(member, name) or _does_not_fit(member, name, kinds):
            raise not_ours(f"{member.name[:80]} {why}")
        kinds[name] = "folder" if member.isdir() else "file"
        for parent in name.parents:
            kinds.setdefault(parent, "folder without a member of its own")
        yield member, content
    if not kinds:
        raise not_ours("it is empty")


def _refused(member: tarfile.TarInfo, name: PurePosixPath) -> str:
    """Why a member is none of a backup; "" if it may be one."""
    if str(name) != member.name or name.is_absolute() or ".." in name.parts or "\0" in member.name:
        return "is no plain name"
    if any(part.startswith(".") for part in name.parts) or name.suffix == ".key":
        return "is hidden or a key"
    if member.issym():
        harmless = "/" not in member.linkname and not member.linkname.startswith(".") and len(name.parts) > 1
        return "" if harmless else "is a link out of its folder"
    plain = member.type in _FILES and not member.issparse() and member.size >= 0
    return "" if plain or member.isdir() else "is neither a file nor a folder"


def _does_not_fit(member: tarfile.TarInfo, name: PurePosixPath, kinds: dict[PurePosixPath, str]) -> str:
    if any(kinds.get(parent) == "file" for parent in name.parents):
        return "lies in something that is no folder"
    twice = name in kinds and (not member.isdir() or kinds[name] in ("file", "folder"))
    return "is there twice" if twice else ""


def _unpack_one(member: tarfile.TarInfo, content: IO[bytes] | None, place: Path) -> None:
    """One file, folder or link. tarfile's own filters came with Python 3.11.4, and Debian 12 has 3.11.2."""
    place.parent.mkdir(parents=True, exist_ok=True)
    if member.isdir():
        place.mkdir(exist_ok=True)
    elif content is None:
        place.symlink_to(member.linkname)
    else:
        with content, place.open("xb") as file:
            shutil.copyfileobj(content, file, _AT_ONCE)
            file.flush()
            os.fchmod(file.fileno(), 0o600 | member.mode & 0o666)
            os.utime(file.fileno(), (member.mtime, member.mtime))
            os.fsync(file.fileno())


def _require_room(folder: Path, size: int) -> None:
    """Raises WorkError("no-space"), because a small archive may be large when unpacked."""
    free = shutil.disk_usage(folder).free
    if size > ROOM_SHARE * free:
        raise WorkError(
            "no-space",
            what=f"The backup needs {size / 1e9:.1f} GB, but only {free / 1e9:.1f} GB are free.",
            remedy="Free some space on the stage's disk.",
        )
