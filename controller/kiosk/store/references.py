"""The files that stage.toml, building.toml and scenes of Blender name: what a backup has to hold in addition."""

from __future__ import annotations

import contextlib
import gzip
import itertools
import os
import re
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final, TypeAlias

import zstandard

from controller.config import load_stage
from controller.config.loader import FILE
from controller.config.table import Holds, texts
from controller.core.errors import UsageError
from controller.core.files import read_text
from hal.secret_words import is_secret
from hal.toml_lines import KeyPath

BUILDING: Final = "building.toml"
OWN: Final = frozenset({
    FILE, f"{FILE}.before", "schedule.toml", "house.toml", BUILDING, "bench.toml", "profiles", "tapes", "run", "runs",
    "appearances", "bundles", "bundles-without", "lamps.json", "lamps-copy.json", "kiosk", "keys",
})  # fmt: skip
"""What Velatura itself keeps in a stage's folder (docs/architecture.md): no file with such a name comes with a backup
because stage.toml names it. ``bench`` is not among them: an emulated stage names profiles there, and they stay there.
"""

_LINK: Final = re.compile(rb"(//[^\0]{1,1021}|(?<=\0)/[^\0]{1,1022})\0")
"""A path in a scene, which Blender keeps as a text that ends with a zero; // at its start is the scene's folder."""
_AT_ONCE, _MOST_PARTS = 1 << 24, 256
_OPENERS: Final = {b"\x28\xb5\x2f\xfd": zstandard.open, b"\x1f\x8b\x08\x00": gzip.open}
"""How newer and older Blenders compress a scene, by its first bytes."""


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


def linked(scene: Path) -> set[Path]:
    """The files that a scene of Blender links to, as textures, and those of its libraries; none for another file."""
    found, new = set[Path](), {scene}
    while new:
        links = {link for one in new if one.suffix == ".blend" for link in _links(one)}
        new = links - found - {scene}
        found |= new
    return found


def _links(scene: Path) -> Iterator[Path]:
    """Without Blender, so its data are only searched for paths of files that are there."""
    with contextlib.suppress(OSError, EOFError, zstandard.ZstdError):
        with scene.open("rb") as file:
            opened: Any = _OPENERS.get(file.read(4), open)
        with opened(scene, "rb") as content:
            before = b""
            for data in itertools.islice(iter(partial(content.read, _AT_ONCE), b""), _MOST_PARTS):
                for text in {os.fsdecode(match[1]).replace("\\", "/") for match in _LINK.finditer(before + data)}:
                    place = scene.parent / text[2:] if text.startswith("//") else Path(text)
                    if _is_file(place):
                        yield Path(os.path.normpath(place))
                before = data[-1025:]


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
