"""The arguments of operations: checked in one place for every interface, and described in API document and help."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

from controller.core.errors import UsageError

NAME: Final = r"^[A-Za-z0-9\u00C0-\u024F][A-Za-z0-9\u00C0-\u024F ._-]{0,63}$"
"""Names that are used in URLs and file names."""

_NO_TEXT: Final = re.compile("[\\x00\\ud800-\\udfff]")
"""JSON can contain half a UTF-16 character, but no file and no answer can."""

Kind = Literal["text", "integer", "number", "boolean", "file", "target", "rows"]


@dataclass(frozen=True, slots=True)
class Flag:
    """An option for a field with two values: with ``option`` it is ``value``, without it ``otherwise``."""

    option: str
    about: str
    value: Any
    otherwise: Any


@dataclass(frozen=True, slots=True)
class Field:
    """One argument of an operation. ``least`` and ``most`` limit a number, or the number of rows; ``columns`` are the
    fields of a row. A "file" is sent whole; a "target" is a picture: the key of an upload in the API, a file elsewhere.

    Only for the command line: a required field is an argument and any other an option, except with ``argument`` and
    ``flag``; ``usual``: the default of a required option; ``names``: which names the shell completes; ``secret``: the
    input is hidden; ``metavar``: the argument's name in the help
    """

    name: str
    about: str
    kind: Kind = "text"
    required: bool = True
    pattern: str = ""
    longest: int = 64
    choices: tuple[str, ...] = ()
    least: float = 0
    most: float = 0
    columns: tuple[Field, ...] = ()
    argument: bool = False
    flag: Flag | None = None
    usual: str = ""
    names: Literal["", "appearance", "projector"] = ""
    secret: bool = False
    metavar: str = ""

    def schema(self) -> dict[str, Any]:
        """JSON Schema (OpenAPI 3.1) of the value."""
        about = {"description": self.about}
        if self.kind == "rows":
            return {**about, "type": "array", "maxItems": int(self.most), "items": object_schema(self.columns)}
        if self.kind == "boolean":
            return {**about, "type": "boolean"}
        if self.kind in ("integer", "number"):
            return {**about, "type": self.kind, "minimum": self.least, "maximum": self.most}
        text: dict[str, Any] = {**about, "type": "string", "maxLength": self.longest}
        if self.pattern:
            text["pattern"] = self.pattern
        return {**text, "enum": list(self.choices)} if self.choices else text


def object_schema(fields: Sequence[Field]) -> dict[str, Any]:
    """The JSON Schema of an object with these fields and no others."""
    return {
        "type": "object",
        "properties": {field.name: field.schema() for field in fields},
        "required": [field.name for field in fields if field.required],
        "additionalProperties": False,
    }


def parse(fields: Sequence[Field], sent: Mapping[str, Any], *, strings: bool) -> dict[str, Any]:
    """The checked values of ``sent``; missing fields are omitted.

    ``strings`` True if all values are text (forms, URLs): numbers are then read from text, an empty text counts as
    omitted, and a missing boolean is False. Raises UsageError("field-unknown", "field-missing",
    "field-wrong").
    """
    known = {field.name for field in fields}
    for name in sent:
        if name not in known:
            raise UsageError("field-unknown", what="The request has an unknown field.", remedy=_allowed(fields))
    values: dict[str, Any] = {}
    for field in fields:
        value = sent.get(field.name)
        absent = field.name not in sent or (strings and value == "" and not (field.pattern == "" and field.required))
        if strings and field.kind == "boolean":
            values[field.name] = _flag(field, value)
        elif not absent:
            values[field.name] = _checked(field, value, strings=strings)
        elif field.required:
            raise UsageError("field-missing", what=f"'{field.name}' is missing.", remedy=f"Give {field.about}.")
    return values


def _allowed(fields: Sequence[Field]) -> str:
    names = ", ".join(field.name for field in fields)
    return f"Allowed here: {names}." if names else "No fields are allowed here."


def _wrong(field: Field) -> UsageError:
    return UsageError(
        "field-wrong", what=f"The value of '{field.name}' is not valid.", remedy=f"Allowed: {field.about}."
    )


def _flag(field: Field, value: object) -> bool:
    if value not in (None, "", "on", "true", "false"):
        raise _wrong(field)
    return value in ("on", "true")


def _checked(field: Field, value: object, *, strings: bool) -> Any:
    if field.kind in ("integer", "number"):
        return _number(field, _number_in(field, value) if strings else value)
    if field.kind == "boolean":
        return value if isinstance(value, bool) else _raise(field)
    if field.kind == "file":
        return value if isinstance(value, Path) else _raise(field)
    if field.kind == "rows":
        if not isinstance(value, list) or len(value) > field.most:
            raise _wrong(field)
        return [
            parse(field.columns, row, strings=strings) if isinstance(row, Mapping) else _raise(field) for row in value
        ]
    return _text(field, value)


def _raise(field: Field) -> Any:
    raise _wrong(field)


def _text(field: Field, value: object) -> str:
    if not isinstance(value, str) or len(value) > field.longest or _NO_TEXT.search(value):
        raise _wrong(field)
    if field.choices and value not in field.choices:
        raise _wrong(field)
    # Browsers send the text of a form with CRLF line ends.
    value = value.replace("\r\n", "\n")
    if field.pattern and not re.fullmatch(field.pattern.removeprefix("^").removesuffix("$"), value):
        raise _wrong(field)
    return value


def _number_in(field: Field, value: object) -> int | float:
    if not isinstance(value, str) or not re.fullmatch(r"-?[0-9]{1,15}(\.[0-9]{1,15})?", value, re.ASCII):
        raise _wrong(field)
    return float(value) if "." in value else int(value)


def _number(field: Field, value: object) -> int | float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise _wrong(field)
    # In this order: NaN is never within bounds, and int(infinity) would raise.
    if not field.least <= value <= field.most or (field.kind == "integer" and value != int(value)):
        raise _wrong(field)
    return int(value) if field.kind == "integer" else value
