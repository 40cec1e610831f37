"""Frozen dataclasses to TOML and back, with errors that name the key and the line.

A field with a default may be missing in the text. A value may be bool, int, float, str, a nested tuple of these with
fixed lengths, a dataclass (a table), or a tuple of dataclasses of any length (an array of tables).
"""

from __future__ import annotations

import dataclasses
import math
import tomllib
from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Final, TypeVar, get_args, get_origin, get_type_hints

from hal.errors import DeviceError
from hal.toml_lines import KeyLines, KeyPath

Table = TypeVar("Table")
_ALLOWED: Final = {float: "a finite number", int: "a whole number", bool: "true or false", str: "a text in quotes"}


@dataclasses.dataclass(frozen=True, slots=True)
class Between:
    """In ``Annotated[float, Between(low, high)]``: the number, or every number of the tuple, must lie there."""

    low: float
    high: float


@dataclasses.dataclass(frozen=True, slots=True, init=False)
class OneOf:
    """In ``Annotated[str, OneOf("a", "b")]``: the text must be one of these."""

    allowed: tuple[str, ...]

    def __init__(self, *allowed: str) -> None:
        object.__setattr__(self, "allowed", allowed)


_ANY_NUMBER: Final = Between(-math.inf, math.inf)


def dump(value: object) -> str:
    """The TOML text of a dataclass; ``load`` gives the same value back."""
    return "\n".join(_lines(value, "")).lstrip("\n") + "\n"


def load(text: str, kind: type[Table], *, file: str) -> Table:
    """Read ``kind`` from TOML text; ``file`` is the name used in errors.

    Raises DeviceError: ``bench-file-unreadable`` (not TOML), ``bench-key-unknown``, ``bench-key-missing`` or
    ``bench-key-wrong``; the last three name the key, its line, and what is allowed.
    """
    try:
        content = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise DeviceError(
            "bench-file-unreadable",
            what=f"{file} is not valid TOML: {error}.",
            remedy="Correct that line, or prepare the stage again.",
        ) from error
    return _Reader(text, file).table(content, kind, ())


def _lines(value: object, prefix: str) -> Iterator[str]:
    tables: list[tuple[str, object]] = []
    for field in dataclasses.fields(value):  # type: ignore[arg-type]
        item = getattr(value, field.name)
        if item == ():
            continue  # one that may be empty has that as its default
        if dataclasses.is_dataclass(item) or (isinstance(item, tuple) and dataclasses.is_dataclass(item[0])):
            tables.append((field.name, item))
        else:
            yield f"{field.name} = {_literal(item)}"
    for name, item in tables:
        path = f"{prefix}{name}"
        several = isinstance(item, tuple)
        for one in item if isinstance(item, tuple) else (item,):
            yield ""
            yield f"[[{path}]]" if several else f"[{path}]"
            yield from _lines(one, path + ".")


def _literal(value: object) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, tuple):
        return "[" + ", ".join(_literal(item) for item in value) + "]"
    if isinstance(value, str):
        escaped = value.replace("\\", "\\\\").replace('"', '\\"')
        return '"' + "".join(c if c.isprintable() else f"\\u{ord(c):04x}" for c in escaped) + '"'
    return repr(value)


class _Reader:
    def __init__(self, text: str, file: str) -> None:
        self._lines = KeyLines(text)
        self._file = file

    def table(self, content: Mapping[str, Any], kind: type[Table], path: KeyPath) -> Table:
        hints = get_type_hints(kind, include_extras=True)
        fields = {field.name: field.default for field in dataclasses.fields(kind)}  # type: ignore[arg-type]
        for key in content:
            if key not in fields:
                raise self._error("unknown", (*path, key), f"is not known; allowed are {', '.join(fields)}")
        for key, default in fields.items():
            if key not in content and default is dataclasses.MISSING:
                raise self._error("missing", (*path, key), "is missing")
        values = {key: self.value(content[key], hints[key], (*path, key)) for key in fields if key in content}
        return kind(**values)

    def value(self, item: Any, hint: Any, path: KeyPath, limits: Between | OneOf = _ANY_NUMBER) -> Any:
        if get_origin(hint) is Annotated:
            return self.value(item, get_args(hint)[0], path, get_args(hint)[1])
        if isinstance(hint, type) and dataclasses.is_dataclass(hint):
            if not isinstance(item, dict):
                raise self._error("wrong", path, "must be a table")
            return self.table(item, hint, path)
        if get_origin(hint) is tuple:
            return self._sequence(item, get_args(hint), path, limits)
        return self._scalar(item, hint, path, limits)

    def _sequence(self, item: Any, hints: tuple[Any, ...], path: KeyPath, limits: Between | OneOf) -> tuple[Any, ...]:
        open_ended = len(hints) == 2 and hints[1] is Ellipsis
        if not isinstance(item, list) or (not open_ended and len(item) != len(hints)) or not item:
            count = "one or more" if open_ended else str(len(hints))
            raise self._error("wrong", path, f"must be a list of {count} values")
        each = [hints[0]] * len(item) if open_ended else hints
        return tuple(
            self.value(one, hint, (*path, i), limits) for i, (one, hint) in enumerate(zip(item, each, strict=True))
        )

    def _scalar(self, item: Any, hint: type, path: KeyPath, limits: Between | OneOf) -> Any:
        if hint is float and isinstance(item, int) and not isinstance(item, bool):
            item = float(item)
        if type(item) is not hint or (isinstance(item, float) and not math.isfinite(item)):
            raise self._error("wrong", path, f"must be {_ALLOWED[hint]}")
        if isinstance(limits, OneOf):
            if item not in limits.allowed:
                raise self._error("wrong", path, f"is {item!r}, and must be one of {', '.join(limits.allowed)}")
            return item
        if isinstance(item, int | float) and not limits.low <= item <= limits.high:
            raise self._error("wrong", path, f"is {item}, and must lie between {limits.low:g} and {limits.high:g}")
        return item

    def _error(self, code: str, path: KeyPath, what: str) -> DeviceError:
        key = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in path).lstrip(".")
        return DeviceError(
            f"bench-key-{code}",
            what=f"{self._file}, line {self._lines.line(path)}: the key {key} {what}.",
            remedy="Correct that line, or prepare the stage again.",
        )
