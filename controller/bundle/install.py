"""Installs bundles into a stage's ``bundles`` folder so that a power cut leaves the old one or the new one.

``<sha256>.vel`` files never change once named; ``current`` and ``previous`` are symbolic links, replaced by rename.

Starts of the player that led to no picture are counted; after three with one bundle, the previous bundle plays again.
The count is written before the bundle is touched, so a start that ends in a crash, a hang or a power cut stays counted.
A start that is ready, and was not asked for a picture of the bundle, does not count: power cuts at night say nothing
about a bundle. A folder that can't be written never keeps the player from playing: the count (``bundles/starts.json``)
is then kept in the stage's runtime folder, which is in memory. It survives every end of the player, but not of the
computer.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import threading
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

from controller.bundle.format import HEADER_BYTES, READABLE, Index, version_of
from controller.bundle.reader import Bundle
from controller.bundle.signing import ANY_SIGNER, Trust
from controller.core.errors import BundleError, UsageError, VelaturaError
from controller.core.storage import exclusive, runtime_path, sha256_of, stream_atomically, sync_folder, write_atomically

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
    """Copy, verify in full, and make current; return the installed file. The previous one is kept for ``rollback``.

    Installing what is current already changes nothing, but gives it its starts again (``fallback``). Files that are
    neither current nor previous are removed. ``accept`` raises to refuse a sound bundle that does not fit.

    Raises BundleError as ``Bundle.open`` and ``Bundle.verify`` do, and ("bundle-older") for a lower revision than
    those of the installed bundles; WorkError("no-space" or "cannot-write"). The folder plays what it played before.
    """
    trust = Trust(tuple(trusted), allow_unsigned, tuple(revoked))
    with exclusive(folder / _LOCK, what_is_running="Another installation"):
        incoming = folder / _INCOMING
        _clear_unfinished(folder)
        # Refused before a byte is copied: a file that is not a bundle may be endless, and what is hostile may be huge.
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
    now, before = current(folder), _target(folder, PREVIOUS)
    if before is None or before != now:
        return before
    # Both links are of one bundle: a switch was cut off between them. A bundle that came since is the newest file.
    others = [file for file in folder.glob("*.vel") if file != now and _target(folder, file=file.name)]
    return min(others, key=lambda file: file.stat().st_mtime_ns, default=None)


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
    keep = {target, previous(folder)}
    for file in folder.iterdir():
        if _INSTALLED.fullmatch(file.name) and file not in keep:
            file.unlink()
    sync_folder(folder)


def _target(folder: Path, link: str = "", *, file: str = "") -> Path | None:
    """The installed file that a link leads to, or that has this name; None if it is none."""
    # By the names alone: a kiosk asks this several times at each of its steps.
    try:
        name = file or os.readlink(f"{folder}/{link}")  # noqa: PTH115
    except OSError:
        return None
    sound = _INSTALLED.fullmatch(name) and os.path.isfile(f"{folder}/{name}")  # noqa: PTH113
    return _inside(folder, name) if sound and not _is_of_other_format(f"{folder}/{name}") else None


def of_other_format(folder: Path) -> list[Path]:
    """The bundles that another version of Velatura installed, in a format that this one does not read.

    They count as not installed, so that the previous one plays; the next installation removes them.
    """
    names = (file for file in folder.glob("*.vel") if _INSTALLED.fullmatch(file.name))
    return [file for file in names if _is_of_other_format(str(file))]


@lru_cache(maxsize=64)
def _is_of_other_format(file: str) -> bool:
    # Files never change once they have this name.
    try:
        with open(file, "rb") as stream:  # noqa: PTH123
            return version_of(stream.read(HEADER_BYTES)) not in (None, *READABLE)
    except OSError:
        return False


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


NAME: Final = "starts.json"
_LARGEST_BYTES: Final = 4096


@dataclass(frozen=True, slots=True)
class Starts:
    """What is known of the starts with one bundle.

    ``bundle``: its file's name; ``failed``: starts in a row without a picture, the present one among them;
    ``given_up``: the file's name of a bundle that is not gone back to, because it failed itself.
    """

    bundle: str = ""
    failed: int = 0
    given_up: str | None = None

    @classmethod
    def read(cls, folder: Path) -> Starts:
        """The count of ``folder``; none where the file is missing or not ours."""
        return Count(folder).read()

    def write(self, folder: Path) -> None:
        """Replace the count of ``folder``. Raises WorkError("cannot-write" or "no-space"), and OSError."""
        data, in_memory = json.dumps(asdict(self)).encode(), _in_memory(folder)
        try:
            write_atomically(folder / NAME, data)
        except (VelaturaError, OSError):
            if in_memory is None:
                raise
            write_atomically(in_memory, data)
        else:
            # Last: what is in memory counts, as long as it is there.
            if in_memory is not None:
                in_memory.unlink(missing_ok=True)


class Count:
    """The count of one folder of bundles, for those who read it again and again: where it is, is found out once."""

    def __init__(self, folder: Path) -> None:
        in_memory = _place_in_memory(folder)
        # As text, and without buffers: a kiosk reads it several times at each of its steps.
        self._files = [str(file) for file in (in_memory, folder / NAME) if file is not None]

    def read(self) -> Starts:
        """See ``Starts.read``."""
        for file in self._files:
            with contextlib.suppress(OSError), open(file, "rb", buffering=0) as stream:  # noqa: PTH123
                found = _parsed(stream.read(_LARGEST_BYTES))
                if found is not None:
                    return found
        return Starts()


@lru_cache(maxsize=16)
def _parsed(data: bytes) -> Starts | None:
    """None if it is not ours."""
    try:
        values: Any = json.loads(data)
        found = Starts(values["bundle"], values["failed"], values["given_up"])
    except (ValueError, TypeError, KeyError, RecursionError):
        return None
    sound = isinstance(found.bundle, str) and type(found.failed) is int and found.failed >= 0
    return found if sound and isinstance(found.given_up, str | None) else None


def forget(folder: Path) -> None:
    """Start counting again, because a bundle was installed or rolled back. Raises OSError."""
    for file in (folder / NAME, _in_memory(folder)):
        if file is not None:
            file.unlink(missing_ok=True)


def _in_memory(folder: Path) -> Path | None:
    """The file in the runtime folder of the stage; None for bundles of which the player does not count the starts, and
    while nothing serves the stage.
    """
    place = _place_in_memory(folder)
    return place if place is not None and place.parent.is_dir() else None


def _place_in_memory(folder: Path) -> Path | None:
    """The same, whether something serves the stage or not."""
    if folder.name != "bundles":
        return None
    with contextlib.suppress(UsageError, OSError):
        return runtime_path(folder.parent) / NAME
    return None


MOST_FAILED_STARTS: Final = 3
MISSING: Final = "missing"
"""What was given up, where the bundle's file is gone."""


