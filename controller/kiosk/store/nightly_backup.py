"""A backup every night, to a folder on another disk, which counts only once it was read back."""

from __future__ import annotations

import os
import re
import shutil
import time
from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from typing import Final

from controller.config.upkeep import BackupTable
from controller.core.errors import UsageError, VelaturaError, WorkError
from controller.core.storage import sha256_of, sync_folder
from controller.kiosk.decide.hours import zone_of
from controller.kiosk.store import archive
from controller.kiosk.store.event_log import Decision, EventLog

WINDOW_MIN: Final = 12 * 60
"""So late a backup may be made: a computer that is off at night makes it in the morning."""
AGAIN_S: Final = 1800.0
_NAME: Final = "velatura-{}.tar.gz"
_OURS: Final = re.compile(r"velatura-[0-9]{8}\.tar\.gz")


class NightlyBackup:
    """``table`` and ``zone``: the settings and the schedule's time zone now; ``busy``: whether a job runs.

    One thread calls ``step`` about twice a minute.
    """

    def __init__(
        self, stage: Path, table: Callable[[], BackupTable], zone: Callable[[], str], log: EventLog, *,
        busy: Callable[[], bool], wall: Callable[[], float] = time.time,
    ) -> None:  # fmt: skip
        self._stage, self._table, self._zone, self._log = stage, table, zone, log
        self._busy, self._wall = busy, wall
        self._again_at_s, self._failed_key = 0.0, ""

    def step(self) -> None:
        """Make the backup of this day if it is due."""
        table, now_s = self._table(), self._wall()
        now = datetime.fromtimestamp(now_s, zone_of(self._zone()))
        late_min = now.hour * 60 + now.minute - int(table.at[:2]) * 60 - int(table.at[3:])
        key = f"backup {now.date().isoformat()}"
        due = table.folder is not None and 0 <= late_min < WINDOW_MIN and key not in self._log.done()
        if not due or self._busy() or now_s < self._again_at_s:
            return
        try:
            made = self._make(self._stage / str(table.folder), f"{now:%Y%m%d}", table.keep)
        except (VelaturaError, OSError) as error:
            self._again_at_s = now_s + AGAIN_S
            if self._failed_key != key:
                self._failed_key = key
                self._log.tell_failure(_failed(error))
            return
        self._log.mark_done(key, "made")
        self._log.tell(made)

    def _make(self, folder: Path, day: str, keep: int) -> Decision:
        if not folder.is_dir():
            raise WorkError("backup-folder-missing", what=f"The folder for backups, {folder}, does not exist.",
                            remedy="Plug the disk in, mount it, or correct [backup] in stage.toml.")  # fmt: skip
        source = archive.backup(self._stage)
        try:
            copy = copied(source, folder / _NAME.format(day))
        finally:
            source.unlink()
        ours = sorted(path for path in folder.iterdir() if _OURS.fullmatch(path.name))
        for old in ours[:-keep]:
            old.unlink()
        text = f"The backup {copy.name} ({copy.stat().st_size / 1e6:.0f} MB) was made and read back."
        if folder.stat().st_dev == self._stage.stat().st_dev:
            remedy = "It is on the same disk as the stage. Choose a folder on another disk."
            return Decision("backup-same-disk", text, remedy, "warning")
        return Decision("backup-made", text)


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
            raise WorkError("backup-differs", what="The backup reads back differently from what was written.",
                            remedy="Replace the disk for backups.")  # fmt: skip
        archive.check_backup(part)
        part.replace(target)
    finally:
        part.unlink(missing_ok=True)
    sync_folder(target.parent)
    return target


def _failed(error: VelaturaError | OSError) -> Decision:
    if isinstance(error, UsageError | WorkError | VelaturaError):
        return Decision("backup-failed", f"No backup was made. {error.what}", error.remedy, "error")
    remedy = "Check the disk for backups and its free space."
    return Decision("backup-failed", f"No backup was made: {error.strerror}.", remedy, "error")
