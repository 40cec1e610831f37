"""Files that somebody else wrote, for the controller: see ``hal.runtime.files``, and their errors."""

import errno
import os

from controller.core.errors import WorkError
from hal.runtime.files import (
    LARGEST_MESH,
    LARGEST_TEXT,
    MOST_PIXELS,
    UnfitFile,
    check_pixels,
    read_bytes,
    read_text,
    require_regular,
)

__all__ = [
    "LARGEST_MESH", "LARGEST_TEXT", "MOST_PIXELS", "UnfitFile", "check_pixels", "file_error", "read_bytes",
    "read_text", "require_regular",
]  # fmt: skip

_REFUSED = {
    errno.EACCES, errno.EPERM, errno.EEXIST, errno.ENOENT, errno.EISDIR, errno.ENOTDIR, errno.ENXIO, errno.ELOOP,
    errno.ENAMETOOLONG, errno.ENOTEMPTY,
}  # fmt: skip


def file_error(error: OSError) -> WorkError | None:
    """The error to tell for a file that a person can do something about; None for an ``OSError`` of another kind."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        return WorkError(
            "no-space",
            what=f"The disk has no space for {error.filename or 'a file'}.",
            remedy="Free space and start again.",
        )
    if error.errno == errno.EROFS:
        return WorkError(
            "cannot-write",
            what=f"{error.filename or 'A file'} is on a read-only disk.",
            remedy="Give another folder, or make the disk writable.",
        )
    if error.filename is not None and error.errno in _REFUSED:
        return WorkError(
            "file-refused",
            what=f"{error.filename} can't be used: {os.strerror(error.errno)}.",
            remedy="Check the path and its permissions.",
        )
    if isinstance(error, UnfitFile):
        return WorkError("file-unfit", what=f"{error.filename} can't be read: {error.strerror}.",
                         remedy="Give a file of the right kind.")  # fmt: skip
    return None
