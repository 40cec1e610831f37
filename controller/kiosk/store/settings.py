"""Changes to stage.toml: validated before they are saved, with a copy of the old text."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from controller.config.loader import FILE, LARGEST_BYTES, parse_stage
from controller.config.models import StageTables
from controller.config.problems import Place
from controller.config.writer import rewrite_stage
from controller.core import kiosk_places
from controller.core.errors import UsageError, VelaturaError
from controller.core.files import LARGEST_TEXT, read_bytes
from controller.core.storage import write_atomically
from controller.kiosk.schedule import of_table
from controller.stage.artefacts.solved import remove_solved
from controller.stage.sessions.calibrations import finished_calibrations
from controller.stage.sessions.check import Checked, check_stage
from hal.notices import Level, Notice
from hal.registry import Drivers
from hal.toml_lines import KeyLines

BEFORE: Final = "stage.toml.before"
_NAME: Final = re.compile(r"[A-Za-z0-9\u00C0-\u024F][A-Za-z0-9\u00C0-\u024F_-]{0,63}")


def text(stage: Path) -> str:
    """The text of stage.toml, empty if there is none."""
    file = stage / FILE
    return read_bytes(file, LARGEST_TEXT).decode("utf-8-sig", errors="replace") if file.exists() else ""


def validate(content: str) -> None:
    """Raises UsageError naming line, key and what is allowed."""
    if len(content.encode()) > LARGEST_BYTES:
        raise UsageError("stage-unreadable", what=f"{FILE} is too long.", remedy="Write less than 1 MiB.")
    try:
        parsed = tomllib.loads(content)
    except (ValueError, RecursionError) as error:
        raise UsageError(
            "stage-syntax", what=f"{FILE} is not valid TOML: {error}.", remedy="Correct this line."
        ) from error
    of_table(parse_stage(parsed, Place(FILE, KeyLines(content))).schedule)


def checked_settings(stage: Path, drivers: Drivers | None = None, *, instead: Path | None = None) -> Checked:
    """As ``check_stage``, and what else no kiosk starts without: opening hours, and a display that plays bundles.

    Raises also as ``check_schedule``, and UsageError("display-plays-no-bundles").
    """
    checked = check_stage(stage, drivers=drivers, instead=instead)
    of_table(checked.stage.tables.schedule)
    if checked.stage.tables.display.driver != "player":
        raise UsageError(
            "display-plays-no-bundles",
            what="A kiosk needs the player as its display.",
            remedy='Use the driver "player" under [display] in stage.toml.',
        )
    return checked


def tables_of(content: str) -> StageTables:
    """The tables of a text that ``validate`` accepts."""
    return parse_stage(tomllib.loads(content), Place(FILE, KeyLines(content)))


def save(stage: Path, content: str, drivers: Drivers | None = None) -> None:
    """Validate, also the keys of drivers, keep the old text as ``BEFORE``, and write.

    Raises UsageError as above; stage.toml is then unchanged.
    """
    validate(content)
    before = text(stage)
    write_atomically(stage / FILE, content.encode())
    try:
        check_stage(stage, drivers=drivers)
    except BaseException:
        if before:
            write_atomically(stage / FILE, before.encode())
        else:
            (stage / FILE).unlink()
        raise
    if before:
        write_atomically(stage / BEFORE, before.encode())


def with_own_key(stage: Path, content: str) -> str:
    """The text of a first stage.toml, with the stage's signing key as a trusted one; the key is made if there is none.

    Without it the stage would refuse its own bundles. Raises as ``validate``, and what ``make_key`` raises.
    """
    from controller.bundle.signing import load_signing_key
    from controller.stage.services.bundle import make_key
    from controller.stage.sessions.calibrations import KEY_FILE

    validate(content)
    if tables_of(content).bundle.trusted_keys:
        return content
    key = stage / KEY_FILE
    public = bytes(load_signing_key(key).verify_key).hex() if key.exists() else make_key(stage, key.stem)["public"]
    return f'{content.rstrip()}\n\n[bundle]\ntrusted_keys = ["{public}"]\n'


def check_name(name: str) -> None:
    """Raises UsageError("appearance-name")."""
    if not _NAME.fullmatch(name):
        raise UsageError("appearance-name", what=f"{name[:64]!r} is not a valid name for an appearance.",
                         remedy="Use 1 to 64 letters, digits, - and _. Start with a letter or digit.")  # fmt: skip


def add_appearance(stage: Path, entry: Mapping[str, str]) -> None:
    """Add a table of ``[[appearances]]`` to stage.toml, unless it is there; a table there may have more settings.

    Raises UsageError("appearance-other") if the name has a target of another kind, and as ``rewrite_stage``.
    """
    rows = tomllib.loads(text(stage)).get("appearances", [])
    there = next((row for row in rows if row.get("name") == entry["name"]), None)
    if there is None:
        rewrite_stage(stage / FILE, (), {"appearances": [dict(entry)]})
    elif not entry.items() <= there.items():
        raise UsageError("appearance-other", what=f"{entry['name']} is an appearance that was made in another way.",
                         remedy="Choose another name, or remove that appearance first.")  # fmt: skip


def remove_picture(stage: Path, name: str) -> None:
    """Remove an appearance from stage.toml. Raises UsageError("appearance-unknown") and as ``rewrite_stage``."""
    content = text(stage)
    parsed = tomllib.loads(content)
    position = next((n for n, row in enumerate(parsed.get("appearances", [])) if row.get("name") == name), None)
    if position is None:
        raise UsageError("appearance-unknown", what=f"stage.toml has no appearance {name[:64]!r}.",
                         remedy="Choose another one.")  # fmt: skip
    lines = content.split("\n")
    first = KeyLines(content).line(("appearances", position)) - 1
    following = (n for n in range(first + 1, len(lines)) if lines[n].lstrip().startswith("["))
    last = next(following, len(lines))
    left = "\n".join([*lines[:first], *lines[last:]])
    validate(left)
    write_atomically(stage / FILE, left.encode())


def forget_solved(stage: Path, name: str) -> None:
    """Delete an appearance's frames of the newest calibration; otherwise every new bundle would contain it."""
    for run in finished_calibrations(stage)[:1]:
        remove_solved(run, name)


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
                write_atomically(path, content, mode=0o600)
        except (OSError, VelaturaError):
            return
        self._waiting = None


def last_good(stage: Path, error: UsageError, drivers: Drivers | None = None) -> tuple[Checked, Notice]:
    """The settings that the kiosk last ran with, and what people must know. Raises ``error`` if there are none."""
    if error.code == "stage-missing" or not (stage / GOOD).is_file():
        raise error
    try:
        checked = checked_settings(stage, drivers, instead=stage / GOOD)
    except VelaturaError:
        raise error from None
    why = f"{error.what} The kiosk runs with the last good settings, and starts no job."
    return checked, Notice("settings-damaged", why, error.remedy, Level.ERROR)
