"""Typed reading of a TOML text; errors name the line. Pure: text in, values out."""

from __future__ import annotations

import difflib
import math
import tomllib
from collections.abc import Mapping, Sequence
from typing import Any, Final

from hal.errors import ProtocolError
from hal.escapes import toml_value
from hal.toml_lines import KeyLines

_LONGEST: Final = 1 << 20


def parse_toml(text: str, *, file: str) -> Table:
    """The whole document as a ``Table``. Raises ProtocolError("profile-wrong") for anything that is not TOML."""
    if len(text) > _LONGEST:
        raise _wrong(file, None, "it is longer than a megabyte")
    try:
        data = tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise _wrong(file, None, f"it is not TOML: {error}") from error
    return Table(data, (), text, file)


class Table:
    """One table of the document. Read every allowed key, then call ``finish``."""

    def __init__(self, data: Mapping[str, Any], path: tuple[str, ...], text: str, file: str) -> None:
        self._data = data
        self._path = path
        self._text = text
        self._file = file
        self._asked: set[str] = set()

    def has(self, key: str) -> bool:
        self._asked.add(key)
        return key in self._data

    def string(self, key: str, default: str | None = None) -> str:
        return str(self._value(key, str, "a string", default))

    def integer(self, key: str, low: int, high: int, default: int | None = None) -> int:
        value = self._value(key, int, "a whole number", default)
        if not low <= value <= high:
            raise self.wrong(key, f"{value} is not between {low} and {high}")
        return int(value)

    def seconds(self, key: str, low: float, high: float) -> float:
        value = self._value(key, (int, float), "a number of seconds", None)
        if not math.isfinite(value) or not low <= value <= high:
            raise self.wrong(key, f"{value} seconds is not between {low:g} and {high:g}")
        return float(value)

    def choice(self, key: str, allowed: Sequence[str], default: str | None = None) -> str:
        value = self.string(key, default)
        if value not in allowed:
            raise self.wrong(key, f"{toml_value(value)} is not one of {', '.join(allowed)}")
        return value

    def flag(self, key: str) -> bool:
        """true or false; false if absent."""
        value = self._data.get(key, False)
        self._asked.add(key)
        if not isinstance(value, bool):
            raise self.wrong(key, f"{toml_value(value)} is not true or false")
        return value

    def strings(self, key: str, default: Sequence[str] | None = None, *, empty: bool = False) -> tuple[str, ...]:
        """A list of strings; ``empty``: a string in it may be empty."""
        values = self._value(key, list, "a list of strings", default)
        if not values and default is None:
            raise self.wrong(key, "the list is empty")
        if not all(isinstance(value, str) and (value or empty) for value in values):
            raise self.wrong(key, "every element must be a string that is not empty")
        return tuple(values)

    def mapping(self, key: str, allowed: Sequence[str] | None = None) -> dict[str, str]:
        """A table of strings (empty if absent); each value must be among ``allowed`` where given."""
        values = self._value(key, dict, "a table", {})
        for name, value in values.items():
            inner = Table(values, (*self._path, key), self._text, self._file)
            if not isinstance(value, str) or not value or not name:
                raise inner.wrong(name, "it must be a string that is not empty")
            if allowed is not None and value not in allowed:
                raise inner.wrong(name, f"{value!r} is not one of {', '.join(allowed)}")
        return dict(values)

    def integers(self, key: str, low: int, high: int) -> dict[str, int]:
        """A table of whole numbers, each between ``low`` and ``high``."""
        values = self._value(key, dict, "a table", None)
        inner = Table(values, (*self._path, key), self._text, self._file)
        return {name: inner.integer(name, low, high) for name in values}

    def table(self, key: str, *, required: bool = True) -> Table:
        values = self._value(key, dict, "a table", None if required else {})
        return Table(values, (*self._path, key), self._text, self._file)

    def finish(self) -> None:
        """Refuse every key that was not read."""
        for key in self._data:
            if key not in self._asked:
                near = difflib.get_close_matches(key, self._asked, n=1)
                hint = f"; did you mean {near[0]!r}?" if near else ""
                raise self.wrong(key, f"the key is unknown{hint} (allowed: {', '.join(sorted(self._asked))})")

    def wrong(self, key: str, why: str) -> ProtocolError:
        dotted = ".".join((*self._path, key))
        return _wrong(self._file, KeyLines(self._text).line((*self._path, key)), f"{dotted}: {why}")

    def _value(self, key: str, kind: type | tuple[type, ...], wanted: str, default: Any) -> Any:
        self._asked.add(key)
        if key not in self._data:
            if default is None:
                raise self.wrong(key, f"it is missing; it must be {wanted}")
            return default
        value = self._data[key]
        if not isinstance(value, kind) or isinstance(value, bool):
            raise self.wrong(key, f"{toml_value(value)} is not {wanted}")
        return value


def _wrong(file: str, line: int | None, why: str) -> ProtocolError:
    where = file if line is None else f"{file}, line {line}"
    return ProtocolError(
        "profile-wrong",
        what=f"The device profile {where} is wrong: {why}.",
        remedy="Correct the profile, or use another one in stage.toml.",
        theirs=False,
    )
