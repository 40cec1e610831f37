"""Safe reading of foreign files: only regular ones, up to a size, pictures up to a number of pixels.

A pipe instead of a file would block its reader, and a picture of a few kilobytes can have gigabytes of
pixels. Every error is an ``OSError``, whose ``strerror`` continues the text "it can't be read:".
"""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path
from typing import Final

MOST_PIXELS: Final = 128_000_000
"""Largest picture: more pixels than any camera has, and 1.5 GB as linear light."""
LARGEST_TEXT: Final = 1 << 20
"""Bytes of a text file that a person writes."""
LARGEST_PICTURE: Final = 2 << 30
LARGEST_MESH: Final = 2 << 30
_KINDS: Final = (
    (stat.S_ISDIR, "it is a folder"), (stat.S_ISFIFO, "it is a pipe, not a file"),
    (stat.S_ISSOCK, "it is a socket, not a file"), (stat.S_ISCHR, "it is a device, not a file"),
    (stat.S_ISBLK, "it is a disk, not a file"),
)  # fmt: skip


class UnfitFile(OSError):
    """A file that is not read: not a regular one, too large, or a picture of too many pixels."""

    def __init__(self, path: Path, reason: str) -> None:
        super().__init__(errno.EINVAL, reason, str(path))
        self.reason = reason


def require_regular(path: Path, largest: int | None = None) -> None:
    """For readers that open ``path`` themselves. Raises ``OSError``; ``UnfitFile`` if it is not a regular file."""
    _check_name(path)
    _check(path, path.stat(), largest)


def read_bytes(path: Path, largest: int = LARGEST_PICTURE) -> bytes:
    """The bytes of a regular file. Raises ``OSError``; ``UnfitFile`` for another kind or above ``largest``."""
    _check_name(path)
    # Without O_NONBLOCK, opening a pipe waits for its writer.
    handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    with os.fdopen(handle, "rb") as file:
        _check(path, os.fstat(handle), largest)
        return file.read()


def read_text(path: Path, largest: int = LARGEST_TEXT) -> str:
    """The text of a UTF-8 file without its byte order mark; raises as ``read_bytes``, and UnicodeDecodeError."""
    return read_bytes(path, largest).decode("utf-8-sig")


def check_pixels(path: Path, size: tuple[int, int] | None, most_pixels: int = MOST_PIXELS) -> None:
    """Raises ``UnfitFile`` for a picture whose size (width, height) has more pixels; None: the size is unknown."""
    if size is not None and size[0] * size[1] > most_pixels:
        limit = f"more than {most_pixels / 1e6:.0f} million pixels"
        raise UnfitFile(path, f"it is {size[0]} x {size[1]} pixels large, {limit}")


def _check_name(path: Path) -> None:
    if "\0" in str(path):  # Python's ValueError would look like a mistake in the file
        raise UnfitFile(path, "its name has a character that is not allowed in file names")


def _check(path: Path, status: os.stat_result, largest: int | None) -> None:
    if not stat.S_ISREG(status.st_mode):
        reason = next((words for is_kind, words in _KINDS if is_kind(status.st_mode)), "it is not a file")
        raise UnfitFile(path, reason)
    if largest is not None and status.st_size > largest:
        raise UnfitFile(path, f"it is larger than {largest} bytes")
