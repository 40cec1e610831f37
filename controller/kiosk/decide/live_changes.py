"""What people change of the picture while the stage is open: black, pause, brightness, and where the list goes on."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, fields, replace
from typing import Any, Final

from controller.kiosk.store.event_log import EventLog

KEY: Final = "live-changes"


@dataclass(frozen=True, slots=True)
class LiveChanges:
    """``held``: the appearance at which the list is paused, or empty; ``first``: where the list begins, or empty;
    ``fade_s``: how long the next picture fades in, None: as the list says; ``brightness``: 0..1.
    """

    black: bool = False
    held: str = ""
    first: str = ""
    brightness: float = 1.0
    fade_s: float | None = None


class LiveChangesKept:
    """They are stored in the event log's file, to survive a restart."""

    def __init__(self, log: EventLog) -> None:
        self._log = log
        self.now = _read(log.value(KEY))

    def change(self, **values: Any) -> None:
        self._set(replace(self.now, **values))

    def end(self) -> None:
        """Back to the usual, as when the stage closes."""
        self._set(LiveChanges())

    def _set(self, changes: LiveChanges) -> None:
        if changes != self.now:
            self.now = changes
            self._log.keep(KEY, json.dumps(asdict(changes)))


def _read(text: str | None) -> LiveChanges:
    """A damaged entry only ends the changes."""
    try:
        stored: Any = json.loads(text or "{}")
    except (ValueError, RecursionError):
        return LiveChanges()
    usual = LiveChanges()
    if not isinstance(stored, dict) or set(stored) != {field.name for field in fields(LiveChanges)}:
        return usual
    brightness, fade_s = stored["brightness"], stored["fade_s"]
    right = isinstance(stored["black"], bool) and isinstance(stored["held"], str) and isinstance(stored["first"], str)
    right = right and isinstance(brightness, int | float) and 0 <= brightness <= 1
    right = right and (fade_s is None or (isinstance(fade_s, int | float) and 0 <= fade_s <= 600))
    return LiveChanges(**stored) if right else usual
