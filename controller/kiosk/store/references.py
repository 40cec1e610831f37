"""The files that stage.toml and building.toml name, wherever they are: what a backup has to hold in addition."""

from __future__ import annotations

import contextlib
import os
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, TypeAlias

from controller.config import load_stage
from controller.config.loader import FILE
from controller.config.table import Holds, texts
from controller.core.errors import UsageError
from controller.core.files import read_text
from hal.secret_words import is_secret
from hal.toml_lines import KeyPath

BUILDING: Final = "building.toml"
OWN: Final = frozenset({
    FILE, f"{FILE}.before", "schedule.toml", BUILDING, "bench.toml", "profiles", "tapes", "run", "runs",
    "appearances", "bundles", "bundles-without", "lamps.json", "lamps-copy.json", "kiosk", "keys",
})  # fmt: skip
"""What Velatura itself keeps in a stage's folder (docs/architecture.md): no file with such a name comes with a backup
because stage.toml names it. ``bench`` is not among them: an emulated stage names profiles there, and they stay there.
"""


@dataclass(frozen=True, slots=True)
class Reference:
    """``file`` names at ``path`` a file: ``text`` as it is written, ``place`` where it lies."""

    file: str
    path: KeyPath
    text: str
    place: Path
    holds: Holds

    @property
    def missing(self) -> str:
        """A sentence about a file that does not exist; "" for one that is there."""
        return "" if self.place.is_file() else f"{self.file} names {self.text}, which is not a file."


def references(stage: Path) -> list[Reference]:
    """What the stage refers to. A driver's setting counts where it names a file that is there.

    What is wrong in these files names nothing.
    """
    found = []
    for file, (path, text, holds) in [*_of_stage(stage), *_of_building(stage)]:
        place = Path(os.path.normpath(stage.absolute() / text))
        if holds is Holds.SETTING and not _is_file(place):
            continue
        if holds is Holds.SETTING:
            # Also the password file of a driver that is not known here must not come out.
            secret = any(is_secret(str(key).removesuffix("_file")) for key in path) or _private(stage, place)
            found.append(Reference(file, path, text, place, Holds.KEY_FILE if secret else Holds.FILE))
        elif holds is not None:
            found.append(Reference(file, path, text, place, holds))
    return found


_Text: TypeAlias = tuple[str, tuple[KeyPath, str, Holds | None]]


def _of_stage(stage: Path) -> Iterator[_Text]:
    with contextlib.suppress(UsageError):
        yield from ((FILE, one) for one in texts(load_stage(stage).tables))


def _of_building(stage: Path) -> Iterator[_Text]:
    for path, text, _ in texts(building(stage)):
        named = str(path[-1]).endswith("file")
        holds = Holds.KEY_FILE if is_secret(str(path[-1]).removesuffix("_file")) else Holds.FILE
        yield BUILDING, (path, text, holds if named else Holds.SETTING)


def building(stage: Path) -> dict[str, Any]:
    """The tables of building.toml, unchecked; {} for none, or one that is damaged: it stops no stage."""
    try:
        return tomllib.loads(read_text(stage / BUILDING))
    except (OSError, ValueError):
        return {}


def _private(stage: Path, place: Path) -> bool:
    return any(place.is_relative_to(stage.absolute() / name) for name in ("keys", "kiosk"))


def _is_file(place: Path) -> bool:
    try:
        return place.is_file()
    except (OSError, ValueError):  # a long text, or one with a NUL, is no path
        return False