def chosen(folder: Path, count: Count | None = None) -> Path | None:
    """The file that the player starts with: the current one, or the previous one where the player has gone back to it
    and the links could not be changed, because the disk is full. None where none is installed. ``count``: the folder's.
    """
    now, earlier = current(folder), previous(folder)
    if earlier is None:
        return now
    starts = (count or Count(folder)).read()
    name = MISSING if now is None else now.name
    return earlier if (starts.bundle, starts.given_up) == (earlier.name, name) else now


def before_it(folder: Path, now: Path | None, starts: Starts) -> Path | None:
    """The bundle that can be gone back to from ``now``: one that is there, can be read, and was not given up itself."""
    earlier = previous(folder)
    others = ("" if now is None else now.name, starts.given_up)
    return earlier if earlier is not None and earlier.name not in others and is_readable(earlier) else None


class CountedStart:
    """One start of the player with the installed bundle; ``file`` is the bundle that it is to play.

    Making it counts the start, and goes back to the previous bundle, if that can be read, after three failed starts.
    From ``ready`` to ``asked`` the start is not counted.
    ``tell`` gets a sentence for the log when that happens, and when the count can not be kept.
    """

    def __init__(self, folder: Path, tell: Callable[[str], None]) -> None:
        self._folder, self._tell = folder, tell
        self._writing: threading.Thread | None = None
        self._asked, self._counted = False, True
        before, linked, now = Starts.read(folder), current(folder), chosen(folder)
        name = "" if now is None else now.name
        starts = before if before.bundle == name else Starts(name, 0, before.given_up)
        failing = now is None or starts.failed >= MOST_FAILED_STARTS
        if failing and (earlier := before_it(folder, now, starts)) is not None:
            gone = "The bundle has another format" if of_other_format(folder) else "The bundle is missing"
            why = f"The bundle {name} showed no picture in {starts.failed} starts" if name else gone
            tell(f"{why}; {earlier.name} plays again.")
            now, starts = earlier, Starts(earlier.name, 0, name or MISSING)
        self.file = folder / CURRENT if now is None else now
        self._starts = replace(starts, failed=starts.failed + 1)
        if now is not None:
            self._kept(lambda: self._starts.write(folder))
        # After the count, which says what was given up: otherwise a power cut here lets two bad bundles take turns.
        if now != linked:
            self._kept(lambda: switch_back(folder, away_from=linked))

    def ready(self) -> None:
        """The bundle is loaded, and the player waits: until it is asked for a picture, its end says nothing."""
        if not self._asked:
            self._counted = False
            self._record(self._starts.failed - 1)

    def asked(self) -> None:
        """A picture of the bundle is to be shown now. The first call after ``ready`` waits for the disk."""
        self._asked = True
        if not self._counted:
            self._counted = True
            self._record(self._starts.failed)

    def shown(self) -> None:
        """The bundle's first picture is on the outputs: the start did not fail. Returns at once."""
        # In a thread: the loop that presents pictures must not wait for a disk.
        self._writing = threading.Thread(target=self._record, args=(0,), name="start-counter")
        self._writing.start()

    def ended(self) -> None:
        """The player ends because it was asked to: if no picture came, that was no fault of the bundle."""
        if self._writing is not None:
            self._writing.join()
        elif self._counted:
            self._record(self._starts.failed - 1)

    def _record(self, failed: int) -> None:
        name = self._starts.bundle
        # An installation since then has begun a count of its own.
        if Starts.read(self._folder).bundle != name:
            return
        given_up = None if failed == 0 and self._starts.given_up == name else self._starts.given_up
        self._kept(lambda: Starts(name, failed, given_up).write(self._folder))

    def _kept(self, write: Callable[[], object]) -> None:
        try:
            write()
        except (VelaturaError, OSError) as error:
            self._tell(f"The count of starts could not be saved: {error}")


def is_readable(file: Path) -> bool:
    """Whether it is worth going back to: three failed starts tell nothing certain, a damaged file does."""
    try:
        Bundle.open_trusted(file, ANY_SIGNER).close()
    except (VelaturaError, OSError):
        return False
    return True
