"""Writing TOML in the layout of stage.toml; tomlkit spells the values."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path, PurePath
from typing import Any, Final

import tomlkit

from controller.config.models import StageTables
from controller.core.storage import write_atomically

_BARE: Final = re.compile(r"[A-Za-z0-9_-]+")
_HEADING: Final = """\
# A Velatura stage: the devices, the object and the options that a technician knows.
# Relative paths start at this file's folder. Every command checks it first, and names the line of a mistake.
"""


def write_stage(path: Path, content: Mapping[str, Any]) -> None:
    """Write ``content`` as stage.toml at ``path`` atomically, with a comment above each table saying what it is."""
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
