"""The bundles of a stage: the installed one, and those solved for the stage without some of its projectors."""

from __future__ import annotations

import contextlib
import shutil
import threading
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Final

from controller.artefacts.names import safe_name
from controller.bundle.format import Index
from controller.bundle.install import current
from controller.bundle.reader import Bundle
from controller.bundle.signing import Trust
from controller.core.errors import BundleError, UsageError, VelaturaError
from controller.core.storage import write_atomically

PREVIEWS: Final = "kiosk/previews"
WITHOUT: Final = "bundles-without"
"""Folder of the stage: for each set of missing projectors a folder like ``bundles``."""


def slots_without(stage: Path, missing: Collection[str]) -> Path:
    """Where bundles for the stage without these projectors are installed."""
    # "+" in a name is doubled so that no two sets meet.
    return stage / WITHOUT / safe_name(" + ".join(name.replace("+", "++") for name in sorted(missing)))


class BundleStock:
    """Reads what is installed; asks the disk for links alone unless they have changed. See ``ports.Stock``."""

    def __init__(self, stage: Path, trust: Trust) -> None:
        self._stage, self._trust = stage, trust
        self._known: dict[Path, Index | None] = {}
        self._previewing = threading.Lock()

    def bundle(self) -> Path | None:
        """The installed bundle's file; also one that can't be read: the player's own start finds the way back."""
        return current(self._stage / "bundles")

    def names(self) -> Sequence[str]:
        index = self.index(self.bundle())
        return () if index is None else tuple(one.name for one in index.appearances)

    def check_name(self, name: str | None) -> None:
        """Raises UsageError("appearance-unknown") for a name that the installed bundle does not have."""
        if name is not None and name not in self.names():
            raise UsageError("appearance-unknown", what=f"The installed bundle has no appearance {name[:64]!r}.",
                             remedy=f"It has {', '.join(self.names()) or 'none'}.")  # fmt: skip

    def without(self, missing: Collection[str], appearance: str) -> Path | None:
        path, whole = current(slots_without(self._stage, missing)), self.index(self.bundle())
        index = self.index(path)
        if index is None or whole is None or index.calibration != whole.calibration:
            return None
        return path if appearance in [one.name for one in index.appearances] else None

    def previews(self) -> dict[str, Path]:
        """A PNG of how each appearance of the installed bundle will look, for those that it has one of.

        Written beside once a bundle; those of bundles before are removed.
        """
        path = self.bundle()
        index = self.index(path)
        if path is None or index is None:
            return {}
        folder = self._stage / PREVIEWS / path.stem
        with self._previewing:
            if not folder.is_dir():
                self._preview(path, index, folder)
        files = {one.name: folder / f"{number}.png" for number, one in enumerate(index.appearances)}
        return {name: file for name, file in files.items() if file.exists()}

    def _preview(self, path: Path, index: Index, folder: Path) -> None:
        shutil.rmtree(folder.parent, ignore_errors=True)
        # All of them or none: the folder is not looked into again. A full disk costs pictures on a page, and nothing
        # else.
        fresh = folder.with_name(f"{folder.name}.part")
        with (
            contextlib.suppress(BundleError, VelaturaError, OSError),
            Bundle.open_trusted(path, self._trust) as bundle,
        ):
            fresh.mkdir(parents=True)
            for number, one in enumerate(index.appearances):
                if (data := bundle.thumbnail(one.name)) is not None:
                    write_atomically(fresh / f"{number}.png", data)
            fresh.rename(folder)

    def index(self, path: Path | None) -> Index | None:
        """What an installed bundle holds; None for none, and for one that this stage would not play."""
        if path is None:
            return None
        # Asked by several threads, of which each may forget what another has just read.
        with contextlib.suppress(KeyError):
            return self._known[path]
        if len(self._known) > 64:
            self._known.clear()
        found = None
        with (
            contextlib.suppress(BundleError, VelaturaError, OSError),
            Bundle.open_trusted(path, self._trust) as bundle,
        ):
            found = bundle.index
        self._known[path] = found
        return found
