"""Installs bundles into a stage's ``bundles`` folder so that a power cut leaves the old one or the new one.

``<sha256>.vel`` files never change once named; ``current`` and ``previous`` are symbolic links, replaced by rename.
"""

from __future__ import annotations

import contextlib
import re
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from controller.bundle.reader import Bundle
from controller.errors import BundleError
from controller.storage import exclusive, sha256_of, stream_atomically, sync_folder

CURRENT: Final = "current"
PREVIOUS: Final = "previous"
_INCOMING: Final = ".incoming.vel"
_LOCK: Final = ".install.lock"
_INSTALLED: Final = re.compile(r"[0-9a-f]{64}\.vel")


def install(
    source: Path,
    folder: Path,
    *,
    trusted: Sequence[bytes] = (),
    allow_unsigned: bool = False,
) -> Path:
    """Copy, verify in full, and make current; return the installed file. The one before is kept for ``rollback``.

    Installing what is current already changes nothing. Files that are neither current nor previous are removed.

    Raises BundleError as ``Bundle.open`` and ``Bundle.verify`` do, and ("bundle-older") for a lower revision than
    the current bundle's; WorkError("no-space"). The folder then plays what it played before.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with exclusive(folder / _LOCK, what_is_running="Another installation"):
        incoming = folder / _INCOMING
        try:
            _copy(source, incoming)
            # What is checked is the copy: the source may change while it is read.
            with Bundle.open(incoming, trusted=trusted, allow_unsigned=allow_unsigned) as bundle:
                bundle.verify()
                _refuse_older(bundle, folder)
            target = folder / f"{sha256_of(incoming)}.vel"
            incoming.replace(target)
        finally:
            incoming.unlink(missing_ok=True)
        sync_folder(folder)
        _switch(folder, target)
    return target


def rollback(folder: Path) -> Path:
    """Make the previous bundle current again, and the current one previous; return the file that is now current.

    Raises BundleError("bundle-no-previous").
    """
    with exclusive(folder / _LOCK, what_is_running="Another installation"):
        now, before = current(folder), _target(folder, PREVIOUS)
        if before is None or before == now:
            raise BundleError(
                "bundle-no-previous",
                what="There is no earlier bundle to go back to.",
                remedy="Install a bundle with 'velatura bundle install'.",
            )
        _link(folder, CURRENT, before)
        if now is not None:
            _link(folder, PREVIOUS, now)
    return before


def current(folder: Path) -> Path | None:
    """The installed bundle's file, or None where none is installed."""
    return _target(folder, CURRENT)


def _copy(source: Path, target: Path) -> None:
    try:
        with source.open("rb") as data:
            stream_atomically(target, lambda file: shutil.copyfileobj(data, file, 1 << 20))
    except OSError as error:
        raise BundleError(
            "bundle-unreadable",
            what=f"The bundle {source} can not be read: {error.strerror}.",
            remedy="Check the path and the file's permissions.",
        ) from error


def _refuse_older(bundle: Bundle, folder: Path) -> None:
    now = current(folder)
    if now is None:
        return
    try:
        with Bundle.open(now, allow_unsigned=True) as installed:
            least = installed.index.revision
    except BundleError:  # a damaged current bundle must not keep a sound one out
        return
    if bundle.index.revision < least:
        raise BundleError(
            "bundle-older",
            what=f"The bundle has revision {bundle.index.revision}, and revision {least} is installed.",
            remedy="Publish it again with a higher revision, or use 'velatura bundle rollback'.",
        )


def _switch(folder: Path, target: Path) -> None:
    before = current(folder)
    if before != target:
        if before is not None:
            _link(folder, PREVIOUS, before)
        _link(folder, CURRENT, target)
    keep = {target, _target(folder, PREVIOUS)}
    for file in folder.iterdir():
        if _INSTALLED.fullmatch(file.name) and file not in keep:
            file.unlink()
    sync_folder(folder)


def _target(folder: Path, link: str) -> Path | None:
    try:
        name = str((folder / link).readlink())
    except OSError:
        return None
    file = folder / name
    return file if _INSTALLED.fullmatch(name) and file.is_file() else None


def _link(folder: Path, link: str, target: Path) -> None:
    temporary = folder / f".{link}.new"
    with contextlib.suppress(FileNotFoundError):
        temporary.unlink()
    temporary.symlink_to(target.name)
    temporary.replace(folder / link)
    sync_folder(folder)
