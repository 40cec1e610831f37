"""The time zone of a stage's times: that of its opening hours."""

from __future__ import annotations

import tomllib
import zoneinfo
from datetime import tzinfo
from typing import Final

from controller.core.errors import UsageError
from controller.core.files import read_text
from controller.stage.sessions.check import Checked

PANELS_FILE: Final = "schedule.toml"
"""Written by the panel; it replaces the table [schedule] of stage.toml."""


def time_zone(checked: Checked) -> tzinfo | None:
    """None, for the computer's own, on a stage that has no opening hours and names no zone, or one that is unknown."""
    table = checked.stage.tables.schedule
    named = table.time_zone if table.hours or table.time_zone != "UTC" else ""
    file = checked.stage.folder / PANELS_FILE
    if file.exists():
        try:
            named = str(tomllib.loads(read_text(file)).get("time_zone", named))
        except (UsageError, ValueError, OSError):
            return None
    try:
        return zoneinfo.ZoneInfo(named) if named else None
    except (zoneinfo.ZoneInfoNotFoundError, ValueError, OSError):
        return None
