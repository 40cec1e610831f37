"""Counts starts of the player that led to no picture; after three with one bundle, the one before plays again.

The count (``starts``) is written before the bundle is touched, so a start that ends in a crash, a hang or a power cut
stays counted. A start that is ready, and was not asked for a picture of the bundle, does not count: power cuts at night
say nothing about a bundle. A folder that can not be written never keeps the player from playing.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Final

from controller.bundle.install import CURRENT, current, previous, switch_back
from controller.bundle.reader import Bundle
from controller.bundle.signing import ANY_SIGNER
from controller.bundle.starts import Count, Starts
from controller.core.errors import VelaturaError

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
            why = f"The bundle {name} showed no picture in {starts.failed} starts" if name else "The bundle is missing"
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
