"""A backup every night, to each place that stage.toml names; it counts only once it was read back."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from datetime import datetime
from pathlib import Path
from typing import Final

from controller.config.models import BackupTable
from controller.core.errors import UsageError, VelaturaError
from controller.kiosk.backup.places import Folder, Place, Stick
from controller.kiosk.backup.ssh import Server
from controller.kiosk.decide.hours import zone_of
from controller.kiosk.store import archive
from controller.kiosk.store.event_log import Decision, EventLog

WINDOW_MIN: Final = 12 * 60
"""So late a backup may be made: a computer that is off at night makes it in the morning."""
AGAIN_S: Final = 1800.0


def places(stage: Path, table: BackupTable) -> tuple[Place, ...]:
    """Where the backups of this stage go."""
    found: list[Place] = []
    if table.folder is not None:
        found.append(Folder(stage / table.folder, stage))
    if table.usb is not None:
        found.append(Stick(table.usb, stage))
    if table.ssh is not None:
        key_file = None if table.ssh_key_file is None else stage / table.ssh_key_file
        found.append(Server(table.ssh, key_file, table.ssh_host_key))
    return tuple(found)


class NightlyBackup:
    """``table`` and ``zone``: the settings and the schedule's time zone now; ``busy``: whether a job runs;
    ``places``: as the function.

    One thread calls ``step`` about twice a minute.
    """

    def __init__(
        self, stage: Path, table: Callable[[], BackupTable], zone: Callable[[], str], log: EventLog, *,
        busy: Callable[[], bool], wall: Callable[[], float] = time.time,
        places: Callable[[Path, BackupTable], Sequence[Place]] = places,
    ) -> None:  # fmt: skip
        self._stage, self._table, self._zone, self._log = stage, table, zone, log
        self._busy, self._wall, self._places = busy, wall, places
        self._again_at_s: dict[str, float] = {}
        self._failed_keys: set[str] = set()

    def step(self) -> None:
        """Make the backup of this day where it is due. One place that fails holds up no other."""
        table, now_s = self._table(), self._wall()
        now = datetime.fromtimestamp(now_s, zone_of(self._zone()))
        late_min = now.hour * 60 + now.minute - int(table.at[:2]) * 60 - int(table.at[3:])
        if not 0 <= late_min < WINDOW_MIN or self._busy():
            return
        done, day = self._log.done(), now.date().isoformat()
        due = {_key(place, day): place for place in self._places(self._stage, table)}
        due = {key: one for key, one in due.items() if key not in done and now_s >= self._again_at_s.get(one.name, 0.0)}
        if not due:
            return
        try:
            source = archive.backup(self._stage)
        except (VelaturaError, OSError) as error:
            for key, place in due.items():
                self._fail(key, place, error)
            return
        try:
            for key, place in due.items():
                try:
                    stored = place.store(source, f"{now:%Y%m%d}", table.keep)
                except (VelaturaError, OSError) as error:
                    self._fail(key, place, error)
                    continue
                self._log.mark_done(key, "made")
                self._log.add(stored)
        finally:
            source.unlink()

    def now(self) -> None:
        """Make a backup wherever stage.toml says, whatever the time. Minutes.

        Raises UsageError("backup-nowhere"), and what the first place raises that fails.
        """
        table = self._table()
        found = self._places(self._stage, table)
        if not found:
            raise UsageError("backup-nowhere", what="stage.toml names no place for backups.",
                             remedy="Add folder, usb or ssh under [backup].")  # fmt: skip
        day = f"{datetime.fromtimestamp(self._wall(), zone_of(self._zone())):%Y%m%d}"
        source = archive.backup(self._stage)
        try:
            for place in found:
                try:
                    self._log.add(place.store(source, day, table.keep))
                except OSError as error:
                    raise _explained(error) from error
        finally:
            source.unlink()

    def _fail(self, key: str, place: Place, error: VelaturaError | OSError) -> None:
        self._again_at_s[place.name] = self._wall() + AGAIN_S
        if key not in self._failed_keys:
            # Once a day for each place: it is tried again many times.
            self._failed_keys.add(key)
            said = _explained(error) if isinstance(error, OSError) else error
            self._log.add_failure(Decision("backup-failed", f"No backup was made. {said.what}", said.remedy, "error"))


def _key(place: Place, day: str) -> str:
    return f"backup {day}" if place.name == Folder.name else f"backup {place.name} {day}"


def _explained(error: OSError) -> VelaturaError:
    return UsageError("backup-disk", what=f"The disk for backups can't be written to: {error.strerror}.",
                      remedy="Check the disk for backups and its free space.")  # fmt: skip
