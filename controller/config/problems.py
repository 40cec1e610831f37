"""Errors about stage.toml that name the key, its line and what is allowed."""

from __future__ import annotations

import difflib
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from controller.core.errors import UsageError
from controller.core.text import printable
from hal.escapes import toml_value
from hal.secret_words import HIDDEN, concealed, is_secret
from hal.toml_lines import KeyLines, KeyPath

LONGEST_SHOWN = 40
"""Characters of a wrong value that an error repeats."""


@dataclass(frozen=True, slots=True)
class Place:
    """A table of a file: where errors about its keys point to.

    ``path`` leads to the table from the file's root; ``kind``: what the errors' codes begin with, e.g. "stage".
    """

    file: str
    lines: KeyLines
    path: KeyPath = ()
    kind: str = "stage"

    def at(self, *keys: str | int) -> Place:
        """A place further in."""
        return Place(self.file, self.lines, (*self.path, *keys), self.kind)

    def line(self, key: str | None = None) -> int:
        """The line of a key of this table, or of the table itself."""
        return self.lines.line(self.path if key is None else (*self.path, key))

    def wrong_value(self, key: str, value: object, problem: str, allowed: str) -> UsageError:
        """``problem`` follows the value ("is not ..."); ``allowed`` says what the key may be."""
        return self._error("key-value", key, f"'{key}' = {_shown(key, value)} {problem}", f"'{key}' is {allowed}.")

    def wrong_type(self, key: str, value: object, problem: str, allowed: str) -> UsageError:
        return self._error("key-type", key, f"'{key}' = {_shown(key, value)} {problem}", f"'{key}' is {allowed}.")

    def missing(self, key: str, allowed: str, written: Collection[str] = ()) -> UsageError:
        """``written`` are the keys that the table has; one of them may be the missing one, misspelt."""
        near = difflib.get_close_matches(key, written, n=1)
        hint = f"; line {self.line(near[0])} has '{printable(near[0])}'" if near else ""
        return self._error("key-missing", None, f"the key '{key}' is missing{hint}", f"Add '{key}': {allowed}.")

    def unknown(self, key: str, allowed: Iterable[str]) -> UsageError:
        """``allowed`` are the keys that the table may have."""
        keys = sorted(allowed)
        near = difflib.get_close_matches(key, keys, n=1)
        hint = f"; did you mean '{near[0]}'?" if near else ""
        listed = f"Allowed here: {', '.join(keys)}." if keys else "No further key is allowed here."
        return self._error("key-unknown", key, f"there is no key '{printable(key)}'{hint}", listed)

    def _error(self, code: str, key: str | None, problem: str, remedy: str) -> UsageError:
        ending = "" if problem.endswith("?") else "."
        what = f"{self.file}, line {self.line(key)}: in {table_name(self.path)} {problem}{ending}"
        return UsageError(f"{self.kind}-{code}", what=what, remedy=remedy)


def check_keys(place: Place, keys: Iterable[str], allowed: Mapping[str, str], required: Sequence[str]) -> None:
    """Raise the error for the first key that is not allowed, or is required and not there.

    ``allowed`` maps each key to what it may be.
    """
    present = list(keys)
    for key in present:
        if key not in allowed:
            raise place.unknown(key, allowed)
    for key in required:
        if key not in present:
            raise place.missing(key, allowed[key])


def table_name(path: KeyPath) -> str:
    """How a person finds the table: ``[[projectors]] number 2``, ``[camera]``, "the file"."""
    if not path:
        return "the file"
    names = ".".join(str(part) for part in path if isinstance(part, str))
    numbers = [part for part in path if isinstance(part, int)]
    return f"[[{names}]] number {numbers[-1] + 1}" if isinstance(path[-1], int) else f"[{names}]"


def _shown(key: str, value: object) -> str:
    return HIDDEN if is_secret(key) else concealed(quoted(value))


def quoted(value: Any) -> str:
    """A value as an error repeats it: short, and without control characters."""
    text = toml_value(value)
    return printable(text if len(text) <= LONGEST_SHOWN else text[: LONGEST_SHOWN - 1] + "…")
