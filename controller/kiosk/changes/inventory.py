"""An inventory: facts about computer, devices and settings at one time, and the files that keep it in the stage."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

from controller.core.errors import VelaturaError
from controller.core.files import read_bytes
from controller.core.storage import write_atomically

FOLDER: Final = "kiosk/inventories"
KEPT_NIGHTS: Final = 60
_GOOD: Final = "good.json"
_NIGHT: Final = re.compile(r"night-[0-9]{8}\.json")
LONGEST: Final = 2000
MOST_FACTS: Final = 20_000


@dataclass(frozen=True, slots=True)
class Fact:
    """``kind`` is a key of ``compare.KINDS``; ``name`` says which one of its kind; ``value`` is text, None while it
    can't be read (then it is not compared).
    """

    kind: str
    name: str
    value: str | None


@dataclass(frozen=True, slots=True)
class Inventory:
    """``run``: the run that graded well before it was taken; empty for one of a night."""

    taken_unix_s: float
    run: str
    facts: tuple[Fact, ...]


def keep_good(stage: Path, inventory: Inventory) -> None:
    """Replace the inventory of the last good day. Raises WorkError where the disk is full."""
    _write(stage / FOLDER / _GOOD, inventory)


def keep_night(stage: Path, day: str, inventory: Inventory) -> None:
    """Keep the inventory of a night (``day`` as 20260504), and the last ``KEPT_NIGHTS``. Raises as ``keep_good``."""
    _write(stage / FOLDER / f"night-{day}.json", inventory)
    for old in _nights(stage)[:-KEPT_NIGHTS]:
        old.unlink(missing_ok=True)


def last_good(stage: Path) -> Inventory | None:
    """The inventory of the last good day; None if there is none, or it can't be read."""
    return _read(stage / FOLDER / _GOOD)


def nights_after(stage: Path, unix_s: float) -> Iterable[Inventory]:
    """The readable inventories of the nights after that time, oldest first."""
    for path in _nights(stage):
        found = _read(path)
        if found is not None and found.taken_unix_s > unix_s:
            yield found


def _nights(stage: Path) -> list[Path]:
    return sorted(path for path in (stage / FOLDER).glob("night-*.json") if _NIGHT.fullmatch(path.name))


def _write(path: Path, inventory: Inventory) -> None:
    write_atomically(path, json.dumps(asdict(inventory)).encode(), mode=0o600)


def _read(path: Path) -> Inventory | None:
    try:
        content = json.loads(read_bytes(path))
        facts = tuple(_fact(row) for row in content["facts"][:MOST_FACTS])
        return Inventory(float(content["taken_unix_s"]), str(content["run"]), facts)
    except (OSError, VelaturaError, ValueError, KeyError, TypeError, RecursionError):
        return None


def _fact(row: dict[str, object]) -> Fact:
    value = row["value"]
    return Fact(str(row["kind"])[:LONGEST], str(row["name"])[:LONGEST], None if value is None else str(value)[:LONGEST])
