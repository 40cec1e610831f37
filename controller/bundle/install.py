"""Installs bundles into a stage's ``bundles`` folder so that a power cut leaves the old one or the new one.

``<sha256>.vel`` files never change once named; ``current`` and ``previous`` are symbolic links, replaced by rename.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Final

from controller.bundle.format import Index
from controller.bundle.reader import Bundle
from controller.bundle.signing import Trust
from controller.bundle.starts import forget
from controller.core.errors import BundleError
from controller.core.storage import exclusive, sha256_of, stream_atomically, sync_folder

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
    revoked: Sequence[bytes] = (),
    accept: Callable[[Index], None] = lambda index: None,
) -> Path:
    """Copy, verify in full, and make current; return the installed file. The one before is kept for ``rollback``.

    Installing what is current already changes nothing, but gives it its starts again (``fallback``). Files that are
    neither current nor previous are removed. ``accept`` raises to refuse a sound bundle that does not fit.

    Raises BundleError as ``Bundle.open`` and ``Bundle.verify`` do, and ("bundle-older") for a lower revision than
    those of the installed bundles; WorkError("no-space" or "cannot-write"). The folder plays what it played before.
    """
    trust = Trust(tuple(trusted), allow_unsigned, tuple(revoked))
    with exclusive(folder / _LOCK, what_is_running="Another installation"):
        incoming = folder / _INCOMING
        _clear_unfinished(folder)
        # Refused before a byte is copied: what is no bundle may be endless, and what is hostile may be huge.
        Bundle.open_trusted(source, trust).close()
        try:
            _copy(source, incoming)
            # What is checked is the copy: the source may change while it is read.
            target = folder / f"{sha256_of(incoming)}.vel"
            with Bundle.open_trusted(incoming, trust) as bundle:
                bundle.verify()
                accept(bundle.index)
                if target != current(folder):
                    _refuse_older(bundle.index, folder, trust)
            incoming.replace(target)
        finally:
            incoming.unlink(missing_ok=True)
        # Before the switch: a counter that is lost with the old bundle does no harm.
        forget(folder)
        sync_folder(folder)
        _switch(folder, target)
    return target


def rollback(folder: Path) -> Path:
    """Make the previous bundle current again, and the current one previous; return the file that is now current.

    It gets its starts again (``fallback``). Raises BundleError("bundle-no-previous").
    """
    forget(folder)
    return switch_back(folder)


def switch_back(folder: Path, *, away_from: Path | None = None) -> Path:
    """As ``rollback``, but the count of starts stays; nothing changes if another than ``away_from`` is current."""
    if not folder.is_dir():
        raise _no_previous()
    with exclusive(folder / _LOCK, what_is_running="Another installation"):
        now, before = current(folder), previous(folder)
        if before is None or before == now:
            raise _no_previous()
        if now is not None and away_from not in (None, now):
            return now
        _link(folder, CURRENT, before)
        if now is not None:
            _link(folder, PREVIOUS, now)
    return before


def _no_previous() -> BundleError:
    return BundleError(
        "bundle-no-previous",
        what="There is no earlier bundle.",
        remedy="Install a bundle with 'velatura bundle install'.",
    )


def current(folder: Path) -> Path | None:
    """The installed bundle's file, or None where none is installed."""
    return _target(folder, CURRENT)


def previous(folder: Path) -> Path | None:
    """The file of the bundle to go back to, or None."""
    return _target(folder, PREVIOUS)


def revision_floor(folder: Path, trust: Trust) -> int:
    """The highest revision of the installed bundles, -1 if there is none.

    What the stage would not play does not count: a damaged bundle, or one by a stolen and then revoked key, must not
    keep sound ones out.
    """
    found = [-1]
    for file in {current(folder), previous(folder)} - {None}:
        assert file is not None
        with contextlib.suppress(BundleError), Bundle.open_trusted(file, trust) as installed:
            found.append(installed.index.revision)
    return max(found)


def _clear_unfinished(folder: Path) -> None:
    """Remove copies that a power cut left unfinished; for the holder of the lock."""
    for temporary in folder.glob(f".{_INCOMING}.*.part"):
        temporary.unlink(missing_ok=True)


def _copy(source: Path, target: Path) -> None:
    try:
        with source.open("rb") as data:
            stream_atomically(target, lambda file: shutil.copyfileobj(data, file, 1 << 20))
    except OSError as error:
        raise BundleError(
            "bundle-unreadable",
            what=f"The bundle {source} can't be read: {error.strerror}.",
            remedy="Check the path and the file's permissions.",
        ) from error


def _refuse_older(index: Index, folder: Path, trust: Trust) -> None:
    least = revision_floor(folder, trust)
    if index.revision < least:
        raise BundleError(
            "bundle-older",
            what=f"The bundle has revision {index.revision}, but revision {least} is installed.",
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
    # By the names alone: a kiosk asks this several times at each of its steps.
    try:
        name = os.readlink(f"{folder}/{link}")  # noqa: PTH115
    except OSError:
        return None
    sound = _INSTALLED.fullmatch(name) and os.path.isfile(f"{folder}/{name}")  # noqa: PTH113
    return _inside(folder, name) if sound else None


@lru_cache(maxsize=16)
def _inside(folder: Path, name: str) -> Path:
    return folder / name


def _link(folder: Path, link: str, target: Path) -> None:
    temporary = folder / f".{link}.new"
    with contextlib.suppress(FileNotFoundError):
        temporary.unlink()
    temporary.symlink_to(target.name)
    temporary.replace(folder / link)
    sync_folder(folder)
