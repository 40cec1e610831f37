"""What changed settings make a running kiosk do, and the last settings with which it ran."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

from controller.config.loader import FILE
from controller.config.models import StageTables
from controller.core import kiosk_places
from controller.core.errors import UsageError, VelaturaError
from controller.core.files import read_bytes
from controller.core.storage import write_atomically
from controller.kiosk.store.event_log import Decision
from controller.kiosk.store.settings import checked_settings
from controller.stage.sessions.check import Checked
from hal.registry import Drivers

GOOD: Final = "kiosk/stage.toml.good"
"""A copy of the stage.toml that the kiosk last ran with."""
_READ_WHEN_NEEDED: Final = frozenset(
    {"stage", "object", "capture", "calibration", "solve", "appearances", "disk", "backup", "alerts"}
)
"""Tables that no device and no supervisor depends on."""


@dataclass(frozen=True, slots=True)
class Change:
    """``tables``: the names of those that differ; ``lamps``: the projectors whose lamps must not stay lit."""

    tables: frozenset[str] = frozenset()
    lamps: tuple[str, ...] = ()

    @property
    def restarts(self) -> bool:
        """Whether devices are opened again."""
        return not self.tables <= _READ_WHEN_NEEDED

    def warning(self, stage: Path) -> str:
        """What people will see of it; empty if that is nothing."""
        if not self.restarts:
            return ""
        black = "" if kiosk_places.is_installed(stage) else " The picture is black for about two seconds."
        if not self.lamps:
            return f"The devices are opened again. The lamps stay lit.{black}"
        names = ", ".join(self.lamps)
        return f"The lamp of {names} is switched off, cools, and is switched on again, which takes minutes.{black}"


def change(before: StageTables, after: StageTables) -> Change:
    """What differs. A projector that is another one now, or whose mains are, must not stay lit without control."""
    # As plain values: the tables themselves also know their lines, which a comment changes.
    was, now = before.model_dump(), after.model_dump()
    names = (name for name in was if was[name] != now[name])
    old, new = ({table["name"]: table for table in values["projectors"]} for values in (was, now))
    moved = [name for name, table in old.items() if new.get(name) != table]
    fed = {name for table in before.relays for mains in table.mains for name in mains.feeds}
    if was["relays"] != now["relays"]:
        moved = [name for name in old if name in moved or name in fed]
    return Change(frozenset(names), tuple(moved))


class GoodSettings:
    """Keeps the stage.toml that the kiosk runs with, to start with it if the next one is damaged.

    A disk that can't be written keeps the older copy until it can: ``step`` tries again.
    """

    def __init__(self) -> None:
        self._waiting: tuple[Path, bytes] | None = None

    def keep(self, checked: Checked) -> None:
        """Keep the stage.toml that ``checked`` was just read from."""
        stage = checked.stage.folder
        try:
            self._waiting = stage / GOOD, read_bytes(stage / FILE)
        except (OSError, VelaturaError):
            return
        self.step()

    def step(self) -> None:
        """Write what could not be written yet."""
        if self._waiting is None:
            return
        path, content = self._waiting
        try:
            if not path.exists() or read_bytes(path) != content:
                path.parent.mkdir(parents=True, exist_ok=True)
                write_atomically(path, content, mode=0o600)
        except (OSError, VelaturaError):
            return
        self._waiting = None


def last_good(stage: Path, error: UsageError, drivers: Drivers | None = None) -> tuple[Checked, Decision]:
    """The settings that the kiosk last ran with, and what people must know. Raises ``error`` if there are none."""
    if error.code == "stage-missing" or not (stage / GOOD).is_file():
        raise error
    try:
        checked = checked_settings(stage, drivers, instead=stage / GOOD)
    except VelaturaError:
        raise error from None
    why = f"{error.what} The kiosk runs with the last good settings, and starts no job."
    return checked, Decision("settings-damaged", why, error.remedy, "error")
