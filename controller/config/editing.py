"""Changing a stage.toml that a person wrote: comments, order and everything else stay as they are."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from controller.config.lines import KeyLines, KeyPath
from controller.config.loader import parse_stage
from controller.config.models import StageTables
from controller.config.problems import Place
from controller.config.writer import toml_text
from controller.errors import UsageError
from controller.storage import write_atomically

_PAIR: Final = re.compile(r"""^(\s*[A-Za-z0-9_-]+\s*=\s*)("[^"]*"|'[^']*'|[^"'#\[\]{}]*?)(\s*(?:#.*)?)$""")


@dataclass(frozen=True, slots=True)
class Change:
    """``key`` = ``value`` in the table at ``path``, e.g. ``("projectors", 0)``: changed, or added."""

    path: KeyPath
    key: str
    value: str | int | float | bool


def edited(text: str, changes: Sequence[Change] = (), tables: Mapping[str, Any] | None = None) -> str:
    """The text with the changes, and with further top-level ``tables`` after its end.

    Raises UsageError("stage-not-editable") where a value stands so that no line of its own can be replaced.
    """
    for change in changes:
        text = _changed(text, change)
    if tables:
        text = text.rstrip("\n") + "\n\n" + toml_text(tables).lstrip("\n")
    return text


def rewrite_stage(
    file: Path,
    changes: Sequence[Change] = (),
    tables: Mapping[str, Any] | None = None,
    *,
    check: Callable[[StageTables], None] = lambda tables: None,
) -> None:
    """Edit the stage.toml at ``file``: checked as ``load_stage`` does and by ``check``, then replaced atomically.

    Raises UsageError as ``load_stage`` for what would be wrong with it (nothing is written then), and WorkError.
    """
    text = edited(file.read_text(encoding="utf-8"), changes, tables)
    check(parse_stage(tomllib.loads(text), Place(file.name, KeyLines(text))))
    write_atomically(file, text.encode())


def _changed(text: str, change: Change) -> str:
    content: Any = tomllib.loads(text)
    for part in change.path:
        content = content[part]
    lines = text.split("\n")
    pair = toml_text({change.key: change.value}).strip()
    where = KeyLines(text)
    if change.key not in content:
        at = where.line(change.path)
        if not lines[at - 1].lstrip().startswith("["):
            raise _not_editable(at, pair)
        return "\n".join([*lines[:at], pair, *lines[at:]])
    at = where.line((*change.path, change.key))
    match = _PAIR.match(lines[at - 1])
    if match is None:
        raise _not_editable(at, pair)
    lines[at - 1] = match[1] + pair.partition("=")[2].strip() + match[3]
    changed = "\n".join(lines)
    content = tomllib.loads(changed)
    for part in change.path:
        content = content[part]
    if content.get(change.key) != change.value:
        raise _not_editable(at, pair)
    return changed


def _not_editable(line: int, pair: str) -> UsageError:
    return UsageError(
        "stage-not-editable",
        what=f"stage.toml, line {line}, is written so that only a person can change it safely.",
        remedy=f"Write {pair} there.",
    )
