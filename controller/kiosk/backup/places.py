"""Places for backups on this computer: a folder, and a USB stick that is found by its label or UUID."""

from __future__ import annotations

import os
import re
import shutil
from pathlib import Path
from typing import Final, Protocol

from controller.core.errors import WorkError
from controller.core.storage import sha256_of, sync_folder
from controller.kiosk.store import archive
from controller.kiosk.store.event_log import Decision

NAME: Final = "velatura-{}.tar.gz"
OURS: Final = re.compile(r"velatura-[0-9]{8}\.tar\.gz")
DIFFERS: Final = "The backup reads back differently from what was written."
_STICK: Final = "Plug the stick in, and check [backup] in stage.toml. It has to be mounted: `findmnt` lists what is."
_BY: Final = ("dev/disk/by-label", "dev/disk/by-uuid")


class Place(Protocol):
    """Where backups go. ``name`` tells it from the others, and is stable."""

    @property
    def name(self) -> str: ...

    def store(self, source: Path, day: str, keep: int) -> Decision:
        """Store the backup ``source`` of a day (20260504), read it back, and remove all of ours but the newest
        ``keep``; returns what to tell. Raises WorkError, UsageError("not-a-backup") and OSError; nothing that was there
        is lost then.
        """


class Folder:
    """A folder. A missing one is never made: it is the mount point of a disk that is not there."""

    name = "folder"

    def __init__(self, folder: Path, stage: Path) -> None:
        self._folder, self._stage = folder, stage

    def store(self, source: Path, day: str, keep: int) -> Decision:
        """As ``Place.store``."""
        folder = self._folder
        if not folder.is_dir():
            raise WorkError("backup-folder-missing", what=f"The folder for backups, {folder}, does not exist.",
                            remedy="Plug the disk in, mount it, or correct [backup] in stage.toml.")  # fmt: skip
        copy = copied(source, folder / NAME.format(day))
        ours = sorted(path for path in folder.iterdir() if OURS.fullmatch(path.name))
        for old in ours[:-keep]:
            old.unlink()
        text = f"The backup {copy.name} ({copy.stat().st_size / 1e6:.0f} MB) was made and read back."
        if folder.stat().st_dev == self._stage.stat().st_dev:
            remedy = "It is on the same disk as the stage. Choose a folder on another disk."
            return Decision("backup-same-disk", text, remedy, "warning")
        return Decision("backup-made", text)


class Stick:
    """A USB stick by the label or UUID of its file system, wherever it is mounted. ``root``: below it lie /dev and
    /proc (for tests).
    """

    name = "usb"

    def __init__(self, label: str, stage: Path, root: Path = Path("/")) -> None:
        self._label, self._stage, self._root = label, stage, root

    def store(self, source: Path, day: str, keep: int) -> Decision:
        """As ``Place.store``. Raises WorkError("backup-stick-missing") as well."""
        stored = Folder(self._mounted(), self._stage).store(source, day, keep)
        return Decision(
            stored.code, f"{stored.reason} It is on the USB stick {self._label}.", stored.remedy, stored.level
        )

    def _mounted(self) -> Path:
        device = next((link.resolve() for link in self._links() if _unescaped(link.name) == self._label), None)
        if device is None:
            raise WorkError(
                "backup-stick-missing", what=f"The USB stick {self._label} is not plugged in.", remedy=_STICK
            )
        for line in (self._root / "proc/self/mountinfo").read_text().splitlines():
            before, _, after = line.partition(" - ")
            words, source = before.split(), after.split()[1:2]
            if len(words) > 4 and source and self._root / source[0].lstrip("/") == device:
                return Path(_octal(words[4]))
        raise WorkError(
            "backup-stick-not-mounted", what=f"The USB stick {self._label} is plugged in, but not mounted.",
            remedy=_STICK,
        )  # fmt: skip

    def _links(self) -> list[Path]:
        return [link for folder in _BY for link in sorted((self._root / folder).glob("*"))]


def _unescaped(name: str) -> str:
    r"""A label as udev writes it into a file's name, with \x20 for a space."""
    data = re.sub(rb"\\x([0-9a-f]{2})", lambda found: bytes([int(found[1], 16)]), os.fsencode(name))
    return data.decode("utf-8", "replace")


def _octal(path: str) -> str:
    r"""A path as the kernel writes it into mountinfo, with \040 for a space."""
    return os.fsdecode(re.sub(rb"\\([0-7]{3})", lambda found: bytes([int(found[1], 8)]), os.fsencode(path)))


def copied(source: Path, target: Path) -> Path:
    """Copy a backup, read the copy back from its disk, and only then give it its name.

    Raises UsageError("not-a-backup"), WorkError("backup-differs"), OSError; no ``target`` is left or changed then.
    """
    part = target.with_name(f".{target.name}.part")
    try:
        with source.open("rb") as content, part.open("wb") as file:
            shutil.copyfileobj(content, file, 1 << 20)
            file.flush()
            os.fsync(file.fileno())
            # Otherwise the memory would be read back, and not the disk.
            os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
        if sha256_of(part) != sha256_of(source):
            raise WorkError("backup-differs", what=DIFFERS, remedy="Replace the disk for backups.")
        archive.check_backup(part)
        part.replace(target)
    finally:
        part.unlink(missing_ok=True)
    sync_folder(target.parent)
    return target
