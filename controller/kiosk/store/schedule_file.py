"""The stage's schedule: schedule.toml, written by the panel, or else the table [schedule] of stage.toml."""

from __future__ import annotations

import threading
import tomllib
from collections.abc import Collection
from pathlib import Path
from typing import Final

from pydantic import ValidationError

from controller.config.models import ScheduleTable
from controller.config.writer import toml_text
from controller.core.errors import UsageError
from controller.core.files import read_text
from controller.core.storage import write_atomically
from controller.kiosk.decide.days import expanded
from controller.kiosk.decide.hours import check_overlaps, check_schedule
from controller.kiosk.interface import Schedule, ScheduleRow
from controller.stage.sessions.check import PANELS_FILE

FILE: Final = PANELS_FILE
_HEADING: Final = "# Opening hours, written by the panel. This file replaces [schedule] in stage.toml.\n\n"


def of_table(table: ScheduleTable) -> Schedule:
    """The days may be written as on the panel's page. Raises UsageError as ``expanded`` and ``check_schedule``."""
    rows = expanded([ScheduleRow(row.day, row.opens, row.closes, row.appearance) for row in table.hours])
    schedule = Schedule(table.time_zone, rows, table.drift_check)
    check_schedule(schedule)
    return schedule


def check(schedule: Schedule, appearances: Collection[str]) -> None:
    """What is refused before it is kept. Raises UsageError as ``check_schedule`` and ``check_overlaps``."""
    check_schedule(schedule, appearances)
    check_overlaps(schedule)


class ScheduleFile:
    """The current schedule; read once, changed by ``replace``. Thread-safe."""

    def __init__(self, stage: Path, table: ScheduleTable) -> None:
        self._path, self._lock = stage / FILE, threading.Lock()
        self._without_time = table.without_time
        self.problem: UsageError | None = None
        self._now = of_table(table)
        try:
            self._now = self._read() or self._now
        except UsageError as error:
            # A damaged file must not keep the stage dark; the hours of stage.toml apply until it is saved again.
            self.problem = error

    @property
    def now(self) -> Schedule:
        return self._now

    @property
    def open_without_time(self) -> bool:
        return self._without_time == "open"

    def replace(self, schedule: Schedule, appearances: Collection[str]) -> None:
        """Check it, write it, and use it. Raises as ``check``, WorkError("no-space")."""
        check(schedule, appearances)
        hours = [
            {"day": row.day, "opens": row.opens, "closes": row.closes, "appearance": row.appearance}
            for row in schedule.rows
        ]
        content = {
            "time_zone": schedule.time_zone, "drift_check": schedule.drift_check,
            "without_time": self._without_time, "hours": hours,
        }  # fmt: skip
        with self._lock:
            write_atomically(self._path, (_HEADING + toml_text(content)).encode())
            self._now, self.problem = schedule, None

    def _read(self) -> Schedule | None:
        try:
            content = tomllib.loads(read_text(self._path))
            table = ScheduleTable.model_validate(content)
        except FileNotFoundError:
            return None
        except (OSError, ValueError, ValidationError, RecursionError) as error:
            raise UsageError(
                "schedule-unreadable",
                what=f"{FILE} can't be read: {_reason(error)}.",
                remedy="Save the schedule again in the panel. Until then the hours in stage.toml apply.",
            ) from error
        self._without_time = table.without_time
        return of_table(table)


def _reason(error: Exception) -> str:
    return (error.strerror if isinstance(error, OSError) else None) or (str(error).splitlines() or ["it is not valid"])[
        0
    ]
