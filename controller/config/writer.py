"""Writing a stage.toml, and changing one that a person wrote: comments, order and all else stay as they are."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Any, Final

import tomlkit
import tomlkit.container
import tomlkit.exceptions
import tomlkit.items

from controller.config.loader import parse_stage
from controller.config.models import StageTables
from controller.config.problems import Place
from controller.core.errors import UsageError
from controller.core.files import read_text
from controller.core.storage import write_atomically
from hal.toml_lines import KeyLines, KeyPath

_BARE: Final = re.compile(r"[A-Za-z0-9_-]+")
_HEADING: Final = """\
# A Velatura stage: the devices, the object and the options that a technician knows.
# Relative paths start at this file's folder. Every command checks it first, and names the line of a mistake.
"""


def write_stage(path: Path, content: Mapping[str, Any]) -> None:
    """Write ``content`` as stage.toml at ``path`` atomically, with a comment above each table that describes it."""
    comments = {key: field.description for key, field in StageTables.model_fields.items() if field.description}
    write_atomically(path, (_HEADING + "\n" + toml_text(content, comments)).encode())


def toml_text(content: Mapping[str, Any], comments: Mapping[str, str] | None = None) -> str:
    """TOML of nested mappings, lists, strings, paths, booleans, integers and floats; ``tomllib`` reads the same back.

    Keys keep their order, but values come before tables, as TOML demands. A list that holds only mappings (and at least
    one) becomes a list of tables. None leaves a key out. Raises TypeError for other types, and for None in a list.

    Parameters
    ----------
    comments : top-level table -> a line above its first header
    """
    return "\n".join("\n".join(block) + "\n" for block in _blocks(content, (), comments or {}) if block)


def _blocks(table: Mapping[str, Any], path: tuple[str, ...], comments: Mapping[str, str]) -> Iterator[list[str]]:
    """The table's own pairs first, under the header that the caller has written; then its tables, a block each."""
    yield [
        f"{_key(key)} = {_value(value)}" for key, value in table.items() if value is not None and not _is_table(value)
    ]
    for key, value in table.items():
        if value is None or not _is_table(value):
            continue
        inner = (*path, key)
        name = ".".join(map(_key, inner))
        comment = [f"# {comments[key]}"] if not path and key in comments else []
        items = [(f"[{name}]", value)] if isinstance(value, Mapping) else [(f"[[{name}]]", item) for item in value]
        for header, item in items:
            first, *further = _blocks(item, inner, comments)
            yield [*comment, header, *first]
            yield from further
            comment = []


def _is_table(value: Any) -> bool:
    if isinstance(value, Mapping):
        return True
    return _is_list(value) and len(value) > 0 and all(isinstance(item, Mapping) for item in value)


def _is_list(value: Any) -> bool:
    return isinstance(value, Sequence) and not isinstance(value, str | bytes | bytearray)


def _key(key: str) -> str:
    # tomlkit writes letters of any language bare, which TOML 1.0 does not allow
    return key if _BARE.fullmatch(key) else tomlkit.item(key).as_string()


def _value(value: Any) -> str:
    if isinstance(value, Mapping):
        pairs = (f"{_key(key)} = {_value(item)}" for key, item in value.items() if item is not None)
        return "{" + ", ".join(pairs) + "}"
    if _is_list(value):
        return "[" + ", ".join(map(_value, value)) + "]"
    if isinstance(value, bool | int | float | str | PurePath):
        return tomlkit.item(str(value) if isinstance(value, PurePath) else value).as_string()
    raise TypeError(f"TOML has no {type(value).__name__}")


@dataclass(frozen=True, slots=True)
class KeyChange:
    """``key`` = ``value`` in the table at ``path``, e.g. ``("projectors", 0)``: changed, added, or removed (None)."""

    path: KeyPath
    key: str
    value: str | float | bool | list[str] | None


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
    _put(_table_at(wanted, change.path), change)
    try:
        document = tomlkit.parse(text)
        _assign(_table_at(document, change.path), change, "\r\n" if "\r\n" in text else "\n")
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


def _put(table: Any, change: KeyChange) -> None:
    if change.value is None:
        table.pop(change.key, None)
    else:
        table[change.key] = change.value


def _assign(table: Any, change: KeyChange, end: str) -> None:
    """Change or remove a key, or add it after the table's last own one: before comments and tables that follow."""
    container = table.value if isinstance(table, tomlkit.items.Table) else table
    if change.value is None or change.key in table or not isinstance(container, tomlkit.container.Container):
        _put(table, change)
        return
    added = tomlkit.item(change.value)
    added.trivia.trail = end
    own = [n for n, (name, item) in enumerate(container.body) if name is not None and not _stands_as_table(item)]
    first = own[-1] + 1 if own else 0
    after = container.body[first:]
    del container.body[first:]
    table[change.key] = added
    container.body.extend(after)


def _stands_as_table(item: Any) -> bool:
    return isinstance(item, tomlkit.items.Table | tomlkit.items.AoT)


def _not_editable(line: int, pair: str) -> UsageError:
    pair = pair.strip()
    return UsageError(
        "stage-not-editable",
        what=f"stage.toml, line {line}, has a form that Velatura can't change safely.",
        remedy=f"Edit the file and write {pair} there.",
    )
