"""Changing a stage.toml that a person wrote: comments, order and everything else stay as they are."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tomlkit
import tomlkit.container
import tomlkit.exceptions
import tomlkit.items

from controller.config.lines import KeyLines, KeyPath
from controller.config.loader import parse_stage
from controller.config.models import StageTables
from controller.config.problems import Place
from controller.config.writer import toml_text
from controller.core.errors import UsageError
from controller.core.files import read_text
from controller.core.storage import write_atomically


@dataclass(frozen=True, slots=True)
class KeyChange:
    """``key`` = ``value`` in the table at ``path``, e.g. ``("projectors", 0)``: changed, or added."""

    path: KeyPath
    key: str
    value: str | int | float | bool


def edited(text: str, changes: Sequence[KeyChange] = (), tables: Mapping[str, Any] | None = None) -> str:
    """The text with the changes, and with further top-level ``tables`` after its end.

    Raises UsageError("stage-not-editable") where the text would not hold the change and all else as it was.
    """
    for change in changes:
        text = _changed(text, change)
    if tables:
        text = text.rstrip("\n") + "\n\n" + toml_text(tables).lstrip("\n")
    return text


def rewrite_stage(
    file: Path,
    changes: Sequence[KeyChange] = (),
    tables: Mapping[str, Any] | None = None,
    *,
    check: Callable[[StageTables], None] = lambda tables: None,
) -> None:
    """Edit the stage.toml at ``file``: checked as ``load_stage`` does and by ``check``, then replaced atomically.

    Raises UsageError as ``load_stage`` for what would be wrong with it (nothing is written then), and WorkError.
    """
    text = edited(read_text(file), changes, tables)
    check(parse_stage(tomllib.loads(text), Place(file.name, KeyLines(text))))
    write_atomically(file, text.encode())


def _changed(text: str, change: KeyChange) -> str:
    wanted: Any = tomllib.loads(text)
    _table_at(wanted, change.path)[change.key] = change.value
    try:
        document = tomlkit.parse(text)
        _assign(_table_at(document, change.path), change.key, change.value, "\r\n" if "\r\n" in text else "\n")
        changed = tomlkit.dumps(document)
        safe = bool(tomllib.loads(changed) == wanted)
    # What tomlkit can't read or place, and what it would write wrongly, is left to a person.
    except (tomlkit.exceptions.TOMLKitError, tomllib.TOMLDecodeError, LookupError, TypeError):
        safe = False
    if not safe:
        raise _not_editable(KeyLines(text).line((*change.path, change.key)), toml_text({change.key: change.value}))
    return changed


def _table_at(content: Any, path: KeyPath) -> Any:
    for part in path:
        content = content[part]
    return content


def _assign(table: Any, key: str, value: str | int | float | bool, end: str) -> None:
    """Change a key, or add it after the table's last own one: before comments and tables that follow."""
    container = table.value if isinstance(table, tomlkit.items.Table) else table
    if key in table or not isinstance(container, tomlkit.container.Container):
        table[key] = value
        return
    added = tomlkit.item(value)
    added.trivia.trail = end
    own = [n for n, (name, item) in enumerate(container.body) if name is not None and not _is_table(item)]
    first = own[-1] + 1 if own else 0
    after = container.body[first:]
    del container.body[first:]
    table[key] = added
    container.body.extend(after)


def _is_table(item: Any) -> bool:
    return isinstance(item, tomlkit.items.Table | tomlkit.items.AoT)


def _not_editable(line: int, pair: str) -> UsageError:
    pair = pair.strip()
    return UsageError(
        "stage-not-editable",
        what=f"stage.toml, line {line}, has a form that Velatura can't change safely.",
        remedy=f"Edit the file and write {pair} there.",
    )
